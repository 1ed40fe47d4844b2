"""Time offset and rotation of one camera relative to the IMU, from angular rates and values of the rig file."""

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


def chosen_offset(
    camera: Camera, rates: SensorRates, imu: ImuData, given: float | None, alignment: RateAlignment
) -> float:
    """The time offset [s] to start from: the value `given` by the rig file, or the estimate in `alignment`.

    Both are t_imu - t_camera, with each clock counted from its first stamp. A fixed value, or one with a prior, is
    kept. An initial guess far from the estimate is replaced only if the angular `rates` of the camera contradict it,
    because slow motion hardly determines an offset.
    """
    if given is None:
        return alignment.offset
    far = is_contradicted(TIME_OFFSET, np.array([given]), np.array([alignment.offset]))
    if known_value(camera.time_offset) is not None or not far:
        return given
    try:
        at_given = alignment_as_stated(imu, camera.name, rates, given, alignment.rotation)
    except EstimationError:  # the clocks do not overlap
        return alignment.offset
    return alignment.offset if rates_contradict(imu, rates, at_given) else given


def align_camera(
    camera: Camera, stream: CornerStream, rates: SensorRates, imu: ImuData, measurements: Measurements
) -> RateAlignment:
    """Rotation, time offset and gyroscope bias of `camera` from its angular `rates` and those of the IMU.

    Values of the rig file that are fixed or have a prior take precedence over the estimate. An initial guess of the rig
    file is used if the motion does not determine the value. Raises EstimationError if neither determines it.
    """
    alignment = _aligned_by_rates(camera, stream, rates, imu, measurements)
    offset, rotation = camera.time_offset.value, camera.rotation.value
    if rotation is None or (known_value(camera.rotation) is None and turns_about_two_axes(imu, rates, alignment)):
        return alignment
    at_given = alignment_as_stated(imu, camera.name, rates, alignment.offset, rotation)
    if offset is not None and known_value(camera.time_offset) is None:
        at_given = better_at_offset(imu, camera.name, rates, at_given, relative_offset(offset, stream, measurements))
    if known_value(camera.rotation) is not None or alignment.given or not rates_contradict(imu, rates, at_given):
        return at_given
    # The rates determine the rotation except about one axis. Only that component is taken from the guess.
    nearest = nearest_about_axis(main_axis(rates.rate), rotation, alignment.rotation)
    return better_alignment(
        imu, rates, at_given, alignment_as_stated(imu, camera.name, rates, alignment.offset, nearest)
    )


def _aligned_by_rates(
    camera: Camera, stream: CornerStream, rates: SensorRates, imu: ImuData, measurements: Measurements
) -> RateAlignment:
    """The alignment by angular rates.

    It has the time offset of the rig file if that is fixed or has a prior, or if the rates do not determine one. If
    they do not determine the rotation either, that of the rig file is used. Raises EstimationError if there is no such
    value, or the rates contradict it.
    """
    given, known = camera.time_offset.value, known_value(camera.time_offset)
    rotation, on_wheels = camera.rotation.value, bool(measurements.wheels)
    try:
        offset = None if known is None else relative_offset(known, stream, measurements)
        alignment = align_rates(imu, camera.name, rates, offset)
        if rotation is None:
            check_two_axes(imu, rates, alignment, camera.name, on_wheels)
    except EstimationError:
        if given is None:
            raise
        offset = relative_offset(given, stream, measurements)
        if rotation is None:
            alignment = align_rates(imu, camera.name, rates, offset)
            check_two_axes(imu, rates, alignment, camera.name, on_wheels)
        else:
            alignment = alignment_as_stated(imu, camera.name, rates, offset, rotation)
            if rates_contradict(imu, rates, alignment):
                raise
    return alignment
