"""Verdict on a result and its reasons; projection uncertainty and relative poses with their covariance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from icalib.base.remark import Remark
from icalib.geometry.cameras import camera_model
from icalib.geometry.cameras.base import CameraModel
from icalib.motion.imu_data import hardly_turned
from icalib.rig import Settings, prior_words
from icalib.rig.rig import ALL_SPECS, SENSOR_TYPES
from icalib.sensors.parameter import display_unit

if TYPE_CHECKING:
    from icalib.result.calibration import Calibration, ParameterGroup, Verdict


# Verdict on a result: whether it can be used, and why not. No other module decides this.
#
# Console, report, calibration.yaml, result.json and the exit code of `--strict` show this verdict. It is the worst
# that applies of:
#
#     not usable        the solver did not converge, or a check says that the rig file or the recording is wrong
#     partly usable     components are unobservable or too uncertain; all others can be used
#     usable with care  there is a warning, or a component whose standard deviation exceeds its tolerance
#     usable            none of these
#
# A lens is judged by its projection uncertainty over the image regions with observations, not by single coefficients,
# which are strongly correlated. A component with a prior does not count: it is at least as good as its prior. Nuisance
# parameters (edge bloom, board shape and tilt) do not count.

Usability = Literal["usable", "usable with care", "partly usable", "not usable"]

EXIT_CODES: dict[Usability, int] = {"usable": 0, "usable with care": 3, "partly usable": 4, "not usable": 5}
NEXT: dict[Usability, str] = {
    "usable": "The solver converged, every component that counts is determined, and no check failed.",
    "usable with care": "Read the reasons before you use the numbers.",
    "partly usable": (
        "Use no component that is marked unobservable, which depends on its initial guess alone, or too uncertain. Act "
        "on the reasons to determine it."
    ),
    "not usable": "Act on the first reason, then calibrate again.",
}
_MEANINGS: dict[Verdict, Remark] = {
    "unobservable": Remark("values_unobservable", "unobservable, the value depends on the initial guess; {more}"),
    "too uncertain": Remark(
        "values_too_uncertain", "too uncertain, the standard deviation exceeds ten tolerances; {more}"
    ),
    "weak": Remark(
        "values_weak",
        "weakly determined, the standard deviation exceeds the tolerance; {more}, or accept that uncertainty",
    ),
}
AUXILIARY = tuple(spec.name for spec in ALL_SPECS if spec.is_auxiliary)
WORST_FIRST: tuple[Verdict, ...] = ("unobservable", "too uncertain", "weak", "determined", "fixed")
UNUSABLE = WORST_FIRST[:2]  # verdicts on components that must not be used
TOO_UNCERTAIN = 10.0  # standard deviation in tolerances above which a component must not be used
NULL_SPACE_SHARE = 0.25  # squared norm of a component's unit vector in the null space; unobservable above it
MOST_NAMED = 6  # components that one sentence names
_MOST_BY_IMU = 0.5  # share of a variance from the prior on IMU intrinsics above which a better prior is the advice


def usability(c: Calibration) -> Usability:
    """The verdict on the whole result."""
    if not c.converged or c.wrong:
        return "not usable"
    verdicts = {v for g in c.groups for v in counted(c, g)}
    if verdicts & {*UNUSABLE}:
        return "partly usable"
    return "usable with care" if c.warnings or "weak" in verdicts else "usable"


def reasons(c: Calibration) -> tuple[Remark, ...]:
    """Sentences on why the verdict is not `usable`, the most important first; empty if it is."""
    if not c.converged:
        return tuple(dict.fromkeys([*c.wrong, failure_words(c.status), *c.warnings]))
    verdicts = {v for g in c.groups for v in counted(c, g)} & {"weak", *UNUSABLE}
    # Standard deviations of a wrong model include its misfit, which a longer recording does not reduce.
    unusable, weak = ([], []) if c.wrong else ([*_named(c, *UNUSABLE)], [*_named(c, "weak")])
    rest = [w for w in c.warnings if w not in c.wrong]
    # Unobservable coefficients of a lens matter little if its projection is known well enough, so they come last.
    directions = c.unobservable if verdicts else ()
    first, last = (directions, ()) if "unobservable" in verdicts else ((), directions)
    return tuple(dict.fromkeys([*c.wrong, *first, *unusable, *rest, *weak, *last]))


def failure_words(status: str) -> Remark:
    """A sentence that the solver did not converge. status: why, one sentence."""
    return Remark("solver_did_not_converge", f"the solver did not converge: {status}")


def by_size(tolerances: float, by_guess: bool = False) -> Verdict:
    """Verdict on a component whose standard deviation is `tolerances` times its tolerance; NaN is as infinity.
    by_guess: whether errors of the initial guess of unobservable directions are most of its variance."""
    if not tolerances <= TOO_UNCERTAIN:
        return "unobservable" if by_guess else "too uncertain"
    return "determined" if tolerances <= 1.0 else "weak"


def in_null_space(directions: np.ndarray) -> np.ndarray:
    """(B,) bool: whether the unit vector of each component lies largely in the null space (see `NULL_SPACE_SHARE`).
    directions (B, m): orthonormal basis of the null space, in tolerance units."""
    return (directions**2).sum(axis=1) > NULL_SPACE_SHARE


def worst(verdicts: tuple[Verdict, ...]) -> Verdict:
    """The worst of the verdicts of a group; `fixed` if there are none."""
    return min((*verdicts, WORST_FIRST[-1]), key=WORST_FIRST.index)


def lens_projections_px(c: Calibration) -> dict[str, float | None]:
    """`lens_projection_px` of every camera. `Calibration` caches it, as one camera takes about 20 ms."""
    return {camera: _lens_projection_px(c, camera) for camera in c.lenses}


def lens_projection_px(c: Calibration, camera: str) -> float | None:
    """Median standard deviation of the projection over the image cells in which `camera` has observations [px]. None if
    its lens is fixed, or its model has no ray in the image."""
    return c.lens_projections_px[camera]


def _lens_projection_px(c: Calibration, camera: str) -> float | None:
    groups = [g for g in c.groups if g.sensor == camera and g.name in c.lenses[camera]]
    if len(groups) < len(c.lenses[camera]) or all(g.columns is None for g in groups):
        return None
    projection = projection_uncertainty(c, camera)
    return None if projection is None else projection.median_seen


def lens_verdict(c: Calibration, camera: str) -> Verdict:
    """Verdict on a lens: its projection uncertainty compared with `pixel_tolerance` of the settings."""
    sigma = lens_projection_px(c, camera)
    verdicts = {v for g in c.groups if g.sensor == camera and g.name in c.lenses[camera] for v in g.verdict}
    return "fixed" if sigma is None else by_size(sigma / tolerance(c, "pixel_tolerance"), "unobservable" in verdicts)


def tolerance(c: Calibration, name: str) -> float:
    """The setting `name` of the rig file, a tolerance, in the unit of that field; the default if `c` has no
    settings."""
    return float(c.settings.get(name, getattr(Settings, name)))


def counted(c: Calibration, g: ParameterGroup) -> tuple[Verdict, ...]:
    """Verdicts of a group that contribute to the verdict on the result; one verdict for a lens, none for nuisance
    parameters."""
    if g.name in AUXILIARY:
        return ()
    if g.name in c.lenses.get(g.sensor, ()):
        return (lens_verdict(c, g.sensor),) if {"weak", *UNUSABLE} & {*g.verdict} else ()
    return () if g.mode == "prior" else g.verdict


def _named(c: Calibration, *verdicts: Verdict) -> Iterator[Remark]:
    """Sentences on the components that have each of `verdicts`: first those whose standard deviation comes from the
    prior on IMU intrinsics, then all others but those that the sentence on an unobservable direction names."""
    for verdict in verdicts:
        components = [(name, by_imu) for name, v, by_imu in _components(c) if v == verdict]
        if names := [name for name, by_imu in components if by_imu]:
            prior = prior_words(np.array(c.rig["sensors"][c.imu]["intrinsics"]["sigma"]))
            yield Remark(
                "imu_prior_limits",
                f"{_listed(names)}: {_MEANINGS[verdict].split(';')[0]}; so much of it comes from the prior on IMU "
                f"intrinsics {prior}. State the class of {c.imu} (`intrinsics: industrial` or "
                "`intrinsics: tactical`), or "
                "`intrinsics: fixed` if it is calibrated.",
            )
        names = [name for name, by_imu in components if not by_imu]
        if verdict == "unobservable":
            names = [name for name in names if not any(name.split(" (")[0] in words for words in c.unobservable)]
        if names:
            meaning = _MEANINGS[verdict]
            yield meaning.saying(f"{_listed(names)}: {meaning.format(more=_more(c))}.")


def _more(c: Calibration) -> str:
    """Advice for this rig: what to record so that standard deviations become smaller."""
    if any(SENSOR_TYPES[s["type"]].drives for s in c.rig["sensors"].values()):
        return "drive longer, with turns both ways, and brake and speed up"
    if c.imu is None and c.lenses:
        images = sum(len(r.seconds) for r in c.image_residuals)
        return f"the result rests on {images} images: take more, near and far, tilted, and in every part of the image"
    axes = hardly_turned(c.trajectory.seconds, c.trajectory.rotation, c.reference)
    if c.imu is None:
        return f"record more poses, turned about {axes or 'every axis'}"
    return f"record longer, and {f'turn the rig about {axes}' if axes else 'turn about and move along every axis'}"


def _components(c: Calibration) -> Iterator[tuple[str, Verdict, bool]]:
    """Name with standard deviation, verdict, and whether the prior on IMU intrinsics contributes most of the variance,
    of every component that contributes to the verdict on the result."""
    for g in c.groups:
        verdicts = counted(c, g)
        if g.name in (lens := c.lenses.get(g.sensor, ())):
            if verdicts and g.name == lens[0]:
                yield f"{g.sensor} lens (projection {lens_projection_px(c, g.sensor):.2g} px)", verdicts[0], False
            continue
        unit, scale = display_unit(g.unit)
        by_imu = np.zeros(len(g.std)) if g.std_imu is None else g.std_imu
        for label, verdict, std, part in zip(g.labels, verdicts, g.std.tolist(), by_imu.tolist(), strict=False):
            name = f"{g.sensor} {g.name if label in (g.name, '') else f'{g.name} {label}'}".replace("_", " ")
            is_most = part**2 > _MOST_BY_IMU * std**2
            size = f"{scale * part:.2g} of {scale * std:.2g} {unit}" if is_most else f"std {scale * std:.2g} {unit}"
            yield f"{name} ({size.strip()})", verdict, is_most


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more


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
    """Relative poses of all pairs of sensors with a lens, and of all pairs of mounted sensors of different types."""
    kinds = {name: sensor["type"] for name, sensor in c.rig["sensors"].items()}
    pairs = list(combinations(c.lenses, 2))
    pairs += [(a, b) for a, b in combinations(c.mounted, 2) if kinds[a] != kinds[b]]
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
