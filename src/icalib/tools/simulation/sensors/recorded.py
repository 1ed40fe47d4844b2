"""A motion from a recorded trajectory: a smoothing spline through the poses of a TUM or EuRoC file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from icalib.base.input_files import regular
from icalib.errors import RecordingError
from icalib.tools.simulation.scenario.jets import Jet, Rows, Vector, matrices, values
from icalib.tools.simulation.sensors.motion import readings_of

_KNOT_S = 0.1  # interval of the knots: motion faster than a few Hz is smoothed away as noise
_ORDER = 6  # quintic: the fourth derivative of position is continuous
_STIFFNESS = 1e-6  # weight of the roughness, relative to 1 for each pose: determines control points in gaps of the file
_LARGEST_GAP_S = 0.5
# Coefficients of the uniform quintic B-spline: the value is (1, u, ... u^5) _BASIS (6 control points) / 120.
_BASIS = (
    np.array(
        [
            [1.0, 26.0, 66.0, 26.0, 1.0, 0.0],
            [-5.0, -50.0, 0.0, 50.0, 5.0, 0.0],
            [10.0, 20.0, -60.0, 20.0, 10.0, 0.0],
            [-10.0, 20.0, 0.0, -20.0, 10.0, 0.0],
            [5.0, -20.0, 30.0, -20.0, 5.0, 0.0],
            [-1.0, 5.0, -10.0, 10.0, -5.0, 1.0],
        ]
    )
    / 120.0
)


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """Quintic B-splines of p_world_imu and of a quaternion for R_world_imu. control (C, 7): x, y, z [m]; qx, qy, qz,
    qw.

    The spline of the quaternion does not have unit length; the rotation is that of the normalised quaternion.
    """

    control: np.ndarray

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Trajectory.pose_at`."""
        rows, position = self._jets(seconds, 1)
        return matrices(rows, 0), values(position, 0), values(position, 1)

    def readings_at(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 6) true angular rate [rad/s] and specific force [m/s^2] in the IMU frame."""
        rows, position = self._jets(seconds, 2)
        return readings_of(matrices(rows, 0), matrices(rows, 1), values(position, 2))

    def rate_at(self, seconds: np.ndarray) -> np.ndarray:
        """See `Trajectory.rate_at`."""
        return self.readings_at(seconds)[:, :3]

    def _jets(self, seconds: np.ndarray, order: int) -> tuple[Rows, Vector]:
        first, power = _segment(seconds, len(self.control), order)
        points = self.control[first[:, None] + np.arange(_ORDER)]  # (N, 6, 7)
        series = np.einsum("knb,nbc->ckn", power, points)
        x, y, z, qx, qy, qz, qw = (Jet(c) for c in series)
        return _rotation(qx, qy, qz, qw), (x, y, z)


def _segment(seconds: np.ndarray, controls: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Number (N,) of the first of the six control points at each instant, and Taylor coefficients (order + 1, N, 6) of
    the basis functions. controls: number of control points."""
    first = np.clip((seconds / _KNOT_S).astype(np.int64), 0, controls - _ORDER)
    u = seconds / _KNOT_S - first
    coefficients, power = _BASIS, []
    for k in range(order + 1):
        powers = u[:, None] ** np.arange(len(coefficients))
        power.append(powers @ coefficients)
        coefficients = np.arange(1, len(coefficients))[:, None] * coefficients[1:] / ((k + 1) * _KNOT_S)
    return first, np.array(power)


def _rotation(x: Jet, y: Jet, z: Jet, w: Jet) -> Rows:
    """Rotation matrix of a quaternion of any length."""
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    rows = (
        (ww + xx - yy - zz, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), ww - xx + yy - zz, 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), ww - xx - yy + zz),
    )
    square = xx + yy + zz + ww
    a, b, c = ((p / square, q / square, r / square) for p, q, r in rows)
    return a, b, c


def recorded_motion(path: Path, duration_s: float, middle: np.ndarray) -> RecordedMotion:
    """The motion in the file `path` from its first pose on, shifted so that the middle of its extent is at middle (3,)
    m.

    Raises RecordingError naming the file if it cannot be read, is too short, or has a gap.
    """
    seconds, poses = _read(path)
    if seconds[-1] < duration_s:
        raise RecordingError(f"{path} is {seconds[-1]:.3g} s long; lower the duration of {duration_s:g} s.")
    if (gap := float(np.diff(seconds).max())) > _LARGEST_GAP_S:
        raise RecordingError(
            f"{path} has a gap of {gap:.3g} s; give a trajectory without gaps above {_LARGEST_GAP_S} s."
        )
    used = seconds <= duration_s + _KNOT_S
    seconds, poses = seconds[used], poses[used]
    poses[:, :3] += middle - 0.5 * (poses[:, :3].min(axis=0) + poses[:, :3].max(axis=0))
    # q and -q are the same rotation: each quaternion gets the sign that is closer to its predecessor.
    turned = np.sum(poses[1:, 3:] * poses[:-1, 3:], axis=1) < 0.0
    poses[1:, 3:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
    return RecordedMotion(_fitted(seconds, poses))


def _fitted(seconds: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Control points (C, 7) of the smoothing spline of values (N, 7) at seconds (N,): least squares of residuals and of
    the roughness."""
    controls = int(seconds[-1] / _KNOT_S) + _ORDER
    first, power = _segment(seconds, controls, 0)
    normal, right = np.zeros((controls, controls)), np.zeros((controls, values.shape[1]))
    columns = first[:, None] + np.arange(_ORDER)
    np.add.at(normal, (columns[:, :, None], columns[:, None, :]), power[0][:, :, None] * power[0][:, None, :])
    np.add.at(right, columns, power[0][:, :, None] * values[:, None, :])
    rough = np.diff(np.eye(controls), n=3, axis=0)
    return np.linalg.solve(normal + _STIFFNESS * rough.T @ rough, right)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Seconds (N,) since the first pose, and poses (N, 7): x, y, z, qx, qy, qz, qw."""
    stamps, rows = [], []
    for number, line in enumerate(_lines(path), 1):
        euroc = "," in line
        if not line.strip() or line.startswith("#"):
            continue
        fields = [field.strip() for field in line.split(",")] if euroc else line.split()
        try:
            # Seconds since 1970 with nine decimals exceed float64, so that they are read as integer nanoseconds.
            stamps.append(int(fields[0]) if euroc else _nanoseconds(fields[0]))
            x, y, z, a, b, c, d = (float(field) for field in fields[1:8])
        except ValueError:
            form = "t [ns], x, y, z, qw, qx, qy, qz" if euroc else "t x y z qx qy qz qw"
            raise RecordingError(f"{path}:{number}: the line is not {form}; correct or remove it.") from None
        rows.append((x, y, z, b, c, d, a) if euroc else (x, y, z, a, b, c, d))
    poses = np.array(rows, dtype=np.float64).reshape(-1, 7)
    lengths = np.linalg.norm(poses[:, 3:], axis=1)
    if len(rows) < _ORDER or not np.isfinite(poses).all() or (np.abs(lengths - 1.0) > 1e-2).any():
        raise RecordingError(f"{path} does not hold at least {_ORDER} poses of unit quaternions; give another file.")
    seconds = (np.array(stamps, dtype=np.int64) - stamps[0]).astype(np.float64) * 1e-9
    if (np.diff(seconds) <= 0.0).any():
        late = int(np.argmax(np.diff(seconds) <= 0.0)) + 1
        raise RecordingError(f"{path}: pose {late} is not later than the one before; sort the file by time.")
    poses[:, 3:] /= lengths[:, None]
    return seconds, poses


def _nanoseconds(text: str) -> int:
    integer, _, fraction = text.partition(".")
    if "e" in text.lower():
        return round(float(text) * 1e9)
    sign = -1 if integer.startswith("-") else 1
    return int(integer) * 1_000_000_000 + sign * int((fraction + "0" * 9)[:9])


def _lines(path: Path) -> list[str]:
    try:
        return regular(path).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path} cannot be read ({reason}); give the path of a trajectory.") from None
