"""From a recording's images to the corners of the target: decoded and searched on all cores, and kept for the next run.

The images are read twice: once for the name under which their corners are kept, which is cheap, and once more where
nothing is kept under it. Only a few are in memory at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.data.recordings import DamagedImageError, Payload, Recording, decode
from icalib.detection.boards.board_diagnosis import other_columns, other_size
from icalib.detection.boards.detectors import Detector, detector_of
from icalib.detection.boards.diagnosis import what_is_seen, with_other_border, with_other_layout
from icalib.detection.images.cache import keep_corners, load_corners, stream_key
from icalib.detection.images.image_work import (
    Progress,
    batches_of,
    image_count,
    on_all_cores,
    recording_names,
    spread_images,
    with_resolution,
    words_on_damaged,
)
from icalib.detection.primitives.corners import ImageCorners, corner_stream, packed
from icalib.detection.primitives.prediction import MOTION_IMAGES
from icalib.detection.sightings import parts_of, sightings, without_rare_tags
from icalib.detection.turns import number_continuously
from icalib.errors import RecordingError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Markers, Scene, Target
from icalib.rig import Camera

# Of a target's points, and of free tags' corners, an image on average: with fewer the tags may have another border.
POOR_SHARE, POOR_CORNERS = 0.5, 8
# Images that a thread searches in turn, each where the ones before lead to expect the target. The first two are
# searched wholly: a tag that appears apart from the others is missed for this long at most. Fewer of large images,
# which wait in memory. Turns do not depend on the number of threads, and so neither does what is found.
IN_TURN, BYTES_IN_TURN = 24, 32 << 20
PACKED = 256  # images whose corners are put together


def find_corners(
    recording: Recording, camera: Camera, target: Target, keep: bool = True, progress: Progress = lambda _: None
) -> tuple[CornerStream, tuple[str, ...]]:
    """The target's corners in all images of `camera`, and sentences on those left out.

    With `keep`, what an earlier run found is used, and what is found is kept. Raises RecordingError, one sentence,
    where there are no images of the camera, they are not of its resolution, cannot be read, or the target is in none.
    """
    topic, where = recording.image_topic(camera), recording.where(camera)
    files: dict[int, str] = {}

    def read() -> Iterator[Payload]:
        return recording_names(with_resolution(recording.payloads(topic), camera, where), files)

    key = stream_key(read(), repr(target)) if keep else ""
    found = load_corners(key) if keep else None
    if found is None:
        count, payloads = image_count(recording, topic), read()
        found = _search(payloads, detector_of(target), where, lambda n: progress(n / max(count, n)))
        if wrong := _other_layout(recording, topic, target, found[1]):
            raise RecordingError(f"{where}: {wrong}")
        if keep:
            keep_corners(key, *found)
    stamps_ns, images = found
    images, rare = without_rare_tags(target, number_continuously(target, images))
    if not any(i.kept.any() for i in images):
        what = f"{where}: {_called(target)} in none of {len(images)} images of {camera.name}; "
        raise RecordingError(what + _seen_instead(recording, topic, target))
    if wrong := _other_border(recording, topic, target, images):
        raise RecordingError(f"{where}: hardly any detections of {wrong}")
    corners = replace(corner_stream(camera.name, stamps_ns, images), files=files)
    damaged = sorted(files.keys() - set(stamps_ns.tolist()))
    notes = (*sightings(target, images), *rare, *words_on_damaged(damaged, files))
    return corners, tuple(f"{where}: {note}" for note in notes)


def _called(target: Target) -> str:
    return f"{' and '.join(target.names)} are" if isinstance(target, Scene) else "the target is"


def _seen_instead(recording: Recording, topic: str, target: Target) -> str:
    """What to do about a target that is never found: by what the images show instead, where it has tags."""
    for _, part, _ in parts_of(target):
        if isinstance(part, Checkerboard) and (sentence := other_size(spread_images(recording, topic), part)):
            return sentence
    part = next((part for _, part, _ in parts_of(target) if part.tags), None)
    if part is None or part.tags is None:
        return "check the target's type and sizes, and that the camera saw it."
    field = "dictionary" if isinstance(part, Charuco) else "family"
    return what_is_seen(spread_images(recording, topic), part.tags.family, part.tags.border_bits, part.tags.ids, field)


def _other_border(recording: Recording, topic: str, target: Target, images: list[ImageCorners]) -> str:
    """Where a part of the target is poorly seen, but in the images with the other width of border: what, and what to
    do."""
    for name, part, first in parts_of(target):
        if not part.tags or isinstance(part, Charuco) or not _poorly_seen(part, first, images):
            continue
        others = [other.tags for _, other, _ in parts_of(target) if other.tags]
        if sentence := with_other_border(spread_images(recording, topic), part.tags, others):
            return f"{name or 'the target'}: {sentence}"
    return ""


def _other_layout(recording: Recording, topic: str, target: Target, images: list[ImageCorners]) -> str:
    """Where tags stand as on a board of another layout: that, and what to do.

    AprilGrids of which enough is seen are not looked at: in a wrong layout no more than a row or two of tags agree. The
    corners of a small ChArUco board are nearly all found in a wrong layout, too.
    """
    for name, part, first in parts_of(target):
        wrong = ""
        if isinstance(part, Charuco) or (isinstance(part, AprilGrid) and _poorly_seen(part, first, images)):
            wrong = other_columns(spread_images(recording, topic), part)
        if isinstance(part, Charuco):
            wrong = wrong or with_other_layout(spread_images(recording, topic), part)
        if wrong:
            return f"{name}: {wrong}" if name else wrong
    return ""


def _poorly_seen(part: Target, first: int, images: list[ImageCorners]) -> bool:
    """Whether the images show, on average, less of the part than half its points (free tags: two tags).

    The part's points are numbered from `first` on.
    """
    usual = POOR_CORNERS if isinstance(part, Markers) else POOR_SHARE * len(part.points)
    own = [i.kept & (i.point >= first) & (i.point < first + len(part.points)) for i in images]
    return sum(int(o.sum()) for o in own) < usual * len(images)


def _search(
    payloads: Iterable[Payload], detector: Detector, where: str, done: Callable[[int], None]
) -> tuple[np.ndarray, list[ImageCorners]]:
    """Stamps (M,) and corners of all images that can be decoded. Raises RecordingError where none can."""
    stamps: list[int] = []
    images: list[ImageCorners] = []
    damaged = ""
    batches = batches_of(payloads, IN_TURN, BYTES_IN_TURN)
    for own, found, error in on_all_cores(batches, partial(_in_turn, detector=detector)):
        for stamp, one in zip(own, found, strict=True):
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
    """Stamps and corners of those images that can be decoded, and why the last that cannot be cannot."""
    stamps: list[int] = []
    found: list[ImageCorners] = []
    damaged = ""
    for p in payloads:
        try:
            image = decode(p)
        except DamagedImageError as error:
            damaged = str(error)
            continue
        stamps.append(p.stamp_ns)
        found.append(detector.detect(image, found[-MOTION_IMAGES:]))
    return stamps, found, damaged
