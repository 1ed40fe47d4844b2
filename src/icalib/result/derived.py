"""Values derived from a result, with their standard deviations: the projection of a lens, and relative poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from icalib.geometry.cameras import camera_model
from icalib.geometry.cameras.base import CameraModel

if TYPE_CHECKING:
    from icalib.result.calibration import Calibration, ParameterGroup

# Projection uncertainty of a camera over its image [px], from the covariance of its intrinsics and distortion.
#
# A lens error is in large part equivalent to a pose change: a shift of the principal point acts like a rotation.
# Extrinsics that were estimated together with the lens absorb that part. The pose change r that best absorbs each lens
# error db over the image is therefore removed first, as in mrcal ("projection uncertainty", "implied rotation";
# derived anew). With the covariance P of the lens parameters b:
#
#     r = K db,   K = -(sum Jr^T Jr)^-1 sum Jr^T Ji
#     cov(q) = (Ji + Jr K) P (Ji + Jr K)^T
#
# Ji = d q / d b for a fixed point, and Jr = d q / d r at the same pixel q. Sums run over a grid of pixels.

COLUMNS = 36  # cells of the grid across the width of the image
FEWEST_OBSERVED = 12  # cells with observations; with fewer, the pose change is fitted over the whole image


@dataclass(frozen=True)
class ProjectionMap:
    """Projection uncertainty of `camera` for points at the distance `range_m` [m]. It is the standard deviation in the
    worst direction of the image, after a rotation is removed, and at finite range a translation as well.

    u (n,), v (m,): centres of the grid cells [px]. sigma (m, n): standard deviations [px], NaN if the model has no ray.
    seen (m, n) bool: cells with corners or tracked points. The pose change is fitted over the seen cells, or over all
    cells if fewer than `FEWEST_OBSERVED` are.
    """

    camera: str
    range_m: float
    u: np.ndarray
    v: np.ndarray
    sigma: np.ndarray
    seen: np.ndarray

    @property
    def median_seen(self) -> float:
        """Median sigma over the seen cells [px]; over the whole image if no cell is seen."""
        sigmas = self.sigma[self.seen & np.isfinite(self.sigma)]
        return float(np.median(sigmas)) if len(sigmas) else float(np.nanmedian(self.sigma))

    @property
    def worst(self) -> tuple[float, float, float]:
        """The largest sigma, and u and v of its cell [px]."""
        row, column = np.unravel_index(int(np.nanargmax(self.sigma)), self.sigma.shape)
        return float(self.sigma[row, column]), float(self.u[column]), float(self.v[row])


def projection_uncertainty(c: Calibration, camera: str, range_m: float = np.inf) -> ProjectionMap | None:
    """Projection uncertainty map of one camera, from the covariance of its lens with empirical factors.

    Returns None if the model has no ray anywhere in the image. The map is zero if the rig file fixes both intrinsics
    and distortion. Raises KeyError if `camera` was not calibrated.
    """
    lens = [c.group(camera, "intrinsics"), c.group(camera, "distortion")]
    model, (width, height) = camera_model(c.rig["sensors"][camera]["model"]), c.rig["sensors"][camera]["resolution"]
    n, m = COLUMNS, max(1, round(COLUMNS * height / width))
    u, v = (np.arange(n) + 0.5) * width / n - 0.5, (np.arange(m) + 0.5) * height / m - 0.5
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    observed = np.zeros((m, n), dtype=bool)
    for r in (r for r in c.image_residuals if r.sensor == camera):
        cell = ((r.uv[r.used] + 0.5) * [n / width, m / height]).astype(int)
        observed[np.clip(cell[:, 1], 0, m - 1), np.clip(cell[:, 0], 0, n - 1)] = True
    params = np.concatenate([g.value for g in lens])
    sigma = projection_std(model, params, joint_covariance(c, lens), uv, observed.ravel(), range_m)
    return ProjectionMap(camera, range_m, u, v, sigma.reshape(m, n), observed) if np.isfinite(sigma).any() else None


def projection_std(
    model: CameraModel,
    params: np.ndarray,
    covariance: np.ndarray,
    uv: np.ndarray,
    observed: np.ndarray,
    range_m: float = np.inf,
) -> np.ndarray:
    """(N,) standard deviation of the projection in the worst direction [px] at pixels uv (N, 2); NaN without a ray.

    params (P,), covariance (P, P): intrinsics and distortion. range_m: distance of the points [m]. The absorbed pose
    change is fitted over the pixels `observed` (N,) bool, or over all if fewer than `FEWEST_OBSERVED` are usable.
    """
    rays, valid = model.unproject(params, uv)
    points = rays * (range_m if np.isfinite(range_m) else 1.0)
    _, projected, J_point, J_lens = model.project_with_jacobians(params, points)
    valid &= projected
    J_pose = J_point @ _point_by_pose(points, np.isfinite(range_m))
    used = valid & observed
    used = used if np.count_nonzero(used) >= FEWEST_OBSERVED else valid
    size = J_pose.shape[2]
    K = np.linalg.lstsq(J_pose[used].reshape(-1, size), -J_lens[used].reshape(-1, len(params)), rcond=None)[0]
    J_absorbed = J_lens + J_pose @ K
    worst = np.linalg.eigvalsh(J_absorbed @ covariance @ J_absorbed.transpose(0, 2, 1))[:, -1]
    return np.where(valid, np.sqrt(np.maximum(worst, 0.0)), np.nan)


def _point_by_pose(points: np.ndarray, near: bool) -> np.ndarray:
    """(N, 3, 3) Jacobian d points / d rotation of points (N, 3). If `near`: (N, 3, 6), followed by the Jacobian by a
    translation in units of each point's distance."""
    x, y, z = points.T
    zero = np.zeros_like(x)
    J_rotation = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    if not near:
        return J_rotation
    J_translation = np.linalg.norm(points, axis=1)[:, None, None] * np.eye(3)
    return np.concatenate([J_rotation, J_translation], axis=2)


def working_distance(c: Calibration, camera: str) -> float | None:
    """Median distance of `camera` from the first point of the target in images that show the target [m]. Without such
    images, the median distance of its tracked points; None without either."""
    residuals = [r for r in c.corner_residuals if r.sensor == camera and len(r.uv)]
    if not residuals:
        return next((r.distance for r in c.track_residuals if r.sensor == camera), None)
    path = c.trajectory
    seconds = residuals[0].seconds[np.diff(residuals[0].start) > 0]
    node = np.clip(np.searchsorted(path.seconds, seconds), 0, len(path.seconds) - 1)
    # The world's origin is the target's first point.
    centre = path.position[node] + path.rotation[node] @ c.group(camera, "translation").value
    return float(np.median(np.linalg.norm(centre, axis=1)))


# Pose of one sensor relative to another, with its uncertainty from the joint covariance of both.


@dataclass(frozen=True)
class RelativePose:
    """T_frame_sensor, T (4, 4): p_frame = T p_sensor. covariance (6, 6), empirical factors included: rotation [rad]
    about the sensor's axes (right perturbation), then translation [m] along the axes of `frame`. Converts to the array
    T."""

    frame: str
    sensor: str
    T: np.ndarray
    covariance: np.ndarray

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.T, dtype=dtype)

    @property
    def name(self) -> str:
        return f"T_{self.frame}_{self.sensor}"

    @property
    def std(self) -> np.ndarray:
        """(6,) standard deviations: rotation about the sensor's axes [rad], translation along the axes of `frame`
        [m]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def distance(self) -> float:
        """Distance between the origins of both sensors [m], such as the baseline of a stereo pair."""
        return float(np.linalg.norm(self.T[:3, 3]))

    @property
    def distance_std(self) -> float:
        """Standard deviation of `distance` [m], to first order. If the distance is zero: the largest standard deviation
        of the translation over all directions."""
        covariance = self.covariance[3:, 3:]
        if self.distance == 0.0:
            return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
        along = self.T[:3, 3] / self.distance
        return float(np.sqrt(along @ covariance @ along))


def relative_poses(c: Calibration) -> tuple[RelativePose, ...]:
    """Relative poses of all pairs of mounted sensors, those of two cameras first."""
    lenses = set(c.lenses)
    pairs = list(combinations(c.lenses, 2))
    pairs += [(a, b) for a, b in combinations(c.mounted, 2) if not {a, b} <= lenses]
    return tuple(relative_pose(c, frame, sensor) for frame, sensor in pairs)


def relative_pose(c: Calibration, frame: str, sensor: str) -> RelativePose:
    """Pose of `sensor` in the frame of the sensor `frame`; either may be the IMU. Raises KeyError, which lists the
    existing groups."""
    T = np.linalg.inv(_known_pose(c, frame)) @ _known_pose(c, sensor)
    J = relative_jacobian(c, frame, sensor)
    return RelativePose(frame, sensor, T, J @ _joint_covariance(c, frame, sensor) @ J.T)


def relative_jacobian(c: Calibration, frame: str, sensor: str) -> np.ndarray:
    """(6, 12) Jacobian of T_frame_sensor by rotation and translation of `frame`, then of `sensor`.

    With T_imu_frame = (R, p), T_imu_sensor = (Q, q) and the relative pose (S, s) = (R^T Q, R^T (q - p)), right
    perturbations dR, dQ and additive dp, dq give dS = dQ - S^T dR (right perturbation) and ds = R^T (dq - dp) + s x dR.
    """
    T_imu_frame = _known_pose(c, frame)
    T = np.linalg.inv(T_imu_frame) @ _known_pose(c, sensor)
    R, S, s = T_imu_frame[:3, :3], T[:3, :3], T[:3, 3]
    J = np.zeros((6, 12))
    J[:3, :3], J[:3, 6:9] = -S.T, np.eye(3)
    J[3:, :3] = [[0.0, -s[2], s[1]], [s[2], 0.0, -s[0]], [-s[1], s[0], 0.0]]
    J[3:, 3:6], J[3:, 9:] = -R.T, R.T
    return J


def _joint_covariance(c: Calibration, *sensors: str) -> np.ndarray:
    """(6 n, 6 n) covariance of rotation and translation of each of n sensors, empirical factors included; zero if
    fixed."""
    return joint_covariance(c, [g for sensor in sensors for g in pose_groups(c, sensor)], 3)


def _known_pose(c: Calibration, sensor: str) -> np.ndarray:
    return np.eye(4) if pose_groups(c, sensor)[1] is None else c.T_imu_sensor(sensor)


def pose_groups(c: Calibration, sensor: str) -> tuple[ParameterGroup | None, ParameterGroup | None]:
    """Rotation and translation of `sensor`. None in place of a group that is exactly known: both of an IMU that is the
    reference, and the rotation of a sensor without a rotation."""
    known = {g.name: g for g in c.groups if g.sensor == sensor}
    if sensor == c.imu and "rotation" not in known:
        return None, None
    return c.group_or_none(sensor, "rotation"), c.group(sensor, "translation")


def joint_covariance(c: Calibration, groups: Sequence[ParameterGroup | None], none: int = 0) -> np.ndarray:
    """(n, n) covariance of all entries of `groups`, in their order, empirical factors included; zero if fixed. A None
    in place of a group stands for `none` exactly known entries."""
    sizes = [none if g is None else len(g.labels) for g in groups]
    out, at, columns, scale = np.zeros((sum(sizes),) * 2), [], [], []
    for k, g in enumerate(groups):
        if g is not None and g.columns is not None:
            first = sum(sizes[:k])
            at += range(first, first + sizes[k])
            columns += g.columns
            scale += [1.0] * sizes[k] if g.factor is None else np.maximum(g.factor, 1.0).tolist()
    out[np.ix_(at, at)] = c.covariance[np.ix_(columns, columns)] * np.outer(scale, scale)
    return out
