"""Columns of the table of an IMU, or of separate tables of its two sensors, and the header names they go by."""

from __future__ import annotations

from dataclasses import replace

from icalib.data.tables.columns import STAMP, TableKind, vector_names
from icalib.sensors.sensor import TableLayout

RATE_HZ = (10.0, 20_000.0)
GYRO = r"w|omega|g|gyro|gyr|gyros|gyroscope|angular_(velocity|vel|rate)|ang_?vel|rotation_rate|w_rs_s"
ACCEL = r"a|acc|accel|acceleration|accelerometer|alpha|linear_(acceleration|accel|acc)|lin_acc|specific_force|f|a_rs_s"

IMU = TableKind(
    ("t [ns]",),
    ("wx [rad/s]", "wy [rad/s]", "wz [rad/s]", "ax [m/s^2]", "ay [m/s^2]", "az [m/s^2]"),
    (STAMP, *vector_names(GYRO), *vector_names(ACCEL)),
    RATE_HZ,
)
# Separate tables of gyroscope and accelerometer.
IMU_GYRO, IMU_ACCEL = (
    TableKind(
        IMU.integers,
        decimals,
        (STAMP, *((*names, axis) for names, axis in zip(known, "xyz", strict=True))),
        IMU.rate_hz,
    )
    for decimals, known in ((IMU.decimals[:3], IMU.known[1:4]), (IMU.decimals[3:], IMU.known[4:]))
)

# Types of tables, as of `TopicInfo`, and what each has.
WHOLE, GYRO_TABLE, ACCEL_TABLE = "table of readings", "table of angular rates", "table of accelerations"
CARRIED = {WHOLE: "both", GYRO_TABLE: "gyro", ACCEL_TABLE: "accel"}


def half_layouts(layout: TableLayout) -> tuple[TableLayout, TableLayout]:
    """Layouts of separate tables of gyroscope and accelerometer. Four `columns` hold for both; seven are in the order
    of a single table. A stamp in two columns makes one more."""
    columns, stamps = layout.columns, len(layout.columns) - 6
    if stamps < 1:
        return layout, layout
    accel = columns[:stamps] + columns[stamps + 3 :]
    return replace(layout, columns=columns[: stamps + 3]), replace(layout, columns=accel)
