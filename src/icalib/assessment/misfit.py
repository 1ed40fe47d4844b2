"""Sensors whose residuals are not what the rig file says of their noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.assessment.cameras import camera_warnings
from icalib.assessment.robot import robot_warnings
from icalib.calibration import SensorFit
from icalib.calibration.excess import dof_known, excess, times
from icalib.rig import Rig

SMALL_CHI2 = 0.5  # per post-fit degree of freedom: below this it is worth a warning
# Times as large as their noise. With IMU noise ten times too small, in simulation, residuals are 3 to 5 times as large,
# and errors up to 12 standard deviations.
FAR_BEYOND = 4.0


def misfits(rig: Rig, judged: Sequence[SensorFit]) -> Iterator[str]:
    """What residuals say against the rig file, one sentence each."""
    for f in judged:
        if f.kind in ("gyroscope", "accelerometer"):
            yield from _imu_noise_warnings(f)
    yield from camera_warnings(rig, judged)
    yield from robot_warnings(rig, judged)


def far_beyond(rig: Rig, judged: Sequence[SensorFit]) -> tuple[str, ...]:
    """Those of `misfits` with which standard deviations mean nothing."""
    return tuple(misfits(rig, [f for f in judged if excess(f) >= FAR_BEYOND]))


def _imu_noise_warnings(f: SensorFit) -> Iterator[str]:
    ratio = f.chi2 / max(f.dof, 1.0)
    if excess(f) > 1.0:
        size, word = times(f), "larger"
    elif dof_known(f) and ratio < SMALL_CHI2:
        size, word = f"{np.sqrt(ratio):.2g} times", "smaller"
    else:
        return
    yield (
        f"the {f.kind} of {f.sensor} leaves residuals {size} as large as its noise in the rig file says; a {word} "
        "noise density would fit."
    )
