"""Columns of the table of an IMU, or of separate tables of its two sensors, and the header names they go by."""

from __future__ import annotations

from icalib.data.tables.columns import STAMP, TableKind, vector_names

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
