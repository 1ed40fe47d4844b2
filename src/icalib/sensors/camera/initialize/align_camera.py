"""One camera against the IMU: time offset and rotation, as far as the rig file leaves them open."""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.initialize.steps.contradicted_guesses import is_contradicted, nearest_about_axis
from icalib.initialize.steps.rate_alignment import (
    RateAlignment,
    align_rates,
    alignment_as_stated,
    better_alignment,
    better_at_offset,
    check_two_axes,
    main_axis,
    rates_contradict,
    turns_about_two_axes,
)
from icalib.initialize.steps.rate_correlation import SensorRates
from icalib.initialize.steps.rig_file_values import known_value
from icalib.motion.imu_data import ImuData
from icalib.rig import Camera
from icalib.sensors.camera.initialize.guess import relative_offset
from icalib.sensors.sensor import TIME_OFFSET


def chosen_offset(camera: Camera, rates: SensorRates, imu: ImuData, given: float | None, found: RateAlignment) -> float:
    """What was found, or the guess of the rig file, as an offset between first stamps: a mere guess that is far from
    what was found goes only where the two do not turn alike at it, for slow motion hardly shows an offset."""
    if given is None:
        return found.offset
    far = is_contradicted(TIME_OFFSET, np.array([given]), np.array([found.offset]))
    if known_value(camera.time_offset) is not None or not far:
        return given
    try:
        there = alignment_as_stated(imu, camera.name, rates, given, found.rotation)
    except EstimationError:  # the clocks do not overlap
        return found.offset
    return found.offset if rates_contradict(imu, rates, there) else given


def align_camera(
    camera: Camera, stream: CornerStream, rates: SensorRates, imu: ImuData, measurements: Measurements
) -> RateAlignment:
    """What the motion shows; in its place what the rig trusts, and where it shows nothing what the rig guesses."""
    given, held = camera.time_offset.value, known_value(camera.time_offset)
    rotation = camera.rotation.value
    try:
        found = align_rates(
            imu, camera.name, rates, None if held is None else relative_offset(held, stream, measurements)
        )
        if rotation is None:
            check_two_axes(imu, rates, found, camera.name, bool(measurements.wheels))
    except EstimationError:
        if given is None:
            raise
        at = relative_offset(given, stream, measurements)
        if rotation is None:
            found = align_rates(imu, camera.name, rates, at)
            check_two_axes(imu, rates, found, camera.name, bool(measurements.wheels))
        else:
            found = alignment_as_stated(imu, camera.name, rates, at, rotation)
            if rates_contradict(imu, rates, found):
                raise
    if rotation is None or (known_value(camera.rotation) is None and turns_about_two_axes(imu, rates, found)):
        return found
    own = alignment_as_stated(imu, camera.name, rates, found.offset, rotation)
    if given is not None and held is None:
        own = better_at_offset(imu, camera.name, rates, own, relative_offset(given, stream, measurements))
    if known_value(camera.rotation) is not None or found.given or not rates_contradict(imu, rates, own):
        return own
    # The motion shows all of the rotation but the turn about one axis, and for that alone the guess is needed.
    nearest = nearest_about_axis(main_axis(rates.rate), rotation, found.rotation)
    return better_alignment(imu, rates, own, alignment_as_stated(imu, camera.name, rates, found.offset, nearest))
