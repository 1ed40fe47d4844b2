"""Detections of the target in images: their number, coverage of the image, tilts and distances."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.data.recordings import Recording
from icalib.detection.boards.board_diagnosis import checkerboard_in
from icalib.detection.boards.diagnosis import tags_in
from icalib.errors import RecordingError
from icalib.geometry.targets import Target
from icalib.sensors.camera.inspect.facts import CameraSource, TargetView
from icalib.sensors.camera.read import corners as recorded_corners
from icalib.sensors.camera.read.detected_corners import find_corners
from icalib.sensors.camera.spec import Camera
from icalib.tools.inspection.facts import Inspection

GRID = (8, 5)  # columns and rows of cells over the image
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
            corners, notes = find_corners(recording, camera, target, progress=progress)
    except RecordingError as error:
        return TargetView(name, None, 0, 0, None, None, None, problem=str(error))
    count = np.diff(corners.start)
    tilt, ratio = _poses(corners, target)
    return TargetView(
        name,
        images=None if tabled else len(count),
        seen=int((count > 0).sum()),
        corners=len(corners.uv),
        cells=coverage(corners.uv, resolution) if resolution else None,
        tilt_deg=tilt,
        distance_ratio=ratio,
        notes=notes,
    )


def target_in(images: Iterable[np.ndarray]) -> str:
    """Words on the tags or the checkerboard in images (h, w) uint8; "" for neither."""
    grey = list(images)
    return tags_in(grey) or checkerboard_in(grey)


def coverage(uv: np.ndarray, resolution: tuple[int, int]) -> tuple[tuple[int, ...], ...]:
    """Number of corners uv (N, 2) [px] in each cell of an image of `resolution` (width, height): GRID[1] rows of
    GRID[0] cells."""
    cell = np.floor((uv + 0.5) / resolution * GRID).astype(np.int64)
    col, row = np.clip(cell, 0, np.array(GRID) - 1).T
    counts = np.bincount(row * GRID[0] + col, minlength=GRID[0] * GRID[1]).reshape(GRID[1], GRID[0])
    return tuple(tuple(int(n) for n in line) for line in counts)


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
