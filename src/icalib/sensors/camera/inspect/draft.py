"""Lines of a camera in a draft of the rig file."""

from __future__ import annotations

from collections.abc import Iterable

from icalib.geometry.cameras import CAMERA_MODELS
from icalib.sensors.camera.inspect.facts import CameraSource, without_target
from icalib.sensors.camera.inspect.lens import LensStart, lens_start
from icalib.sensors.camera.inspect.views import resolution_of
from icalib.tools.inspection.facts import Inspection
from icalib.tools.inspection.rig_lines import comment, name_text, numbers, place_line


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
