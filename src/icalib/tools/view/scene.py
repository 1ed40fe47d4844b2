"""Layout of the viewer's windows: world, rig, cameras, and curves over time.

The result in 3D: the rig and its uncertainty, the trajectory, the target, and points on planes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from icalib.geometry.targets import target_from_plain
from icalib.report import rig_shapes
from icalib.report.ellipsoids import SIGMAS, VERDICT_COLORS, ellipsoids, magnification
from icalib.report.plot import COLORS
from icalib.report.residual_views import ResidualCloud
from icalib.result import Calibration, RecordingSpan
from icalib.sensors import call_all_kinds
from icalib.tools.view.stream import TIMELINE, RerunStream, by_value, rgb


def blueprint(rr: Any, c: Calibration, readings: bool) -> Any:
    """Rerun's blueprint of the windows. rr: the rerun package; readings: whether IMU readings are shown."""
    b = rr.blueprint
    images = [b.Spatial2DView(origin=f"{place(c, name)}/image", name=name) for name in c.lenses]
    rig = b.Spatial3DView(origin=f"world/{c.reference}", name="rig")
    plots = [b.TimeSeriesView(origin=f"residuals/{name}", name=f"residuals of {name}") for name in _measured(c)]
    if c.imu is not None:
        plots.append(b.TimeSeriesView(origin="motion", name="motion"))
    if readings and c.imu is not None:
        plots.append(b.TimeSeriesView(origin=f"readings/{c.imu}", name=f"readings of {c.imu}"))
    right = b.Vertical(b.Tabs(rig, b.TextDocumentView(origin="summary", name="summary")), *images[:2])
    # Points on planes have a view of their own, as they would hide moving sensors.
    space = [b.Spatial3DView(origin="world", contents=["$origin/**", "- $origin/planes/**"], name="world")]
    if c.planes:
        parts = [f"$origin/{part}/**" for part in ("planes", "target", "trajectory")]
        space.append(b.Spatial3DView(origin="world", contents=parts, name="planes"))
    left = b.Vertical(b.Tabs(*space), b.Tabs(*plots), row_shares=[3, 1])
    more = [b.Tabs(*images[2:])] if images[2:] else []
    return b.Blueprint(
        b.Horizontal(left, right, *more, column_shares=[3, 2, 1][: 2 + len(more)]),
        b.TimePanel(timeline=TIMELINE, state="collapsed"),
        collapse_panels=True,
    )


def _measured(c: Calibration) -> list[str]:
    """Names of sensors with residuals over time, the IMU last."""
    names = dict.fromkeys(r.sensor for r in c.residuals.values() if len(r.seconds))
    return sorted(names, key=lambda name: name == c.imu)


POINT = 1.5  # radius of a point of a scan, in screen points
_TARGET, _TRAJECTORY = "#be185d", "#64748b"
_WORST_OF_SCALE = 4.0  # residual at the top of the colour scale, in RMS of the residuals


def place(c: Calibration, sensor: str) -> str:
    """Rerun's entity path of a sensor: the body is below the world, all other sensors are below the body."""
    return f"world/{sensor}" if sensor == c.reference else f"world/{c.reference}/{sensor}"


def spans(c: Calibration) -> tuple[RecordingSpan, ...]:
    """The recordings of the result; one span without a name if the result does not list them."""
    ends = c.trajectory.seconds[[0, -1]].tolist()
    return c.recordings or (RecordingSpan("", ends[0], ends[1], 0),)


def log_rig(s: RerunStream, c: Calibration) -> None:
    """Sends frames and shapes of all sensors, at constant poses relative to the body."""
    spread = rig_shapes.spread_of(c)
    for name, T in rig_shapes.frames_of(c).items():
        s.still(place(c, name), s.rr.TransformAxes3D(0.25 * spread))
        if name != c.reference:
            s.still(place(c, name), s.rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
    for name in c.lenses:
        s.still(f"{place(c, name)}/image", _pinhole(s, c, name, 0.45 * spread))
    others = [name for name in c.mounted if name not in c.lenses]
    shapes = [(name, pen) for name in others if (pen := rig_shapes.shape_of(c, name)) is not None]
    for i, (name, pen) in enumerate(shapes):
        strips = s.rr.LineStrips3D(_strips(pen), colors=rgb(COLORS[i % len(COLORS)]))
        s.still(f"{place(c, name)}/shape", strips)


def _pinhole(s: RerunStream, c: Calibration, name: str, depth: float):
    """Rerun's pinhole camera, without distortion. In Rerun pixel (0, 0) is the corner of the image, in icalib the
    centre of the first pixel. depth [m]: distance of the drawn image."""
    fx, fy, cx, cy = c.group(name, "intrinsics").value
    return s.rr.Pinhole(
        resolution=c.rig["sensors"][name]["resolution"],
        focal_length=(fx, fy),
        principal_point=(cx + 0.5, cy + 0.5),
        image_plane_distance=depth,
    )


def log_uncertainty(s: RerunStream, c: Calibration) -> None:
    """Sends the uncertainty ellipsoids of positions, with a common magnification, coloured by verdict."""
    factor = magnification(c)
    for e in ellipsoids(c):
        ellipsoid = s.rr.Ellipsoids3D(
            half_sizes=[factor * e.half_sizes],
            centers=[c.group(e.sensor, "translation").value],
            quaternions=[Rotation.from_matrix(e.axes).as_quat()],
            colors=rgb(VERDICT_COLORS[e.verdict]),
            labels=[f"{e.sensor}: {SIGMAS:g} sigma x {factor:g}"],
            show_labels=False,
        )
        s.still(f"world/{c.reference}/uncertainty/{e.sensor}", ellipsoid)


def log_motion(s: RerunStream, c: Calibration) -> None:
    """Sends the pose of the reference sensor at each keyframe, and the whole trajectory of each recording."""
    path = c.trajectory
    s.still("world", s.rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    s.over(
        f"world/{c.reference}",
        path.seconds,
        s.rr.Transform3D.columns(translation=path.position, mat3x3=path.rotation.reshape(-1, 9)),
    )
    of = c.recording_of(path.seconds)
    for k, span in enumerate(spans(c)):
        s.at("world/trajectory", span.start, s.rr.LineStrips3D([path.position[of == k]], colors=rgb(_TRAJECTORY)))


def log_target(s: RerunStream, c: Calibration) -> None:
    """Sends outline and points of each body of the target. The target has one orientation in the world per
    recording."""
    target, orientations = target_from_plain(c.rig), rig_shapes.scene_in_worlds(c)
    if target is None or not orientations:
        return
    for span, (_, R) in zip(spans(c), orientations, strict=False):
        s.at("world/target", span.start, s.rr.Transform3D(mat3x3=R))
    for body in c.bodies or target.bodies:
        k, T = target.bodies.index(body), c.T_scene_body(body) if c.bodies else np.eye(4)
        entity = f"world/target/{body}"
        s.still(entity, s.rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        outline = _strips(rig_shapes.body_outline(target, k))
        s.still(f"{entity}/outline", s.rr.LineStrips3D(outline, colors=rgb(_TARGET)))
        s.still(f"{entity}/points", s.rr.Points3D(target.points[target.body == k], colors=rgb(_TARGET)))


def log_planes(s: RerunStream, c: Calibration) -> None:
    """Sends the measured points that belong to planes, coloured by the size of their residuals."""
    cloud: ResidualCloud
    for cloud in call_all_kinds("show", "clouds", c):
        of, size = c.recording_of(cloud.seconds), cloud.size
        top = _WORST_OF_SCALE * float(np.sqrt(np.mean(size**2))) if len(size) else 1.0
        for k, span in enumerate(spans(c)):
            rows = of == k
            colors, radius = by_value(size[rows], 0.0, top), s.rr.Radius.ui_points(POINT)
            points = s.rr.Points3D(cloud.points[rows], colors=colors, radii=radius)
            s.at(f"world/planes/{cloud.sensor}", span.start, points)


def _strips(pen: np.ndarray) -> list[np.ndarray]:
    """Polylines from points (N, 3), in which a row of NaN separates two lines."""
    up = np.isnan(pen[:, 0])
    pieces = np.split(pen, np.flatnonzero(up))
    return [p for piece in pieces if len(p := piece[~np.isnan(piece[:, 0])]) > 1]
