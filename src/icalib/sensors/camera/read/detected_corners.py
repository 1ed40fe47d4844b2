"""Corners of a target: from tables or found in images, checked and with even stamps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import CornerStream, TrackStream
from icalib.data.recordings import DamagedImageError, Payload, Recording, decode
from icalib.data.stamps import EvenStamps, even_stamps, followed, rate_sentence, stamp_scatter
from icalib.data.tables import STAMP, TableKind
from icalib.detection.decoding import ImageCorners, corner_stream, packed
from icalib.detection.detectors import (
    Detector,
    detector_of,
    other_columns,
    other_size,
    what_is_seen,
    with_other_border,
    with_other_layout,
)
from icalib.detection.growth import MOTION_IMAGES
from icalib.detection.images import (
    Progress,
    SeenImages,
    batches_of,
    image_count,
    keep_corners,
    load_corners,
    number_continuously,
    on_all_cores,
    parts_of,
    sightings,
    spread_images,
    stream_key,
    without_rare_tags,
    words_on_damaged,
)
from icalib.detection.tags import ImageWithQuads
from icalib.errors import RecordingError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Markers, Scene, Target
from icalib.sensors.camera.spec import Camera

# Corners of the target in the images of a recording: detected on all cores, and cached for the next run.
#
# The images are read twice: first for the cache key, which is cheap, then for the detection if the cache has no
# corners. They are read once more, for a few that are spread over the recording, if these may show another target than
# stated. Only a few images are in memory at a time.

# Share of a target's points, and number of corners of free tags, found on average in the images that show the target.
# With fewer, the tags may have another border or layout.
POOR_SHARE, POOR_CORNERS = 0.5, 8
# Images of a batch, and their most bytes in memory. A thread searches a batch in order, each image where earlier ones
# predict the target. The first two images are searched as a whole, so a tag that appears apart from the others is
# missed for one batch at most. Batches, and so the results, do not depend on the number of threads.
IN_TURN, BYTES_IN_TURN = 24, 32 << 20
PACKED = 256  # images whose corners are stored in common arrays
Sample = Callable[[], list[np.ndarray]]  # some images of the recording (h, w) uint8, which the first call reads


def find_corners(
    recording: Recording,
    camera: Camera,
    target: Target,
    keep: bool = True,
    progress: Progress = lambda _: None,
    pictures: int = 0,
) -> tuple[CornerStream, tuple[Remark, ...]]:
    """The target's corners in all images of `camera`, and sentences on images, tags and corners that were left out.

    With `keep`, corners of an earlier run are loaded from the cache, and new ones are saved. pictures: most images that
    the stream keeps to be shown. Raises RecordingError if the camera has no images, their resolution is wrong, they
    cannot be read, or none shows the target.
    """
    topic, where = image_topic(recording, camera), recording.where(camera)
    sample = cache(lambda: list(spread_images(recording, topic)))
    count = image_count(recording, topic)
    seen = SeenImages(count, pictures)
    key = stream_key(camera_images(recording, camera, seen), repr(target)) if keep else ""
    detections = load_corners(key) if keep else None
    if detections is None:
        payloads = camera_images(recording, camera, seen)
        detections = _search(payloads, detector_of(target), where, lambda n: progress(n / max(count, n)))
        if wrong := _other_layout(sample, target, detections[1]):
            raise RecordingError(f"{where}: {wrong}")
        if keep:
            keep_corners(key, *detections)
    stamps_ns, images = detections
    images, rare = without_rare_tags(target, number_continuously(target, images))
    if not any(i.kept.any() for i in images):
        what = f"{where}: {_called(target)} in none of {len(images)} images of {camera.name}; "
        raise RecordingError(what + _visible_instead(sample(), target))
    if wrong := _other_border(sample, target, images):
        raise RecordingError(f"{where}: hardly any detections of {wrong}")
    corners = replace(corner_stream(camera.name, stamps_ns, images), files=seen.files, pictures=seen.pictures)
    damaged = sorted(seen.files.keys() - set(stamps_ns.tolist()))
    notes = (*sightings(target, images), *rare, *words_on_damaged(damaged, seen.files))
    return corners, tuple(note.with_sentence(f"{where}: {note}") for note in notes)


def _called(target: Target) -> str:
    """The name of the target as subject of a sentence, with its verb."""
    return f"{' and '.join(target.names)} are" if isinstance(target, Scene) else "the target is"


def _visible_instead(sample: list[np.ndarray], target: Target) -> str:
    """A sentence on the tags or the board that the images show instead of the target, with advice."""
    for _, part, _ in parts_of(target):
        if isinstance(part, Checkerboard) and (sentence := other_size(sample, part)):
            return sentence
    part = next((part for _, part, _ in parts_of(target) if part.tags), None)
    if part is None or part.tags is None:
        return "check the target's type and sizes, and that the camera saw it."
    field = "dictionary" if isinstance(part, Charuco) else "family"
    return what_is_seen(sample, part.tags.family, part.tags.border_bits, part.tags.ids, field)


def _other_border(sample: Sample, target: Target, images: list[ImageCorners]) -> str:
    """A sentence if a part of the target is poorly seen, but the images show its tags with a border of the other width;
    else ""."""
    sparse = [p for p in parts_of(target) if p[1].tags and not isinstance(p[1], Charuco) and _is_sparse(*p[1:], images)]
    views = [ImageWithQuads(image) for image in sample()] if sparse else []
    others = [other.tags for _, other, _ in parts_of(target) if other.tags]
    for name, part, _ in sparse:
        if part.tags and (sentence := with_other_border(views, part.tags, others)):
            return f"{name or 'the target'}: {sentence}"
    return ""


def _other_layout(sample: Sample, target: Target, images: list[ImageCorners]) -> str:
    """A sentence if the tags are arranged as on a board of another layout; else "".

    AprilGrids that are well seen are not checked: in a wrong layout, no more than a row or two of tags agree. ChArUco
    boards always are, because nearly all corners of a small one are found in a wrong layout, too.
    """
    for name, part, first in parts_of(target):
        wrong = ""
        if isinstance(part, Charuco) or (isinstance(part, AprilGrid) and _is_sparse(part, first, images)):
            wrong = other_columns(sample(), part)
        if isinstance(part, Charuco):
            wrong = wrong or with_other_layout(sample(), part)
        if wrong:
            return f"{name}: {wrong}" if name else wrong
    return ""


def _is_sparse(part: Target, first: int, images: list[ImageCorners]) -> bool:
    """Whether no image shows the part, or those that do show less than POOR_SHARE of its points on average (free tags:
    at most POOR_CORNERS corners).

    first: number of the part's first point in the target.
    """
    usual = POOR_SHARE * len(part.points)
    usual = min(usual, POOR_CORNERS) if isinstance(part, Markers) else usual
    counts = [int((i.kept & (i.point >= first) & (i.point < first + len(part.points))).sum()) for i in images]
    return sum(counts) < usual * max(sum(n > 0 for n in counts), 1)


def _search(
    payloads: Iterable[Payload], detector: Detector, where: str, done: Callable[[int], None]
) -> tuple[np.ndarray, list[ImageCorners]]:
    """Stamps (M,) and corners of all images that can be decoded. Raises RecordingError if there are none."""
    stamps: list[int] = []
    images: list[ImageCorners] = []
    damaged = ""
    batches = batches_of(payloads, IN_TURN, BYTES_IN_TURN)
    for batch_stamps, batch_corners, error in on_all_cores(batches, partial(_in_turn, detector=detector)):
        for stamp, one in zip(batch_stamps, batch_corners, strict=True):
            stamps.append(stamp)
            images.append(one)
            if len(images) % PACKED == 0:
                images[-PACKED:] = packed(images[-PACKED:])
        done(len(images))
        damaged = error or damaged
    if not images:
        raise RecordingError(damaged or f"{where}: there are no images; check that the camera was running.")
    return np.array(stamps, dtype=np.int64), images


def _in_turn(payloads: list[Payload], detector: Detector) -> tuple[list[int], list[ImageCorners], str]:
    """Stamps and corners of the images of a batch that can be decoded, and the reason why the last other one cannot, or
    ""."""
    stamps: list[int] = []
    corners: list[ImageCorners] = []
    damaged = ""
    for p in payloads:
        try:
            image = decode(p)
        except DamagedImageError as error:
            damaged = str(error)
            continue
        stamps.append(p.stamp_ns)
        corners.append(detector.detect(image, corners[-MOTION_IMAGES:]))
    return stamps, corners, damaged


# The images of a camera in a recording.


def image_topic(recording: Recording, camera: Camera) -> str:
    """Name of the topic with the images of the camera. Raises RecordingError as `Recording.topic`."""
    return recording.image_topic(camera.name, camera.topic)


def camera_images(recording: Recording, camera: Camera, seen: SeenImages) -> Iterator[Payload]:
    """The undecoded images of the camera, each of which is added to `seen`.

    Raises RecordingError as `Recording.payloads`, and at the first image whose resolution is not the camera's.
    """
    where = recording.where(camera)
    for p in recording.payloads(image_topic(recording, camera)):
        if p.width and (p.width, p.height) != camera.resolution:
            raise RecordingError(
                f"{where}: images have {p.width} x {p.height} px, but {camera.name} {camera.resolution[0]} x "
                f"{camera.resolution[1]}; correct its resolution in the rig file."
            )
        seen.add(p)
        yield p


# Even stamps of images that a computer stamps on arrival, although the camera takes them evenly.

ReadImages = tuple[CornerStream | TrackStream, tuple[Remark, ...]]  # a stream, and notes for the user
_MIN_SHARED = 0.5  # of the images of a camera have stamps of another one, if both are triggered together


def with_even_stamps(read: Sequence[ReadImages], where: Mapping[str, str]) -> list[ReadImages]:
    """The streams of corners and tracks, with even stamps where the cameras run evenly, and notes on these.
    `jitter_s` of a stream is what even stamps may still be off, or the scatter of uneven ones.

    Streams with the same stamps, of one camera or of cameras that are triggered together, stay together. where: source
    of the images of each camera, for messages.
    """
    evened = list(read)
    for group in _groups([stream for stream, _ in read]):
        streams = [read[k][0] for k in group]
        stamps_ns = np.unique(np.concatenate([s.stamps_ns for s in streams]))
        even = even_stamps(stamps_ns, partial(followed, **_rows(streams, stamps_ns)))
        for k in group:
            stream, notes = read[k]
            if even is None:
                evened[k] = replace(stream, jitter_s=stamp_scatter(stream.stamps_ns)), notes
            else:
                evened[k] = _moved(stream, stamps_ns, even), (*notes, even.note(where[stream.name], "images"))
    return evened


def _groups(streams: Sequence[CornerStream | TrackStream]) -> list[list[int]]:
    """Indices of streams whose images share stamps."""
    groups: list[list[int]] = []
    for k, stream in enumerate(streams):
        shared = (np.isin(stream.stamps_ns, streams[group[0]].stamps_ns).mean() for group in groups)
        at = next((i for i, share in enumerate(shared) if share > _MIN_SHARED), None)
        if at is None:
            groups.append([k])
        else:
            groups[at].append(k)
    return groups


def _rows(streams: Iterable[CornerStream | TrackStream], stamps_ns: np.ndarray) -> dict[str, np.ndarray]:
    """Arguments of `followed`: the observations of each point by each stream are a series."""
    series, at, values, first = [], [], [], 0
    for stream in streams:
        point = stream.point if isinstance(stream, CornerStream) else stream.feature
        series.append(point + first)
        at.append(np.searchsorted(stamps_ns, stream.stamps_ns)[stream.image])
        values.append(stream.uv)
        first += 1 + int(point.max(initial=-1))
    return {"series": np.concatenate(series), "at": np.concatenate(at), "values": np.concatenate(values)}


def _moved(stream: CornerStream | TrackStream, stamps_ns: np.ndarray, even: EvenStamps) -> CornerStream | TrackStream:
    """The stream with even stamps. stamps_ns (M,): the original ones of `even`."""
    moved = even.stamps_ns[np.searchsorted(stamps_ns, stream.stamps_ns)]
    new = dict(zip(stream.stamps_ns.tolist(), moved.tolist(), strict=True))
    pictures = {new[stamp]: image for stamp, image in stream.pictures.items() if stamp in new}
    if isinstance(stream, TrackStream):
        return replace(stream, stamps_ns=moved, pictures=pictures, jitter_s=even.left_s)
    files = {new.get(stamp, stamp): file for stamp, file in stream.files.items()}
    return replace(stream, stamps_ns=moved, files=files, pictures=pictures, jitter_s=even.left_s)


# Checks corners and tracks: image bounds, order and rate of stamps, and number of corners per image.

IMAGE_RATE_HZ = (1e-3, 1000.0)  # plausible range of image rates
_MIN_IMAGE_CORNERS = 4  # corners of an image; fewer do not determine a pose
_CORNER_MARGIN_PX = 1.0  # accepted distance outside the image, which corner refinement may cause
_MAX_OUTSIDE_SHARE = 0.1  # of all points; more points outside mean that the stated resolution is wrong


def checked_corners(
    corners: CornerStream, where: str, resolution: tuple[int, int]
) -> tuple[CornerStream, tuple[Remark, ...]]:
    """The corners inside the image of `resolution` (width, height) px, in images with four or more; notes on others.

    Raises RecordingError naming `where` (the file or topic) if there are no usable images, many corners are outside the
    image, or the image rate is impossible.
    """
    what = f"{where} ({corners.name})"
    if len(corners.stamps_ns) == 0:
        raise RecordingError(f"{what}: no corners at all; check the camera's path and the detector.")
    sentence = rate_sentence(what, corners.stamps_ns, *IMAGE_RATE_HZ) if len(corners.stamps_ns) > 1 else None
    if sentence:
        raise RecordingError(sentence)
    corners, outside = _inside(corners, what, resolution)
    corners, poor = _without_poor_images(corners, what)
    return corners, outside + poor


def _inside(corners: CornerStream, what: str, resolution: tuple[int, int]) -> tuple[CornerStream, tuple[Remark, ...]]:
    """The corners inside the image, and a note on corners outside. Raises RecordingError if many are outside."""
    inside = in_image(corners.uv, resolution, _CORNER_MARGIN_PX)
    if inside.all():
        return corners, ()
    tag, corner = divmod(int(corners.point[np.argmin(inside)]), 4)
    note = outside_note(corners, inside, f"corner {corner} of tag {tag}", what, resolution)
    count = np.bincount(corners.image[inside], minlength=len(corners.stamps_ns))
    return corners.of_rows(inside, corners.stamps_ns, count), (note,)


def image_starts(what: str, stamps_ns: np.ndarray) -> np.ndarray:
    """(M + 1,) first row of each image, then the number of rows N. stamps_ns (N,): stamp of each row.

    Raises RecordingError naming `what` and the instant if images are out of order."""
    step = np.diff(stamps_ns)
    if (step < 0).any():
        i = int(np.argmax(step < 0))
        raise RecordingError(
            f"{what}: the image at {stamps_ns[i + 1]} ns comes after the one at {stamps_ns[i]} ns; "
            "sort the rows by stamp."
        )
    return np.append(np.flatnonzero(np.concatenate([[True], step > 0])), len(stamps_ns)).astype(np.int64)


def in_image(uv: np.ndarray, resolution: tuple[int, int], margin_px: float) -> np.ndarray:
    """(N,) bool: points uv (N, 2) px that are inside the image of (width, height) px, or at most margin_px outside."""
    return np.logical_and.reduce((uv >= -0.5 - margin_px) & (uv <= np.array(resolution) - 0.5 + margin_px), axis=1)


def outside_note(
    stream: CornerStream | TrackStream, inside: np.ndarray, point: str, what: str, resolution: tuple[int, int]
) -> Remark:
    """A note on points that are not `inside` (N,) bool the image, at least one. `point`: text that names the first.

    Raises RecordingError if many points are outside."""
    first, count = int(np.argmin(inside)), int((~inside).sum())
    (u, v), (width, height) = stream.uv[first], resolution
    which = stream.which(int(stream.stamps_ns[stream.image[first]]))
    words = f"{point} lies at ({u:.1f}, {v:.1f}), outside the image of {width} x {height} px"
    sentence = f"{what}: in the image {which}, {words}"
    if count > _MAX_OUTSIDE_SHARE * len(inside):
        raise RecordingError(f"{sentence}; check the camera's resolution [width, height] in the rig file.")
    return Remark("points_outside_image", f"{sentence}; {count} of {len(inside)} such points were left out.")


def _without_poor_images(corners: CornerStream, what: str) -> tuple[CornerStream, tuple[Remark, ...]]:
    """The images with enough corners for a pose, and a note on others. Raises RecordingError if none has enough."""
    count = np.diff(corners.start)
    keep = count >= _MIN_IMAGE_CORNERS
    if keep.all():
        return corners, ()
    if not keep.any():
        raise RecordingError(f"{what}: no image has {_MIN_IMAGE_CORNERS} corners or more; check the detector.")
    rows = keep[corners.image]
    first = int(corners.stamps_ns[np.argmin(keep)])
    dropped = f"{int((~keep).sum())} images with fewer than {_MIN_IMAGE_CORNERS} corners were dropped"
    note = Remark("images_with_few_corners", f"{what}: {dropped}, the first {corners.which(first)}.")
    return corners.of_rows(rows, corners.stamps_ns[keep], count[keep]), (note,)


# Groups the rows of a corner table into the corner stream of one camera, image by image.

CORNER_TABLE = TableKind(
    ("t [ns]", "tag id", "corner"),
    ("u [px]", "v [px]"),
    (
        STAMP,
        (r"(tag|marker)(_?id)?|id",),
        (r"corner(_?(id|index))?",),
        (r"u(_?px)?|x(_?px)?",),
        (r"v(_?px)?|y(_?px)?",),
    ),
    IMAGE_RATE_HZ,
)


class CornerRows(NamedTuple):
    """Rows of a corner table: stamps_ns, tag, corner (N,) int64, and uv (N, 2) px."""

    stamps_ns: np.ndarray
    tag: np.ndarray
    corner: np.ndarray
    uv: np.ndarray


def group_corners(name: str, source: str, rows: CornerRows, target: Target) -> CornerStream:
    """The corner stream of one camera from the rows of its table.

    Raises RecordingError naming `source` and the instant: images out of order, a corner that the target does not have,
    or one that appears twice in an image.
    """
    start = image_starts(source, rows.stamps_ns)
    point = _point_index(source, rows, target)
    _refuse_repeated(source, rows, start, point)
    return CornerStream(name, rows.stamps_ns[start[:-1]], start, point, np.ascontiguousarray(rows.uv))


def _point_index(source: str, rows: CornerRows, target: Target) -> np.ndarray:
    """(N,) index of the target point of each row. Raises RecordingError naming the first unknown corner."""
    tag, corner = rows.tag, rows.corner
    try:
        return target.point_index(tag, corner)
    except RecordingError:
        row = _first_unknown(tag, corner, target)
    try:
        return target.point_index(tag[row : row + 1], corner[row : row + 1])
    except RecordingError as error:
        raise RecordingError(f"{source}: in the image at {rows.stamps_ns[row]} ns, {error}") from None


def _first_unknown(tag: np.ndarray, corner: np.ndarray, target: Target) -> int:
    """Index of the first row that `Target.point_index` refuses, found by bisection; there must be one."""
    known, refused = 0, len(tag)
    while refused - known > 1:
        middle = (known + refused) // 2
        try:
            target.point_index(tag[:middle], corner[:middle])
            known = middle
        except RecordingError:
            refused = middle
    return refused - 1


def _refuse_repeated(source: str, rows: CornerRows, start: np.ndarray, point: np.ndarray) -> None:
    """Raises RecordingError naming the instant if a corner appears twice in an image.

    start (M + 1,): first row of each image; point (N,): index of the target point of each row."""
    image = np.repeat(np.arange(len(start) - 1), np.diff(start))
    key = image * (1 + point.max(initial=0)) + point
    order = np.argsort(key, kind="stable")
    repeated = order[1:][np.diff(key[order]) == 0]
    if len(repeated):
        row = int(repeated.min())
        raise RecordingError(
            f"{source}: the image at {rows.stamps_ns[row]} ns has corner {rows.corner[row]} of tag {rows.tag[row]} "
            "twice; remove one, or give images taken at the same instant different cameras."
        )
