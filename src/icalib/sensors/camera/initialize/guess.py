"""The initial guess of cameras: calibration parameters, biases and camera poses.

Time offset and rotation of one camera relative to the IMU, from angular rates and values of the rig file.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from icalib.data.measurements import CornerStream, Measurements, TrackStream
from icalib.errors import EstimationError
from icalib.geometry.targets.base import BOARD
from icalib.initialize.steps.contradicted_guesses import is_contradicted, known_value, nearest_about_axis
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
from icalib.motion.imu_data import ImuData
from icalib.optim.state import Key
from icalib.rig import Camera
from icalib.sensors.camera.initialize.boards.target_poses import TargetPoses
from icalib.sensors.sensor import TIME_OFFSET

# s; images closer in time count as simultaneous. Clocks synchronised by hardware agree to microseconds, and no camera
# takes images at 10 kHz.
MIN_IMAGE_SPACING_S = 1e-4


@dataclass(frozen=True)
class CameraGuess:
    """Initial guess of one camera.

    params: (P,) intrinsics and distortion, in the order of the camera model.
    offset: t_body - t_camera [s], each clock counted from its first stamp.
    rotation, position: R_body_cam (3, 3) and p_body_cam (3,) [m].
    poses: T_target_cam of each image; T_world_cam for a guess from feature tracks.
    """

    params: np.ndarray
    offset: float
    rotation: np.ndarray
    position: np.ndarray
    poses: TargetPoses


@dataclass(frozen=True)
class Guess:
    """Initial guess of all cameras of a rig, for one recording.

    gyro_bias: (3,) [rad/s]; accel_bias: (3,) [m/s^2].
    R_world_board: (3, 3) attitude of the target; world z is up, and both frames have the same origin. The identity
    without an IMU, and for a guess from feature tracks.
    scene: poses T_target_body of the target's bodies as in a state, keyed by body and parameter; empty for one body.
    """

    cameras: dict[str, CameraGuess]
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    R_world_board: np.ndarray
    scene: dict[Key, np.ndarray] = field(default_factory=dict)

    def values(self) -> dict[Key, np.ndarray]:
        """The calibration parameters as in a state, keyed by sensor (or body) and parameter."""
        out: dict[Key, np.ndarray] = self.scene | {(BOARD, "tilt"): self.R_world_board}
        for name, c in self.cameras.items():
            out[name, "rotation"], out[name, "translation"] = c.rotation, c.position
            out[name, "time_offset"] = np.array([c.offset])
            out[name, "intrinsics"], out[name, "distortion"] = c.params[:4], c.params[4:]
        return out

    def biases(self, n: int) -> np.ndarray:
        """(n, 6) gyroscope and accelerometer biases, the same at all n keyframes."""
        return np.tile(np.concatenate([self.gyro_bias, self.accel_bias]), (n, 1))

    def body_poses(self, measurements: Measurements) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poses of the body in the world, from the images of all cameras that have a pose.

        Returns instants (n,) [s] on the body's clock, strictly increasing, R_world_body (n, 3, 3) and p_world_body
        (n, 3) [m]. Images at most `MIN_IMAGE_SPACING_S` after another one are left out.
        """
        times, rotations, positions = [], [], []
        for stream in measurements.cameras:
            c = self.cameras[stream.name]
            ok = c.poses.ok
            R = c.poses.rotation[ok] @ c.rotation.T
            times.append(stream.seconds[ok] + c.offset)
            rotations.append(self.R_world_board @ R)
            positions.append((c.poses.position[ok] - R @ c.position) @ self.R_world_board.T)
        t = np.concatenate(times)
        order = np.argsort(t, kind="stable")
        order = order[np.diff(t[order], prepend=-np.inf) > MIN_IMAGE_SPACING_S]
        return t[order], np.concatenate(rotations)[order], np.concatenate(positions)[order]


def relative_offset(value: np.ndarray, stream: CornerStream | TrackStream, measurements: Measurements) -> float:
    """Converts a time offset `value` (1,) [s] between raw stamps to one between clocks counted from first stamps.

    The clocks are those of `stream` and of the body, whose first stamp is `measurements.origin_ns`.
    """
    return float(value[0]) + (stream.origin_ns - measurements.origin_ns) * 1e-9


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
