"""What the data themselves say of the formal standard deviations: post-fit degrees of freedom, and splits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from icalib.estimate.evidence.parts import Parts
from icalib.estimate.problem.outcome import Outcome, posterior
from icalib.estimate.problem.problem import Problem, Residuals
from icalib.motion import factor
from icalib.optim.arrowhead import Draw, in_parallel
from icalib.optim.border import restricted_inverse
from icalib.optim.state import State
from icalib.sensors.camera.corner_factor import CornerFactor, CornerOutput
from icalib.sensors.camera.features.feature_factor import FeatureFactor, FeatureOutput
from icalib.sensors.camera.features.surfaces import ON_PLANES

DRAW_STEP = 1e-3  # of a posterior sample: small enough to be linear


@dataclass(frozen=True)
class Fit:
    """chi^2 of one kind of residual, their number, and the degrees of freedom that are left after the fit.

    kind: "gyroscope", "accelerometer", "bias walk", "corners", "features", "points on planes", or "common error 0", 1,
    ... for the images' own.
    """

    sensor: str
    kind: str
    count: int
    dof: float
    chi2: float


def fits(problem: Problem, outcome: Outcome) -> list[Fit]:
    """chi^2 over post-fit degrees of freedom of every sensor.

    A draw x from the posterior has the covariance H^-1; then |J_s x|^2 has the mean tr(J_s H^-1 J_s^T), the parameters
    that sensor s pays for. J x is taken by differences of the residuals themselves.
    """
    spent: dict[tuple[str, str], list[float]] = {}
    for draw in (outcome.draws or posterior(problem, outcome.state)).free:
        for key, value in _spent(problem, outcome, draw).items():
            spent.setdefault(key, []).append(value)
    found = chi2_by_kind(problem, outcome.residuals)
    return [Fit(*key, n, n - float(np.mean(spent[key])), chi2) for key, (n, chi2) in found.items()]


def chi2_by_kind(problem: Problem, at: Residuals) -> dict[tuple[str, str], tuple[int, float]]:
    """Number and chi^2 of each kind of residual of each sensor, robust weights as they are."""
    chain, found = problem.chain, {}
    for kind, rows in chain.kinds.items():
        n = at.imu[:, rows].size - (len(chain.starts) - 1) * at.imu[0, rows].size
        found[chain.name, kind] = n, float((at.imu[:, rows] ** 2).sum())
    for camera, corners in zip(problem.cameras, at.corners, strict=True):
        if len(camera.stream.uv):
            found |= {(camera.name, kind): own for kind, own in _corner_chi2(camera, corners).items()}
    if problem.features is not None and at.features is not None:
        left, off = at.features, at.features.off
        for i, (camera, residual, root) in enumerate(
            zip(problem.features.cameras, left.residual, left.root, strict=True)
        ):
            chi2 = float(((residual * root[:, None]) ** 2).sum())
            found[camera.name, "features"] = 2 * int((root > 0.0).sum()), chi2
            if len(own := problem.features.on_planes_of(i)):
                chi2 = float(((off.residual * off.root)[own] ** 2).sum())
                found[camera.name, ON_PLANES] = len(own), chi2
    for sensor, rows in zip(problem.sensors, at.sensors, strict=True):
        for kind, r in sensor.kinds.items():
            found[sensor.name, kind] = sensor.count(rows, kind), factor.chi2(rows, r)
    return found


def raw_rms(problem: Problem, out: Residuals, sensor: str, kind: str) -> tuple[float | None, str]:
    """RMS of one kind of residual as it was before whitening, and its unit; None where it has none."""
    if kind in ("features", ON_PLANES):
        factor, left = problem.features, out.features
        assert factor is not None and left is not None
        i = [c.name for c in factor.cameras].index(sensor)
        if kind == ON_PLANES:
            return float(np.sqrt(np.mean(left.off.residual[factor.on_planes_of(i)] ** 2))), "m"
        return _rms_px(left.residual[i], left.root[i]), "px"
    for camera, corners in zip(problem.cameras, out.corners, strict=True):
        if camera.name == sensor:
            return _rms_px(corners.residual, corners.root), "px"
    for factor, rows in zip(problem.sensors, out.sensors, strict=True):
        if factor.name == sensor and kind in factor.kinds:
            return factor.rms(rows, kind)
    return None, ""


def _rms_px(residual: np.ndarray, root: np.ndarray) -> float | None:
    used = residual[root > 0.0]
    return float(np.sqrt(np.mean(used**2, dtype=np.float64))) if len(used) else None


def _corner_chi2(camera: CornerFactor, out: CornerOutput) -> dict[str, tuple[int, float]]:
    """Number and chi^2 of one camera's corner rows and of each kind of common error's rows."""
    found = {"corners": (2 * int(np.count_nonzero(out.root)), camera.chi2(out))}
    for k, tau in enumerate(camera.noise.tau):
        rows = out.shared[:, :, k] / tau
        found[f"common error {k}"] = (rows.size, float((rows**2).sum()))
    return found


def _spent(problem: Problem, outcome: Outcome, draw: Draw) -> dict[tuple[str, str], float]:
    """|J_s x|^2 of each sensor for one draw x."""
    state, base = outcome.state, outcome.residuals
    ends = [state.retract(problem.layout, s * draw.chain, s * draw.border) for s in (DRAW_STEP, 0.0)]
    there = bare_residuals(problem, ends[0])
    along = (there.imu - base.imu) / DRAW_STEP
    spent = {(problem.chain.name, k): float((along[:, r] ** 2).sum()) for k, r in problem.chain.kinds.items()}
    for camera, out in zip(problem.cameras, base.corners, strict=True):
        found = in_parallel(partial(_spent_by_views, camera, out, ends), camera.blocks())
        for kind in found[0] if found else ():
            spent[camera.name, kind] = sum(one[kind] for one in found)
    if problem.features is not None and base.features is not None and there.features is not None:
        spent |= _spent_by_features(problem.features, base.features, there.features)
    for sensor, at, moved in zip(problem.sensors, base.sensors, there.sensors, strict=True):
        slope = (moved.residual - at.residual) / DRAW_STEP * at.root
        spent |= {(sensor.name, kind): float((slope[:, r] ** 2).sum()) for kind, r in sensor.kinds.items()}
    return spent


def bare_residuals(problem: Problem, state: State) -> Residuals:
    """Those at `state`, corners aside."""
    bare = replace(problem, cameras=())
    out = bare.residuals()
    bare.linearise(state, bare.pieces(sums=False), out, sums=False)
    return out


def _spent_by_features(factor: FeatureFactor, at: FeatureOutput, there: FeatureOutput) -> dict[tuple[str, str], float]:
    """|J x|^2 of each camera's features. Their points follow x, and three degrees of freedom a point are its own: the
    plane that it lies on pays for its share, and the cameras by the number of observations."""
    count = np.zeros(factor.tracks.count)
    used = [root > 0.0 for root in at.root]
    for track, u in zip(factor.tracks.track, used, strict=True):
        count += np.bincount(track[u], minlength=len(count))
    spent = {}
    for i, camera in enumerate(factor.cameras):
        root, u = at.root[i], used[i]
        slope = (there.residual[i] - at.residual[i]) / DRAW_STEP
        own = float(((3.0 - at.off.share) / np.maximum(count, 1))[factor.tracks.track[i][u]].sum())
        spent[camera.name, "features"] = own + float(((slope * root[:, None])[u] ** 2).sum())
        if len(on := factor.on_planes_of(i)):
            slope = (there.off.residual - at.off.residual)[on] / DRAW_STEP * at.off.root[on]
            # Of several on a patch each row weighs less than what it is off by would have it.
            left, weight = 1.0 - at.off.share[on], factor.on.weight[on]
            own = float((1.0 - left * (left * weight + at.off.share[on])).sum())
            spent[camera.name, ON_PLANES] = own + float((slope**2).sum())
    return spent


def _spent_by_views(
    camera: CornerFactor, at: CornerOutput, ends: list[State], views: tuple[int, int]
) -> dict[str, float]:
    """|J x|^2 of some views of one camera, its mean over their images' common errors, which follow x."""
    own, n, m = camera.corners_of(*views), views[1] - views[0], len(camera.noise.tau)
    up, down = (camera.residual(state, *views) for state in ends)
    root, view = at.root[own], camera.views.of_corners(*views) - views[0]
    along = (up - down) / DRAW_STEP * root[:, None]
    if m == 0:
        return {"corners": float((along**2).sum())}
    # An error c takes what is least: |along + f c|^2 + |c / tau|^2; about that its covariance is M^-1, on each axis.
    f = camera.noise.field[own] * root[:, None]
    M, rhs = np.zeros((n, m, m)), np.zeros((n, m, 2))
    np.add.at(M, view, f[:, :, None] * f[:, None, :])
    np.add.at(rhs, view, -f[:, :, None] * along[:, None, :])
    M += np.diag(1.0 / camera.noise.tau**2)
    inverse = np.linalg.inv(M)
    shared = inverse @ rhs
    total = float(((along + np.einsum("ik,ikj->ij", f, shared[view])) ** 2).sum())
    total += 2.0 * float(np.einsum("ik,ikl,il->", f, inverse[view], f))
    spent = ((shared**2).sum(axis=2) + 2.0 * np.diagonal(inverse, axis1=1, axis2=2)).sum(axis=0) / camera.noise.tau**2
    return {"corners": total} | {f"common error {k}": float(spent[k]) for k in range(m)}


def split_covariance(outcome: Outcome, parts: Parts) -> np.ndarray:
    """(B, B) covariance of the border as the spread over `parts` of the recording shows it.

    Each part's own gradient b_g at the joint optimum (its chain marginalised) would be zero but for noise; their
    spread through the joint information S gives S^-1 (G / (G - 1) sum (b_g - b)(b_g - b)^T) S^-1, the block
    jackknife to first order.
    """
    b, n = parts.sums[:, :-1, -1], parts.count
    return n / (n - 1.0) * spread_covariance(parts.problem, outcome, b - b.mean(axis=0))


def split_expectation(outcome: Outcome, parts: Parts) -> np.ndarray:
    """(B,) variances that `split_covariance` has on average where noise is white.

    At the joint optimum the gradient of part g has the covariance S_g - S_g S^-1 S_g: a part that knows much pulls the
    optimum to itself (as the leverages in Bell and McCaffrey 2002). Of equal parts it is the formal variance.
    """
    t, n = parts.problem.tolerance, parts.count
    inverse = restricted_inverse(outcome.information * t[:, None] * t, parts.problem.held)
    known = parts.sums[:, :-1, :-1] * t[:, None] * t
    left = (known - known @ inverse @ known).sum(axis=0)
    return t**2 * n / (n - 1.0) * np.diag(inverse @ left @ inverse)


def spread_covariance(problem: Problem, outcome: Outcome, b: np.ndarray) -> np.ndarray:
    """S^-1 (sum b_g b_g^T) S^-1 for gradients b (G, B)."""
    t = problem.tolerance
    inverse = restricted_inverse(outcome.information * t[:, None] * t, problem.held)
    half = t[:, None] * (inverse @ (t[:, None] * b.T))
    return half @ half.T
