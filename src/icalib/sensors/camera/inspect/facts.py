"""What a recording shows of its cameras, as plain data; figures that cannot be determined are None.

Reads the images of a camera for an inspection.

Detections of the target in images: their number, coverage of the image, tilts and distances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.data.recordings import DamagedImageError, Payload, Recording, TopicInfo, decode
from icalib.detection.detectors import checkerboard_in, tags_in
from icalib.errors import RecordingError
from icalib.geometry.cameras import CAMERA_MODELS, camera_model
from icalib.geometry.targets import Target
from icalib.initialize.smooth_trajectory import common_stops, follow_closely
from icalib.sensors.camera.initialize.intrinsics import fitting_model
from icalib.sensors.camera.read import CameraInfo
from icalib.sensors.camera.read import corners as recorded_corners
from icalib.sensors.camera.read.detected_corners import find_corners
from icalib.sensors.camera.spec import Camera
from icalib.tools.inspection.console import coverage
from icalib.tools.inspection.facts import (
    PICTURED,
    Inspection,
    SensorSource,
    StreamFacts,
    Vector,
    comment,
    frame_id,
    name_text,
    numbers,
    place_line,
    timing_of,
)
from icalib.tools.inspection.kalibr import KalibrCamera


@dataclass(frozen=True)
class ImageFacts:
    """The images of one topic. resolution (width, height) px, encoding, frame: of the first image; decoded: number of
    sampled images; damaged: number of these that cannot be decoded."""

    resolution: tuple[int, int] | None
    encoding: str
    frame: str
    decoded: int
    damaged: int


@dataclass(frozen=True)
class TargetView:
    """Detections of the target in the images of one camera.

    images: their number, None if only corners were recorded; seen: number of images with the target; corners: number in
    all images. cells: number of corners in each cell of a grid over the image, row by row; None if the resolution is
    unknown. tilt_deg: 10th, 50th and 90th percentile of the angle between the optical axis and the target's normal;
    distance_ratio: 90th over 10th percentile of the distance. Both are rough, as the intrinsics are unknown. model:
    camera model that fits the corners, None if they are too few; errors_px: of the models compared, see
    `fitting_model`. stops: places at which the target was at rest; None if images do not
    follow one another. images_seen: JPEG and corners (n, 2) px of some images, those with most corners first.
    """

    camera: str
    images: int | None
    seen: int
    corners: int
    cells: tuple[tuple[int, ...], ...] | None
    tilt_deg: Vector | None
    distance_ratio: float | None
    notes: tuple[str, ...] = ()
    problem: str = ""
    model: str | None = None
    errors_px: Mapping[str, float] = field(default_factory=dict)
    stops: int | None = None
    images_seen: tuple[tuple[bytes, np.ndarray], ...] = field(default=(), metadata=PICTURED)


@dataclass(frozen=True)
class CameraFacts:
    """One camera. images: None without images; info: None without a readable CameraInfo. view: None if no target is
    known; pattern: then, words on the tags or checkerboard in a few images, "" for neither; None: not looked at."""

    images: ImageFacts | None = None
    info: CameraInfo | None = None
    view: TargetView | None = None
    pattern: str | None = None


@dataclass(frozen=True)
class CameraSource(SensorSource):
    """One camera: the topics of its images, corners, tracks (tables) and CameraInfo, or None. others: further topics of
    the same images. topic: the one that `calibrate` reads, which is corners, else images, else tracks."""

    images: TopicInfo | None
    corners: TopicInfo | None
    info: TopicInfo | None
    others: tuple[str, ...] = ()
    tracks: TopicInfo | None = None

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        return tuple(topic for topic in (self.images, self.corners) if topic)


def camera_sources(inspection: Inspection) -> dict[str, CameraSource]:
    """The cameras of a recording, by name."""
    return inspection.sources.of(Camera.sensor_type)


def camera_views(inspection: Inspection) -> dict[str, TargetView]:
    """The target as seen by cameras in whose images it was searched for, by name."""
    return {n: view for n in camera_sources(inspection) if (view := inspection.facts[n].view) is not None}


def patterns(inspection: Inspection) -> dict[str, str]:
    """`CameraFacts.pattern` of the cameras that were looked at, by name."""
    return {n: words for n in camera_sources(inspection) if (words := inspection.facts[n].pattern) is not None}


def without_target(inspection: Inspection) -> bool:
    """Whether there is an IMU and no camera shows a target, so that cameras can only track points of the scene."""
    words = patterns(inspection)
    return bool(inspection.imu and words) and not any(words.values())


PICTURES, PICTURES_SHOWN = 12, 3  # images that are kept of each camera, evenly spread, and those that a page shows
SAMPLE = 16  # images per camera that are decoded, spread over the recording


def read_images(recording: Recording, topic: TopicInfo) -> tuple[StreamFacts, ImageFacts]:
    """Reads all images of a topic, and decodes a sample."""
    sample = _Sample(max(topic.count // SAMPLE, 1))
    stamps: list[int] = []
    problem = ""
    try:
        for payload in recording.payloads(topic.name):
            stamps.append(payload.stamp_ns)
            sample.look(payload)
    except RecordingError as error:
        problem = str(error)
    if sample.decoded and sample.damaged == sample.decoded:
        problem = problem or (
            f"{topic.name}: none of {sample.decoded} sampled images can be decoded "
            f"({sample.error.rstrip('.')}); check the driver, and record again."
        )
    frame = frame_id(recording, topic)
    facts = ImageFacts(sample.resolution, sample.encoding, frame, sample.decoded, sample.damaged)
    content = f"{facts.resolution[0]} x {facts.resolution[1]} {facts.encoding}" if facts.resolution else ""
    return StreamFacts(topic, timing_of(np.array(stamps, np.int64)), problem, content), facts


class _Sample:
    """Decodes every n-th image, and counts those that are damaged."""

    def __init__(self, every: int) -> None:
        self._every, self._count = every, 0
        self.decoded = self.damaged = 0
        self.encoding = self.error = ""
        self.resolution: tuple[int, int] | None = None

    def look(self, payload: Payload) -> None:
        self._count += 1
        if self._count == 1:
            self.encoding = payload.encoding
        if self.resolution is None and payload.width:
            self.resolution = payload.width, payload.height
        if (self._count - 1) % self._every:
            return
        self.decoded += 1
        try:
            height, width = decode(payload).shape
        except DamagedImageError as error:
            self.damaged += 1
            self.error = self.error or str(error)
            return
        self.resolution = self.resolution or (width, height)


_LEAST_CORNERS = 8  # for the tilt of a board in one image; a free tag needs its four


def resolution_of(inspection: Inspection, name: str, camera: CameraSource) -> tuple[int, int] | None:
    """Resolution (width, height) px of the camera's images; without images, that of the rig file with the target or of
    Kalibr's camchain; else None."""
    if camera.images:
        return inspection.facts[name].images.resolution
    stated = inspection.target.sensors.get(name) if inspection.target else None
    if isinstance(stated, Camera):
        return stated.resolution
    return next((c.resolution for c in inspection.kalibr.cameras if c.name == name), None)


def target_view(
    recording: Recording,
    name: str,
    source: CameraSource,
    target: Target,
    resolution: tuple[int, int] | None,
    progress: Callable[[float], None],
) -> TargetView:
    """Finds the target in all images of the camera, or reads the recorded corners. A failure is described in
    `TargetView.problem`."""
    images = source.images.name if source.images else None
    path = source.corners.name if source.corners else f"{name}/corners.csv"
    # The detection of corners does not depend on the camera model.
    camera = Camera(name, path, "pinhole-radtan", resolution or (1, 1), topic=images)
    tabled = source.corners is not None
    try:
        if tabled:
            corners, notes = recorded_corners(recording, camera, target), ()
        else:
            corners, notes = find_corners(recording, camera, target, progress=progress, pictures=PICTURES)
    except RecordingError as error:
        return TargetView(name, None, 0, 0, None, None, None, problem=str(error))
    count = np.diff(corners.start)
    tilt, ratio = _poses(corners, target)
    (model, errors_px), view = (None, {}), (corners.stamps_ns, corners.by_point())
    if resolution is not None and (count > 0).sum() >= FEWEST_FOR_MODEL:
        model, errors_px = fitting_model(corners, target, resolution, (DEFAULT_MODEL, FISHEYE_MODEL))
    return TargetView(
        name,
        images=None if tabled else len(count),
        seen=int((count > 0).sum()),
        corners=len(corners.uv),
        cells=coverage(corners.uv, resolution) if resolution else None,
        tilt_deg=tilt,
        distance_ratio=ratio,
        notes=notes,
        model=model,
        errors_px=errors_px,
        stops=len(common_stops([view])) if follow_closely(view[0]) else None,
        images_seen=_images_seen(corners),
    )


def _images_seen(corners: CornerStream) -> tuple[tuple[bytes, np.ndarray], ...]:
    jpegs = [(corners.pictures[ns][1], k) for k, ns in enumerate(corners.stamps_ns.tolist()) if ns in corners.pictures]
    seen = [(jpeg, corners.uv[corners.start[k] : corners.start[k + 1]]) for jpeg, k in jpegs]
    return tuple(sorted(seen, key=lambda image: -len(image[1]))[:PICTURES_SHOWN])


def target_in(images: Iterable[np.ndarray]) -> str:
    """Words on the tags or the checkerboard in images (h, w) uint8; "" for neither."""
    grey = list(images)
    return tags_in(grey) or checkerboard_in(grey)


def _poses(corners: CornerStream, target: Target) -> tuple[tuple[float, float, float] | None, float | None]:
    """10th, 50th and 90th percentile of the tilt [deg], and 90th over 10th percentile of the distance; None without
    data.

    Both follow from an affine map of each body's plane to each image. A distant plane that is tilted by a has the scale
    f / distance along the axis of the tilt, and cos(a) times this scale across it.
    """
    scales: list[np.ndarray] = []
    body = target.body[corners.point]
    order = np.lexsort((body, corners.image))
    change = np.flatnonzero((np.diff(corners.image[order]) != 0) | (np.diff(body[order]) != 0)) + 1
    for rows in np.split(order, change) if len(order) else []:
        if len(rows) < (_LEAST_CORNERS if target.bends[body[rows[0]]] else 4):
            continue
        xy = target.points[corners.point[rows], :2]
        design = np.column_stack([xy - xy.mean(axis=0), np.ones(len(xy))])
        affine, _, rank, _ = np.linalg.lstsq(design, corners.uv[rows], rcond=None)
        if rank == 3:
            scales.append(np.linalg.svd(affine[:2], compute_uv=False))
    if not scales:
        return None, None
    large, small = np.array(scales).T
    low, middle, high = np.percentile(np.degrees(np.arccos(np.clip(small / large, 0.0, 1.0))), (10, 50, 90))
    near, far = np.percentile(large, (90, 10))
    return (float(low), float(middle), float(high)), float(near / far)


# Lines of a camera in a draft of the rig file.
#
# Camera model and initial values in a draft of the rig file: from Kalibr's camchain, else from CameraInfo.


def camera_lines(inspection: Inspection, name: str, camera: CameraSource) -> list[str]:
    """Lines of the camera called `name`."""
    resolution = resolution_of(inspection, name, camera)
    lens = lens_start(inspection, name, camera, resolution)
    frame = inspection.facts[name].images.frame if camera.images else ""
    lines = [f"  {name}:", "    type: camera"]
    if camera.corners:
        lines.append(f"    {place_line(camera.corners.name, camera.corners.type)}")
    if camera.images:
        kind = camera.images.type if camera.corners is None else "images"
        lines.append(f"    {place_line(camera.images.name, kind, frame)}")
    if camera.tracks:
        lines.append(f"    tracks: {name_text(camera.tracks.name)}  # {comment(camera.tracks.type)}")
    elif without_target(inspection) and camera.images:
        lines.append("    tracks: images  # points of the scene; a few images show no tags and no checkerboard")
    lines.append(f"    model: {lens.model}  # {comment(lens.why)}")
    lines.append(
        f"    resolution: [{resolution[0]}, {resolution[1]}]"
        if resolution
        else "    resolution:  # FILL IN: [width, height] of the images, px"
    )
    lines += _starts(lens)
    lines += [f"    # {comment(note)}" for note in lens.notes]
    return lines


def _starts(lens: LensStart) -> Iterable[str]:
    if lens.intrinsics is not None:
        yield f"    intrinsics: {{guess: {numbers(lens.intrinsics)}}}  # fx, fy, cx, cy from {comment(lens.source)}"
    if lens.distortion is not None:
        names = ", ".join(CAMERA_MODELS[lens.model].parameter_names[4:])
        yield f"    distortion: {{guess: {numbers(lens.distortion)}}}  # {names} from {comment(lens.source)}"


DEFAULT_MODEL, FISHEYE_MODEL = "pinhole-radtan", "pinhole-equidistant"
FEWEST_FOR_MODEL = 5  # images whose corners show which camera model fits
_BROWN = ("plumb_bob", "rational_polynomial")
_FISHEYES = ("equidistant", "fisheye", "kannala_brandt4")
Values = tuple[float, ...]


@dataclass(frozen=True)
class LensStart:
    """Camera model with initial values. why: reason for the model; intrinsics: fx, fy, cx, cy [px]; None: no guess,
    `calibrate` finds the values; source: of the values; notes: values that are not used, and why."""

    model: str
    why: str
    intrinsics: Values | None = None
    distortion: Values | None = None
    source: str = ""
    notes: tuple[str, ...] = ()


def lens_start(
    inspection: Inspection, name: str, camera: CameraSource, resolution: tuple[int, int] | None
) -> LensStart:
    """Model and initial values for the lens of the camera called `name`, whose images have `resolution` (width, height)
    px."""
    notes: list[str] = []
    kalibr = _kalibr(inspection, name, camera)
    if kalibr is not None and kalibr.resolution != resolution:
        notes.append(f"{Path(kalibr.file).name} is for {_size(kalibr.resolution)} px and is not used")
    elif kalibr is not None:
        source = f"{Path(kalibr.file).name} (Kalibr, {kalibr.name})"
        return LensStart(kalibr.model, f"from {source}", kalibr.intrinsics, kalibr.distortion or None, source)
    info = inspection.facts[name].info
    if info is None or camera.info is None:
        why = "for lenses of up to about 100 deg; for a fisheye: pinhole-equidistant"
        if (view := inspection.facts[name].view) is not None and view.model is not None:
            errors = ", ".join(f"{model} {error:.2g}" for model, error in view.errors_px.items())
            is_best = view.errors_px[view.model] == min(view.errors_px.values())
            fit = "fits the corners best" if is_best else "fits the corners about as well as the other"
            return LensStart(view.model, f"{fit}, RMS [px]: {errors}", notes=tuple(notes))
        return LensStart(DEFAULT_MODEL, why, notes=tuple(notes))
    return _from_info(info, camera, camera.info.name, resolution, notes)


def _from_info(
    info: CameraInfo, camera: CameraSource, topic: str, resolution: tuple[int, int] | None, notes: list[str]
) -> LensStart:
    model = _model(info)
    why = f"from {topic} ({info.model or 'no distortion_model'})"
    K = info.K
    intrinsics = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    if camera.images is not None and "rect" in camera.images.name.lower():
        notes.append(f"values of {topic} are for the unrectified images and are not used; prefer the raw images")
    elif not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        notes.append(f"{topic} holds no intrinsics")
    elif info.resolution != resolution:
        notes.append(f"values of {topic} are for {_size(info.resolution)} px and are not used")
    else:
        distortion = _distortion(info, model)
        if distortion is None:
            notes.append(f"the distortion in {topic} is of another model and is not used")
        return LensStart(model, why, tuple(map(float, intrinsics)), distortion, topic, tuple(notes))
    return LensStart(model, why, notes=tuple(notes))


def _model(info: CameraInfo) -> str:
    """The simplest model for all coefficients, which OpenCV orders k1, k2, p1, p2, k3, k4, k5, k6, ..."""
    if info.model in _FISHEYES:
        return FISHEYE_MODEL
    if info.model not in _BROWN or len(info.distortion) < 5:
        return DEFAULT_MODEL
    return "pinhole-rational" if np.any(info.distortion[5:8]) else "pinhole-radtan5"


def _distortion(info: CameraInfo, model: str) -> Values | None:
    """The distortion in the order of `model`; None if a coefficient that is not zero does not belong to it."""
    size = len(camera_model(model).parameter_names) - 4
    known = info.model in (*_BROWN, *_FISHEYES)
    if not known or len(info.distortion) < size or np.any(info.distortion[size:]):
        return None
    return tuple(float(x) for x in info.distortion[:size]) if np.isfinite(info.distortion).all() else None


def _kalibr(inspection: Inspection, name: str, camera: CameraSource) -> KalibrCamera | None:
    """Kalibr's entry with the camera's topic. If no entry names a topic of this recording, that with the camera's
    name."""
    topics = {s.topic.name.strip("/") for s in inspection.streams}
    named = any(k.topic.strip("/") in topics for k in inspection.kalibr.cameras)
    topic = camera.images.name.strip("/") if camera.images else None
    matches: Callable[[KalibrCamera], bool] = (
        (lambda k: k.topic.strip("/") == topic) if named else (lambda k: k.name == name)
    )
    return next((k for k in inspection.kalibr.cameras if matches(k)), None)


def _size(resolution: tuple[int, int]) -> str:
    return f"{resolution[0]} x {resolution[1]}"
