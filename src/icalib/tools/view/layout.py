"""Layout of the viewer's windows: world, rig, cameras, and curves over time."""

from __future__ import annotations

from typing import Any

from icalib.result import Calibration
from icalib.tools.view.scene import place
from icalib.tools.view.stream import TIMELINE


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
