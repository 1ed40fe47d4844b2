"""Corners of the target in the images of a recording: detected on all cores, and cached for the next run.

The images are read twice: first for the cache key, which is cheap, then for the detection if the cache has no corners.
They are read once more, for a few that are spread over the recording, if these may show another target than stated.
Only a few images are in memory at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, partial

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.data.recordings import DamagedImageError, Payload, Recording, decode
from icalib.detection.boards.detectors import Detector, detector_of
from icalib.detection.boards.diagnosis import (
    other_columns,
    other_size,
    what_is_seen,
    with_other_border,
    with_other_layout,
)
from icalib.detection.images import (
    Progress,
    batches_of,
    image_count,
    keep_corners,
    load_corners,
    on_all_cores,
    spread_images,
    stream_key,
    words_on_damaged,
)
from icalib.detection.primitives.corners import ImageCorners, corner_stream, packed
from icalib.detection.primitives.prediction import MOTION_IMAGES
from icalib.detection.primitives.tags import ImageWithQuads
from icalib.detection.sightings import number_continuously, parts_of, sightings, without_rare_tags
from icalib.errors import RecordingError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Markers, Scene, Target
from icalib.rig import Camera
from icalib.sensors.camera.read.images import camera_images, image_topic

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
    recording: Recording, camera: Camera, target: Target, keep: bool = True, progress: Progress = lambda _: None
) -> tuple[CornerStream, tuple[str, ...]]:
    """The target's corners in all images of `camera`, and sentences on images, tags and corners that were left out.

    With `keep`, corners of an earlier run are loaded from the cache, and new ones are saved. Raises RecordingError if
    the camera has no images, their resolution is wrong, they cannot be read, or none shows the target.
    """
    topic, where = image_topic(recording, camera), recording.where(camera)
    sample = cache(lambda: list(spread_images(recording, topic)))
    files: dict[int, str] = {}
    key = stream_key(camera_images(recording, camera, files), repr(target)) if keep else ""
    detections = load_corners(key) if keep else None
    if detections is None:
        count, payloads = image_count(recording, topic), camera_images(recording, camera, files)
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
    corners = replace(corner_stream(camera.name, stamps_ns, images), files=files)
    damaged = sorted(files.keys() - set(stamps_ns.tolist()))
    notes = (*sightings(target, images), *rare, *words_on_damaged(damaged, files))
    return corners, tuple(f"{where}: {note}" for note in notes)


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
