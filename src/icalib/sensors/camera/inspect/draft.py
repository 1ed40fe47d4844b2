"""Lines of a camera in a draft of the rig file.

Camera model and initial values in a draft of the rig file: from Kalibr's camchain, else from CameraInfo.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from icalib.geometry.cameras import CAMERA_MODELS, camera_model
from icalib.sensors.camera.inspect.facts import CameraSource, resolution_of, without_target
from icalib.sensors.camera.read.camera_info import CameraInfo
from icalib.tools.inspection.facts import Inspection
from icalib.tools.inspection.kalibr import KalibrCamera
from icalib.tools.inspection.kinds import comment, name_text, numbers, place_line


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


DEFAULT_MODEL = "pinhole-radtan"
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
        notes.append(f"{topic} is for the unrectified images and is not used; prefer the raw images")
    elif not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        notes.append(f"{topic} holds no intrinsics")
    elif info.resolution != resolution:
        notes.append(f"{topic} is for {_size(info.resolution)} px and is not used")
    else:
        distortion = _distortion(info, model)
        if distortion is None:
            notes.append(f"the distortion in {topic} is of another model and is not used")
        return LensStart(model, why, tuple(map(float, intrinsics)), distortion, topic, tuple(notes))
    return LensStart(model, why, notes=tuple(notes))


def _model(info: CameraInfo) -> str:
    """The simplest model for all coefficients, which OpenCV orders k1, k2, p1, p2, k3, k4, k5, k6, ..."""
    if info.model in _FISHEYES:
        return "pinhole-equidistant"
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
