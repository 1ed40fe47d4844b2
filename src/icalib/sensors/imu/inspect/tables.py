"""Tables of IMUs for the terminal."""

from __future__ import annotations

from collections.abc import Mapping

from rich.table import Table
from rich.text import Text

from icalib.sensors.imu.inspect.facts import ImuFacts
from icalib.tools.inspection.console import plain_table
from icalib.tools.inspection.facts import Vector


def imu_table(facts: Mapping[str, ImuFacts]) -> Table:
    """One row for each axis of each IMU; facts: by name."""
    table = plain_table(
        "IMU",
        ("sensor", "axis", "gyro [rad/s]", "RMS", "accel [m/s^2]", "RMS about mean", "saturated"),
        right=2,
        caption="; ".join(f"{n}: mean |accel| {f.mean_accel:.2f} m/s^2" for n, f in facts.items()),
    )
    for name, f in facts.items():
        for k, axis in enumerate("xyz"):
            saturated = ", ".join(f"{s.kind} at {s.limit:.4g}" for s in f.saturated if s.axis == axis)
            cells = (
                name if k == 0 else "",
                axis,
                _range(f.gyro_min, f.gyro_max, k),
                f"{f.gyro_rms[k]:.3f}",
                _range(f.accel_min, f.accel_max, k),
                f"{f.accel_std[k]:.2f}",
                saturated or "no",
            )
            table.add_row(*map(Text, cells), end_section=k == 2)
    return table


def _range(low: Vector, high: Vector, k: int) -> str:
    return f"{low[k]:.2f} to {high[k]:.2f}"
