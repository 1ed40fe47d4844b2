"""Findings on IMUs: units, motion and gaps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.motion.axes import axis_words, other_axes
from icalib.sensors.imu.inspect.facts import ImuFacts
from icalib.tools.inspection.facts import Finding, Inspection, imu_timing, words_on_gaps
from icalib.tools.inspection.kinds import independent, inertial, moving, problem_of, rolls

STILL_RAD_S = 0.03  # RMS rate below which the IMU is at rest
WEAK_RAD_S = 0.1  # RMS rate about one axis: below it, parameters about this axis are weakly observable
SECOND_AXIS = 0.05  # smallest ratio of the second principal rate to the first; `calibrate` refuses less
WEAK_M_S2 = 0.3  # RMS of the specific force about its mean, below which a warning is given
FASTEST_RAD_S = 12.0  # largest rate of a rig that is turned by hand
DEGREE = np.pi / 180.0
LIKELIER = 0.7  # rates are in deg/s if the spread of gravity is less than this times that for rad/s,
EXPLAINED = 0.95  # and less than this times the spread without rotation
SHORT_S = 20.0  # shortest recording without a warning


def refused(inspection: Inspection) -> Iterator[Finding]:
    """IMUs that cannot be used: problems if no other IMU remains, else warnings."""
    for name in inertial(inspection):
        if problem := problem_of(inspection, name):
            is_fatal = inspection.imu is None or inspection.imu == name
            yield Finding("problem" if is_fatal else "warning", problem)


def of_readings(inspection: Inspection) -> Iterator[Finding]:
    """Units and motion of the IMU to calibrate with."""
    if inspection.imu is None or inspection.facts[inspection.imu].problem:
        return
    facts, name = inspection.facts[inspection.imu], inspection.imu
    yield from (Finding("warning", _capital(note)) for note in facts.notes)
    fast = max(*map(abs, facts.gyro_min), *map(abs, facts.gyro_max))
    radians, degrees, none = facts.gravity_spread or (0.0, 0.0, 0.0)
    if degrees < LIKELIER * radians and degrees < EXPLAINED * none:
        yield Finding(
            "problem",
            f"{name}: the angular rates look like deg/s, for gravity rotates accordingly in the accelerometer; "
            "set gyro_unit: deg/s in the rig file.",
        )
        return
    if fast > FASTEST_RAD_S:
        yield Finding(
            "warning",
            f"{name} turns at up to {fast:.1f} rad/s ({fast / DEGREE:.0f} deg/s), which blurs images; turn the "
            "rig more slowly, or check that the driver sends rad/s.",
        )
    yield from _motion(inspection, name, facts)


def _motion(inspection: Inspection, name: str, facts: ImuFacts) -> Iterator[Finding]:
    strongest, second, weakest = facts.principal_rms
    if strongest < STILL_RAD_S:
        yield Finding(
            "problem",
            f"{name} hardly moves ({strongest:.3f} rad/s RMS); record again while turning the rig about all "
            f"three axes{' in front of the target' if independent(inspection) else ''}.",
        )
    elif second < SECOND_AXIS * strongest or second < STILL_RAD_S:
        # Rotations of cameras are found from rotations of the rig alone; those of other sensors from its path as well.
        is_fatal = not moving(inspection)
        rest = other_axes(name, facts.principal[0])
        yield Finding(
            "problem" if is_fatal else "warning",
            f"{name} turns about {axis_words(name, facts.principal[0])} only ({strongest:.2f} rad/s RMS; "
            f"{second:.2f} and {weakest:.2f} about the perpendicular axes), so some parameters are "
            "unobservable; "
            f"{'drive over ramps' if rolls(inspection) else f'turn the rig about {rest} as well'}.",
        )
    else:
        for rms, direction in zip(facts.principal_rms, facts.principal, strict=True):
            if rms < WEAK_RAD_S:
                yield Finding(
                    "warning",
                    f"Hardly any rotation about {axis_words(name, direction)} ({rms:.2f} rad/s RMS); turn the rig "
                    "about it as well.",
                )
    if strongest >= STILL_RAD_S and max(facts.accel_std) < WEAK_M_S2:
        yield Finding(
            "warning",
            f"Hardly any acceleration of {name} ({max(facts.accel_std):.2f} m/s^2 RMS about the mean); shake "
            "the rig briskly back and forth, along all three axes.",
        )


def gaps(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on a short recording, and on gaps between readings."""
    imu = imu_timing(inspection)
    if imu is not None and imu.rate_hz and imu.duration_s < SHORT_S:
        yield Finding("warning", f"The IMU ran for {imu.duration_s:.1f} s; record for 30 to 90 s.")
    if imu is not None and imu.gaps:
        yield Finding(
            "warning", f"{inspection.imu} has {words_on_gaps(imu)}; check the load of the recorder and the bus."
        )


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:] if sentence[:1].isalpha() else sentence
