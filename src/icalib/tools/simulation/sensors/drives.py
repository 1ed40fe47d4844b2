"""Trajectories of a robot through its room, in closed form, for the kinds of motion in `Drive`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from icalib.errors import RecordingError
from icalib.tools.simulation.scenario.robot import Drive
from icalib.tools.simulation.scenario.room import Room
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory
from icalib.tools.simulation.sensors.ground import ground_motion
from icalib.tools.simulation.sensors.motion import Reference, Waves, basis_with_z
from icalib.tools.simulation.sensors.recorded import recorded_motion

_HEIGHT = 0.45  # height of the middle of a free motion, relative to the room's
_SHIFT = np.array([[0.20, 0.20, 0.12], [0.02, 0.02, 0.035]])  # amplitudes, slow and fast, relative to the room's sides
_SHIFT_HZ = np.array([[0.05, 0.08], [0.30, 0.45]])
_ANGLES_RAD = np.array([[1.2, 0.22, 0.22], [0.30, 0.14, 0.14]])  # yaw, pitch, roll
_ANGLES_HZ = np.array([[0.06, 0.10], [0.30, 0.50]])
_AXIS_RAD = np.array([[1.2, 0.0, 0.0], [0.30, 0.0, 0.0]])
_CHECK_S = 0.05
_GROUND_BELOW_IMU = np.array([0.0, 0.0, -0.3])  # m, origin of the wheel frame in the IMU frame, if there are no wheels


def drive_motion(
    drive: Drive, room: Room, T_imu_wheel: np.ndarray | None, duration_s: float, rng: np.random.Generator
) -> TrueTrajectory:
    """The trajectory of `drive`, with phases drawn from `rng`. T_imu_wheel (4, 4): pose of the wheel frame, None for a
    frame 0.3 m below the IMU.

    Raises RecordingError if a recorded motion cannot be read, is too short, or leaves the room.
    """
    if drive.on_ground:
        if T_imu_wheel is None:
            T_imu_wheel = np.eye(4)
            T_imu_wheel[:3, 3] = _GROUND_BELOW_IMU
        return ground_motion(drive, room, T_imu_wheel, duration_s, rng)
    center = np.array([0.0, 0.0, _HEIGHT * room.size[2]])
    if drive.path is not None:
        return _within(room, recorded_motion(drive.path, duration_s, center), drive.path, duration_s)
    basis, angles = np.eye(3), _ANGLES_RAD
    if drive.kind == "single-axis":
        basis, angles = basis_with_z(np.array(drive.axis_imu)), _AXIS_RAD
    turns, shifts = _waves(angles, _ANGLES_HZ, rng), _waves(_SHIFT * room.size, _SHIFT_HZ, rng)
    return Reference(basis, basis.T, center, np.eye(3), turns, shifts)


def _within(room: Room, motion: TrueTrajectory, path: Path, duration_s: float) -> TrueTrajectory:
    _, position, _ = motion.pose_at(np.arange(0.0, duration_s, _CHECK_S))
    x, y, z = room.size
    if (position < [-0.5 * x, -0.5 * y, 0.0]).any() or (position > [0.5 * x, 0.5 * y, z]).any():
        sides = " x ".join(f"{side:.1f}" for side in np.ptp(position, axis=0))
        raise RecordingError(f"{path} reaches over {sides} m and leaves the room; give the room a larger size.")
    return motion


def _waves(amplitude: np.ndarray, band_hz: np.ndarray, rng: np.random.Generator) -> Waves:
    frequency = rng.uniform(band_hz[:, :1], band_hz[:, 1:], amplitude.shape)
    return Waves(amplitude, frequency, rng.uniform(0.0, 2.0 * np.pi, amplitude.shape))
