"""The first guess: what each stage found, handed on whole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class BoardPoses:
    """Where a camera was in front of the board, image by image; entries of images that are not ok mean nothing."""

    R_board_cam: np.ndarray  # (M, 3, 3)
    p_board_cam: np.ndarray  # (M, 3) m
    ok: np.ndarray  # (M,) bool


@dataclass(frozen=True)
class CameraGuess:
    """First guess of one camera.

    time_offset_s: t_imu = t_cam + time_offset_s on the stamps as recorded. relative_offset: the same between the two
    relative clocks, each in seconds since its stream's own first stamp; exact where the former is too large for
    float64.
    """

    intrinsics: np.ndarray  # (4,) fx, fy, cx, cy in px
    distortion: np.ndarray  # (P - 4,)
    R_imu_cam: np.ndarray  # (3, 3)
    p_imu_cam: np.ndarray  # (3,) m
    time_offset_s: float
    relative_offset: float
    poses: BoardPoses


@dataclass(frozen=True)
class Guess:
    """First guess of everything. World: gravity-aligned, z up, origin at the board's origin, board x at yaw 0."""

    cameras: dict[str, CameraGuess]
    gyro_bias: np.ndarray  # (3,) rad/s
    accel_bias: np.ndarray  # (3,) m/s^2
    R_world_board: np.ndarray  # (3, 3)
    notes: tuple[str, ...] = ()  # what could not be found and was set to something sensible, one sentence each
