"""What an IMU measured: ranges, units, and about which axes it was turned."""

from __future__ import annotations

import numpy as np

from icalib.errors import RecordingError
from icalib.geometry import so3
from icalib.imu_classes import DEFAULT_CLASS, class_noise
from icalib.inspection.facts import ImuFacts, Vector
from icalib.measurements import ImuStream
from icalib.recordings import Recording, TopicInfo
from icalib.recordings.imu_checks import checked_imu, saturations
from icalib.recordings.jumps import ClockJumps
from icalib.rig import ImuSensor

_WINDOW_S, _RATE_HZ = 2.0, 100.0  # over which gravity must stand still; how often it is looked at
_DEGREE = np.pi / 180.0


def read_imu(recording: Recording, name: str, topic: TopicInfo) -> tuple[ImuStream, str]:
    """The readings as they were written, and how a sentence names their place. Raises RecordingError."""
    sensor = ImuSensor(name, topic.name, class_noise(DEFAULT_CLASS), topic=topic.name)
    return recording.imu(sensor), recording.where(sensor)


def imu_facts(imu: ImuStream, where: str, frame: str) -> ImuFacts:
    """Figures of `imu`, and in `problem` why it would be refused, if it would."""
    notes, problem, jumps = (), "", ClockJumps()
    try:
        imu, notes = checked_imu(jumps.cut(imu, f"{where} ({imu.name})"), where)
        notes = jumps.notes + notes
    except RecordingError as error:
        problem = str(error)
    fine = np.isfinite(imu.gyro).all(axis=1) & np.isfinite(imu.accel).all(axis=1)
    gyro, accel = (x[fine] if fine.any() else np.zeros((1, 3)) for x in (imu.gyro, imu.accel))
    # eigh sorts upwards; the strongest direction comes first here.
    squares, directions = np.linalg.eigh(gyro.T @ gyro / len(gyro))
    first, second, third = (_vector(d * np.sign(d[np.argmax(np.abs(d))])) for d in directions.T[::-1])
    return ImuFacts(
        frame=frame,
        gyro_min=_vector(gyro.min(axis=0)),
        gyro_max=_vector(gyro.max(axis=0)),
        accel_min=_vector(accel.min(axis=0)),
        accel_max=_vector(accel.max(axis=0)),
        mean_accel=float(np.linalg.norm(accel, axis=1).mean()),
        gyro_rms=_vector(np.sqrt((gyro**2).mean(axis=0))),
        accel_std=_vector(accel.std(axis=0)),
        principal_rms=_vector(np.sqrt(np.maximum(squares[::-1], 0.0))),
        principal=(first, second, third),
        gravity_spread=None if problem else _spreads(imu),
        saturated=saturations(imu) if fine.all() and len(imu.gyro) else (),
        notes=notes,
        problem=problem,
    )


def gravity_spread(imu: ImuStream, unit: float) -> float | None:
    """RMS [m/s^2] of the specific force about its mean over two seconds, seen from axes that do not turn: small where
    the rates, times `unit` [rad/s], turn as the IMU did. None for less than two seconds.
    """
    t = imu.seconds
    count = int(_WINDOW_S * _RATE_HZ)
    windows = int(t[-1] / _WINDOW_S)
    if windows < 1:
        return None
    at = np.arange(windows * count) / _RATE_HZ
    # Of the integral, so that no rotation is lost between the instants.
    angle = np.zeros((len(t), 3))
    angle[1:] = np.cumsum(0.5 * unit * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(t)[:, None], axis=0)
    turn, force = (
        np.stack([np.interp(at, t, x[:, k]) for k in range(3)], axis=1).reshape(windows, count, 3)
        for x in (angle, imu.accel)
    )
    R = np.tile(np.eye(3), (windows, 1, 1))
    level = np.empty_like(force)
    for k in range(count):
        level[:, k] = np.einsum("nij,nj->ni", R, force[:, k])
        if k + 1 < count:
            R = R @ so3.exp_many(np.ascontiguousarray(turn[:, k + 1] - turn[:, k]))
    return float(np.sqrt(((level - level.mean(axis=1, keepdims=True)) ** 2).sum(axis=2).mean()))


def _spreads(imu: ImuStream) -> Vector | None:
    radians, degrees, none = (gravity_spread(imu, unit) for unit in (1.0, _DEGREE, 0.0))
    return None if radians is None or degrees is None or none is None else (radians, degrees, none)


def _vector(x: np.ndarray) -> Vector:
    return float(x[0]), float(x[1]), float(x[2])
