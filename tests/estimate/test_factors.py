"""One check for every factor: its sums against numeric derivatives of its residuals, on the manifold.

A sample is a factor at a state. It must add to the pieces J^T W J and J^T y, J the derivative of its residuals, y the
slope of its cost by the residuals and W their weights, with what it marginalises taken out of both, and return a cost
whose derivative this is.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import LinearOperator
from tests.cases import each
from tests.typed import not_none

import icalib.optim
import icalib.sensors
from icalib.data.measurements import ImuStream, PoseStream
from icalib.geometry import so3
from icalib.geometry.planes import plane_of
from icalib.geometry.targets import AprilGrid, Checkerboard, Scene
from icalib.model.bodies import SIZE, Bodies
from icalib.motion.factor import output_at
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import MIDDLE, EstimatedMotion, offset_at, poses_at, seconds_at
from icalib.optim.arrowhead import FIRST_BIAS_SIGMA, Piece, Prior, accumulate_bias_prior, make_pieces
from icalib.optim.rows import MIN_CURVATURE_RATIO
from icalib.optim.state import Entry, State, in_recording, make_layout
from icalib.rig import Ground, Lidar, Loss, Scheme
from icalib.rig.scene import SHEET_MIDDLE, TILT
from icalib.sensors.camera.corner_factor import DELAY, SHIFT, CornerNoise
from icalib.sensors.camera.spec import Shutter
from icalib.sensors.camera.track_surfaces import ON_PLANES
from icalib.sensors.imu.mounted_factor import MountedImuFactor, SlowMotion
from icalib.sensors.imu.residual import ImuFactor
from icalib.sensors.lidar.binning import LidarNoise
from icalib.sensors.lidar.board_factor import ON_BOARDS, ON_EDGES, BoardFactor, BoardPoints
from icalib.sensors.lidar.patch_factor import PatchFactor, PatchPoints, PatchRows
from icalib.sensors.lidar.residual import ring_errors
from icalib.sensors.pose.residual import AbsolutePoseFactor, PoseNoise, RelativePosesFactor, frame_of
from icalib.sensors.position.residual import OffsetWalkFactor, PositionFactor, PositionNoise, knot_entries
from icalib.sensors.position.stream import PositionStream
from icalib.sensors.wheels.ground_factor import GroundFactor
from icalib.sensors.wheels.residual import IncrementFactor, RelativePoseFactor, WheelNoise

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Sample:
    """factor: its name in the source. accumulate(state, piece, sums) -> cost; residual(state) -> r (n,);
    weights(state) -> y (n,), W (n, n) or an operator; potential(state): what the cost has beside the residuals."""

    factor: str
    setup: object
    state: State
    accumulate: Callable[[State, Piece, bool], float]
    residual: Callable[[State], np.ndarray]
    weights: Callable[[State], tuple[np.ndarray, Any]]
    tolerance: float = 1e-6  # of the gradient, where weights are found by iteration
    rolls: bool = False  # Jacobians are interpolated between the rows of an image
    potential: Callable[[State], float] = lambda at: 0.0
    made: Any = None  # the factor; priors have no rows


def white(residual):
    """Weights of residuals that are white already."""
    return lambda at: (residual(at), np.eye(len(residual(at))))


def in_unit(setup):
    """The setup with the size of the target as the unit of length of its motion, 1.3 m."""
    values = setup.state.values | {SIZE: np.array([1.3])}
    return replace(setup, imu=replace(setup.imu, unit=SIZE), state=replace(setup.state, values=values))


def with_gravity(setup):
    """The setup with the magnitude of gravity estimated."""
    entries = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in setup.layout.blocks]
    layout = make_layout([*entries, ("world", "gravity", "nuisance", 1, True)])
    values = setup.state.values | {("world", "gravity"): np.array([9.79])}
    return replace(setup, layout=layout, state=replace(setup.state, values=values))


EFFECTS = {
    ("imu0", "size_effect"): np.arange(6) * 1e-3,
    ("imu0", "accel_delay"): np.array([1e-3]),
    ("imu0", "low_pass"): np.array([1e-6]),
}


def with_effects(setup):
    """The setup with effects on the readings estimated."""
    entries = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in setup.layout.blocks]
    more: list[Entry] = [(*key, "nuisance", len(value), True) for key, value in EFFECTS.items()]
    layout = make_layout([*entries, *more])
    values = setup.state.values | EFFECTS
    return replace(setup, layout=layout, state=replace(setup.state, values=values))


def imu_sample(unlike, setup_of, imu_free, unit=False, places=False):
    """Preintegrated at another state, so that the corrections by bias and intrinsics are not zero."""
    setup = setup_of(unlike, imu_free=imu_free, size=unit)
    setup = in_unit(setup) if unit else with_gravity(setup)
    setup = with_effects(setup) if places else setup
    factor = ImuFactor.build(setup.imu, setup.state, 0.0 if unit else 9.81, setup.layout)
    state = setup.perturbed(np.random.default_rng(0), 0.1)

    def residual(at):
        out = factor.output()
        for piece in make_pieces(len(at.seconds), setup.layout.size):
            factor.accumulate(at, piece, out, sums=False)
        return out.residual.ravel()

    def accumulate(at, piece, sums):
        return factor.accumulate(at, piece, factor.output(), sums)

    return Sample("ImuFactor", setup, state, accumulate, residual, white(residual), made=factor)


def with_further_imus(setup, number):
    """The setup with IMUs that are copies of its own, mounted somewhere; all of their parameters are estimated."""
    setup, names = with_gravity(setup), tuple(f"imu{k + 1}" for k in range(number))
    entries, values = [], {}
    for k, name in enumerate(names):
        entries += [(name, "rotation", "rotation", 3, True), (name, "translation", "vector", 3, True)]
        entries += [(name, "time_offset", "vector", 1, True), (name, "intrinsics", "vector", 24, True)]
        values |= {(name, "rotation"): so3.exp(np.array([0.1, -0.2, 0.15]) * (k + 1.0))}
        values |= {(name, "translation"): np.array([0.1, 0.05, -0.08]), (name, "time_offset"): np.array([2e-3])}
        entries += [(name, "size_effect", "vector", 6, True), (name, "clock_rate", "nuisance", 1, True)]
        values |= {(name, "intrinsics"): np.full(24, 1e-3), (name, "size_effect"): np.arange(6) * 1e-3}
        values |= {(name, "clock_rate"): np.array([-90.0]), (name, MIDDLE): np.full(2, 0.3)}
    old = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in setup.layout.blocks]
    own = np.random.default_rng(3).normal(size=(len(setup.state.seconds), 9 * number)) * 0.05
    state = replace(setup.state, values=setup.state.values | values, further_imus=own)
    return replace(setup, layout=make_layout([*old, *entries], names), state=state)


def mounted_imu_sample(unlike, setup_of, imu_free, missing=False):
    """The second of two further IMUs, preintegrated at another state. missing: it started late and dropped out."""
    setup = with_further_imus(setup_of(unlike, imu_free=imu_free), 2)
    own = replace(setup.imu, name="imu2")
    if missing:
        middle = 0.5 * own.seconds[-1]
        kept = (own.seconds > 0.3) & ((own.seconds < middle) | (own.seconds > middle + 0.2))
        data = ImuStream(
            "imu2",
            10**9 + np.round(1e9 * own.seconds[kept]).astype(np.int64),
            *(x[kept] for x in (own.gyro, own.accel)),
        )
        own = ImuData.build(data, setup.sim.scenario.imu_noise)
    factor = MountedImuFactor.build(own, EstimatedMotion(setup.state, setup.imu, 9.81, 0.5), setup.layout)
    assert (factor.increments.W[:, 0, 0] == 0.0).any() == missing
    state = setup.perturbed(np.random.default_rng(0), 0.1)

    def residual(at):
        bias = at.further_imus[0, 12:18] - factor.increments.bias0[0]
        return np.append(output_at(factor, at).residual.ravel(), bias / FIRST_BIAS_SIGMA)

    def accumulate(at, piece, sums):
        return factor.accumulate(at, piece, factor.output(), sums)

    return Sample("MountedImuFactor", setup, state, accumulate, residual, white(residual), made=factor)


def slow_motion_sample(unlike, setup_of):
    setup = setup_of(unlike)
    factor = SlowMotion("imu0", len(setup.state.seconds), (0, 7))
    return row_sample(setup, setup.perturbed(np.random.default_rng(0)), factor, "none", False)


LOSS_SCALE = 1.5


def slope_along(loss, t):
    """Second derivative of the loss at t standard deviations, over its weight; kept positive as the factor does."""

    def psi(t):
        return np.where(t < LOSS_SCALE, t, LOSS_SCALE) if loss == "huber" else t / (1.0 + (t / LOSS_SCALE) ** 2)

    if loss == "none":
        return np.ones_like(t)
    return np.maximum((psi(t + 1e-6) - psi(t - 1e-6)) / 2e-6 / (psi(t) / t), MIN_CURVATURE_RATIO)


def row_sample(setup, state, made, bend, curved):
    """A sample of a factor of whitened rows; bend: the loss whose curvature along each row counts, or "none"."""

    def run(at):
        out = made.output()
        for piece in make_pieces(len(at.seconds), setup.layout.size):
            made.accumulate(at, piece, out, sums=False)
        return out.residual.ravel(), out.root.ravel()

    def weights(at):
        r, root = run(at)
        return root**2 * r, np.diag(root**2 * slope_along(bend, np.abs(r)))

    def accumulate(at, piece, sums):
        return made.accumulate(at, piece, made.output(), sums, curved)

    return Sample(type(made).__name__, setup, state, accumulate, lambda at: run(at)[0], weights, made=made)


def with_readout(setup, camera):
    """The setup with a rolling shutter in one camera, its readout time estimated, and this shutter."""
    entries = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in setup.layout.blocks]
    name = setup.streams[camera].name
    layout = make_layout([*entries, (name, "readout", "vector", 1, True)])
    values = setup.state.values | {(name, "readout"): np.array([0.03])}
    return replace(setup, layout=layout, state=replace(setup.state, values=values)), Shutter(1 - camera, 480)


def with_two_clocks(setup, keyframe=5):
    """The setup as two recordings, the second from `keyframe` on; each clock has a time offset of its own in it."""
    entries = [
        (b.sensor, b.name, b.kind, 2 if b.name == "time_offset" else b.size, b.start is not None)
        for b in setup.layout.blocks
    ]
    own = ("time_offset", MIDDLE)
    values = {k: np.resize(v, 2) if k[1] in own else v for k, v in setup.state.values.items()}
    if ("board0", "tilt") in values and (in_recording("board0", 1), "tilt") not in values:
        entries.append((in_recording("board0", 1), "tilt", "tilt", 2, True))
        values[in_recording("board0", 1), "tilt"] = values["board0", "tilt"]
    return replace(setup, layout=make_layout(entries), state=replace(setup.state, values=values, starts=(0, keyframe)))


def corner_sample(
    unlike,
    setup_of,
    factor_of,
    camera,
    scheme="inertial",
    loss="none",
    field=0,
    imu_free=False,
    curved=False,
    split=False,
    restarts=False,
    size=False,
    rolls=False,
):
    setup = setup_of(unlike, imu_free=imu_free, shape=True, bloom=True, split=split, size=size)
    setup = with_two_clocks(setup) if restarts else setup
    setup, shutter = with_readout(setup, camera) if rolls else (setup, None)
    rng = np.random.default_rng(1)
    stream = setup.streams[camera]
    n = len(stream.uv)
    # Few corners of each image, some of them far enough off that robust losses bend.
    sigma = rng.uniform(0.8, 1.2, n)
    noise = CornerNoise(
        sigma, np.array([0.8, 0.6, 0.4])[:field], rng.normal(size=(n, 2, 3))[:, :, :field].copy(), loss, LOSS_SCALE
    )
    factor = factor_of(setup, camera, scheme)
    factor = replace(
        factor,
        stream=replace(stream, uv=stream.uv + rng.normal(size=(n, 2)) * rng.choice([0.8, 3.0], (n, 1), p=[0.8, 0.2])),
        keep=rng.random(n) < 0.15,
        noise=noise,
        direction=rng.normal(size=(n, 2)).astype(np.float32),
        seams=(int(np.searchsorted(factor.keyframe, setup.state.starts[1])),) if restarts else (),
        shutter=shutter,
    )
    state = setup.perturbed(rng, 0.02)

    def run(at):
        out = factor.output(np.float64)
        for piece in make_pieces(len(at.seconds), setup.layout.size):
            factor.accumulate(at, piece, out, sums=False)
        return out, out.root > 0

    def residual(at):
        out, used = run(at)
        return out.residual[used].T.ravel()

    def weights(at):
        out, used = run(at)
        root, f, r = out.root[used], noise.field[used], out.residual[used]
        view = factor.views.of_corners(0, len(factor.views.image))[used]
        e = r + np.einsum("nak,nk->na", f, out.shared[view])
        size = np.linalg.norm(e, axis=1)
        bend = np.sqrt(slope_along(loss if curved else "none", size / sigma[used]))
        B = np.eye(2) + (bend - 1.0)[:, None, None] * np.einsum("ni,nj->nij", e, e) / (size**2)[:, None, None]
        B = np.block([[np.diag(root * B[:, i, j]) for j in range(2)] for i in range(2)])
        W = B @ B
        for i in range(len(factor.views.image) if field else 0):
            F = B @ np.concatenate([f[:, axis] * (view == i)[:, None] for axis in range(2)])
            W -= B @ F @ np.linalg.solve(F.T @ F + np.diag(noise.tau**-2), F.T @ B)
        return (root[:, None] ** 2 * e).T.ravel(), W

    def accumulate(at, piece, sums):
        return factor.accumulate(at, piece, factor.output(np.float64), sums, curved)

    tolerance = 1e-3 if field and loss != "none" else 1e-6
    return Sample("CornerFactor", setup, state, accumulate, residual, weights, tolerance, rolls, made=factor)


def feature_sample(
    unlike,
    setup_of,
    makers,
    scheme="inertial",
    loss="none",
    imu_free=False,
    curved=False,
    restarts=False,
    on_planes=False,
    rolls=False,
):
    """Points are held where the cost is least at the sample's state; the weights take them out. `on_planes`: many of
    them have a row for the plane that they lie on, too."""
    features_of, features_on_planes = makers
    setup = setup_of(unlike, imu_free=imu_free)
    setup = with_two_clocks(setup) if restarts else setup
    setup, shutter = with_readout(setup, 0) if rolls else (setup, None)
    rng = np.random.default_rng(4)
    if on_planes:
        setup, factor = features_on_planes(setup, scheme, (loss, LOSS_SCALE), 1.0)
    else:
        factor = features_of(setup, scheme, (loss, LOSS_SCALE), 1.0, shutter)
    state = setup.perturbed(rng, 0.02)
    at_optimum = factor.output()
    for piece in make_pieces(len(state.seconds), setup.layout.size):
        factor.accumulate(state, piece, at_optimum, sums=False)
    views = factor._views(state, 0, factor.n_keyframes)
    world = factor._from_anchors(views, slice(0, factor.tracks.count), at_optimum.points)
    used = [root > 0 for root in at_optimum.root]
    track = np.concatenate([t[u] for t, u in zip(factor.tracks.track, used, strict=True)])
    on = np.flatnonzero(factor.on.plane >= 0)

    def planes(at):
        found = np.array([at.values[factor.surfaces.keys[q]] for q in factor.on.plane[on]]).reshape(-1, 6)
        return found[:, :3], found[:, 3:]

    def off(at, points):
        normal, point = planes(at)
        return np.einsum("na,na->n", normal, points[on] - point)

    def errors(at, points):
        found = []
        for i, (camera, stream, u) in enumerate(zip(factor.cameras, factor.streams, used, strict=True)):
            poses = camera.poses(at).part(stream.image[u])
            if camera.shutter is not None:
                poses = camera.row_poses(at, stream.image[u], camera.shutter.phase(stream.uv[u]))
            from_camera = points[factor.tracks.track[i][u]] - poses.position
            X = np.einsum("nij,nj->ni", poses.R_sensor_world, from_camera)
            params = np.concatenate([at.values[camera.name, "intrinsics"], at.values[camera.name, "distortion"]])
            found.append(camera.model.project(params, X)[0] - stream.uv[u])
        return np.concatenate(found)

    def residual(at):
        return np.concatenate([errors(at, world).ravel(), off(at, world)])

    def weights(at):
        e, d = errors(at, world), off(at, world)
        root = np.concatenate([r[u] for r, u in zip(at_optimum.root, used, strict=True)])
        sigma = np.concatenate([s[u] for s, u in zip(factor.sigmas, used, strict=True)])
        size = np.linalg.norm(e, axis=1)
        bend = slope_along(loss if curved else "none", size / sigma)
        along = np.einsum("ni,nj->nij", e, e) / (size**2)[:, None, None]
        blocks = (root**2)[:, None, None] * (np.eye(2) + (bend - 1.0)[:, None, None] * along)
        bent = slope_along(loss if curved else "none", np.abs(d) / factor.on.sigma[on])
        W = sparse.block_diag([*blocks, sparse.diags(at_optimum.off.root[on] ** 2 * bent)], format="csr")
        F, h = sparse.lil_array((not_none(W.shape)[0], 3 * factor.tracks.count)), 1e-5
        for k in range(3):
            step = h * np.eye(3)[k]
            slope = (errors(at, world + step) - errors(at, world - step)) / (2 * h)
            for r in range(2):
                F[2 * np.arange(len(e)) + r, 3 * track + k] = slope[:, r]
        for k in range(len(on)):
            F[2 * len(e) + k, 3 * on[k] : 3 * on[k] + 3] = planes(at)[0][k]
        WF = sparse.csr_array(W @ F.tocsr())
        known = (F.T @ WF).toarray()
        y = np.concatenate([(root[:, None] ** 2 * e).ravel(), at_optimum.off.root[on] ** 2 * d])

        def times(J):
            return W @ J - WF @ np.linalg.solve(known, WF.T @ J)

        operator: Any = LinearOperator  # its stubs know only that of its __new__
        return y, operator(W.shape, matvec=times, matmat=times, dtype=float)

    def accumulate(at, piece, sums):
        if sums:
            piece.features = factor.attach(piece, keep=True).features
        return factor.accumulate(at, piece, factor.output(), sums, curved)

    # Points rest within 1e-12 of their least cost; the gradient is that of points which are there.
    return Sample("FeatureFactor", setup, state, accumulate, residual, weights, 5e-6, rolls, made=factor)


def lidar_sample(
    room,
    room_of,
    scheme: Scheme = "inertial",
    loss: Loss = "none",
    beam=0.0,
    imu_free=False,
    restarts=False,
    noisy=1.0,
    sheet=False,
    rings=False,
):
    """Its moments taken at another state, as in all but the first linearisation of a pass. noisy: how much more than
    that of the data sheet the gyroscope's noise is. sheet: the floor is the sheet of a target. rings: errors of rings
    are free."""
    setup = room_of(room, imu_free=imu_free, spacing=0.05, sheet=sheet, drifts=True, rings=rings)
    setup = replace(setup, imu=replace(setup.imu, variance=noisy**2 * setup.imu.variance))
    if restarts:
        stream = replace(setup.stream, joins_ns=(int(setup.stream.stamps_ns[2]),))
        measured = setup.sim.measurements.with_streams(stream)
        setup = with_two_clocks(replace(setup, sim=replace(setup.sim, measurements=measured)))
    rng = np.random.default_rng(5)
    start = setup.perturbed(rng, 0.3)
    factor = setup.factor(start, LidarNoise(0.03, beam, loss, LOSS_SCALE), scheme=scheme, bin_s=5e-3)
    state = setup.perturbed(rng, 0.5)

    def residual(at):
        out = factor.output()
        for piece in make_pieces(len(at.seconds), setup.layout.size):
            factor.accumulate(at, piece, out, sums=False)
        return np.append(out.residual.ravel(), beside_rows @ by_rings(at))

    def accumulate(at, piece, sums):
        return factor.accumulate(at, piece, factor.output(), sums)

    def by_rings(at):
        return (ring_errors(at, "lidar0") - ring_errors(start, "lidar0"))[:n_rings]

    walks, of_rings = lidar_walks(factor, start), factor.moments.rings.astype(np.float64)
    n_rings = of_rings.shape[1]
    # What the points have beyond the four rows of their entry, of which no pose knows.
    products = of_rings[:, :, 5:].sum(axis=0).T  # by the second error, of the first
    same_ring = np.tile(np.eye(16), (3, 3)) if rings else np.zeros((0, 0))
    beyond = same_ring * np.repeat(products, 16, axis=0)[:n_rings]
    beyond = beyond - np.einsum("ekc,elc->kl", of_rings[:, :, :4], of_rings[:, :, :4])
    squares, axes = np.linalg.eigh(beyond)  # of bands without a ring 0
    beside_rows = np.sqrt(np.maximum(squares, 0.0))[:, None] * axes.T

    def weights(at):
        """Of rows that the gyroscope's noise moves together, on each side of a keyframe; what it explains by slanted
        beams is part of their slope."""
        y, W = residual(at), np.eye(residual(at).size)
        for rows, J, slope in walks:
            W[np.ix_(rows, rows)] -= J @ np.linalg.solve(np.eye(3) + J.T @ J, J.T)
            y[rows] -= J @ np.linalg.solve(np.eye(3) + J.T @ J, J.T @ y[rows] + slope)
        return y, W

    def turned(at):
        unturned = np.zeros((len(factor.keyframe), 3))
        slanted = factor.moments.incidence[:, 0].sum() + lidar_rows_turned(factor, at, unturned)[1].sum()
        return slanted + of_rings[:, :, 4].sum(axis=0) @ by_rings(at)

    r, explained = residual(state), 0.0
    for rows, J, slope in walks:
        u = J.T @ r[rows] + slope
        explained += float(u @ np.linalg.solve(np.eye(3) + J.T @ J, u))
    cost = sum(accumulate(state, p, False) for p in make_pieces(len(state.seconds), setup.layout.size))
    assert cost == pytest.approx(0.5 * (float(r @ r) - explained) + turned(state), rel=1e-7)
    assert (explained > 0.1 * noisy) == (scheme == "inertial")
    return Sample("LidarFactor", setup, state, accumulate, residual, weights, potential=turned, made=factor)


def lidar_walks(factor, at):
    """Of the bins on each side of each keyframe: rows, derivatives (n, 3) by the turn that the gyroscope's noise makes,
    one standard deviation along the way, and what half the chi^2 changes with it as beams turn (3,)."""
    m, h = factor.moments, 1e-4
    bin_of = np.repeat(np.arange(len(m.seconds)), np.diff(m.start))
    side = 2 * factor.keyframe[bin_of] + (factor.noise_angle[bin_of] > 0.0)
    slopes = []
    for axis in h * np.eye(3):
        there, back = (lidar_rows_turned(factor, at, sign * factor.noise_angle[:, None] * axis) for sign in (1.0, -1.0))
        slopes.append([(a - b) / (2 * h) for a, b in zip(there, back, strict=True)])
    by_turn, as_beams_turn = (np.array(x) for x in zip(*slopes, strict=True))
    found = []
    for own in np.unique(side[factor.noise_angle[bin_of] != 0.0]):
        entries = np.flatnonzero(side == own)
        rows = (4 * entries[:, None] + np.arange(4)).ravel()
        found.append((rows, by_turn[:, entries].reshape(3, -1).T, as_beams_turn[:, entries].sum(axis=1)))
    return found


def lidar_rows_turned(factor, at, turn):
    """Rows (E, 4), and what slanted beams add to half the chi^2 (E,), with the IMU turned by `turn` (n, 3) rad at each
    bin."""
    m, name = factor.moments, factor.name
    bin_of = np.repeat(np.arange(len(m.seconds)), np.diff(m.start))
    times = m.seconds + offset_at(at, name, factor.keyframe, m.seconds)
    poses = poses_at(factor.scheme, times, factor.keyframe, at, factor.imu, factor.gravity, False)
    R = poses.rotation @ so3.exp_many(turn)
    R_lidar, p_lidar = R @ at.values[name, "rotation"], poses.position + R @ at.values[name, "translation"]
    values = [at.values[key] for key in factor.planes]
    plane = np.array(
        [[*v[:, 2], 0.0, 0.0, 0.0] if key[1] == "tilt" else v for v, key in zip(values, factor.planes, strict=True)]
    )
    plane = plane[m.plane]
    normal, point = plane[:, :3], plane[:, 3:]
    distance = np.einsum("ea,ea->e", normal, p_lidar[bin_of] - point)
    distance = np.column_stack([distance, np.einsum("eba,eb->ea", R_lidar[bin_of], normal)])
    L = np.zeros((len(plane), 4, 4))
    L[:, *np.tril_indices(4)] = m.root
    (offset, scale), before = (at.values[name, x][0] for x in ("range_offset", "range_scale")), factor.range_errors
    too_far = (offset - before[0]) / (1.0 + before[1])
    distance[:, 0] *= (1.0 + scale) / (1.0 + before[1])
    for e in range(len(plane)):  # x - too_far x / |x| at their mean
        mean, a = L[e, 1:, 0] / L[e, 0, 0], distance[e, 1:].copy()
        r = np.linalg.norm(mean)
        to_rest = np.eye(3) - np.outer(mean, mean) / r**2
        distance[e] -= too_far / r * np.append(a @ mean, to_rest @ a)
    rows, n_rings = np.einsum("eji,ej->ei", L, distance), len(factor.ring_errors)
    wrong = ring_errors(at, name)[:n_rings] - factor.ring_errors
    return rows + np.einsum("ekc,k->ec", m.rings[:, :, :4], wrong), np.einsum(
        "ej,ej->e", m.incidence[:, 1:], distance[:, 1:]
    )


def prior_sample(unlike, setup_of, sensor, name):
    setup = setup_of(unlike, imu_free=True)
    rng = np.random.default_rng(2)
    block, state = setup.layout.block(sensor, name), setup.perturbed(rng)
    value = setup.state.values[block.key]
    value = (
        value @ so3.exp(0.3 * rng.normal(size=3)) if block.kind == "rotation" else value + rng.normal(size=block.size)
    )
    prior = Prior(block, np.ascontiguousarray(value), rng.uniform(0.1, 0.5, block.size))

    def residual(at):
        x = at.values[block.key]
        error = so3.log(np.ascontiguousarray(value.T @ x)) if block.kind == "rotation" else x - value
        return error / prior.sigma

    def accumulate(at, piece, sums):
        return prior.accumulate(at, piece, sums) if piece.first == 0 else 0.0

    return Sample("Prior", setup, state, accumulate, residual, white(residual))


def bias_prior_sample(unlike, setup_of):
    setup = setup_of(unlike)

    def residual(at):
        return at.bias[0] / FIRST_BIAS_SIGMA

    return Sample(
        "accumulate_bias_prior",
        setup,
        setup.perturbed(np.random.default_rng(3)),
        lambda at, piece, sums: accumulate_bias_prior(at, piece, sums) if piece.first == 0 else 0.0,
        residual,
        white(residual),
    )


DRIVES = {
    "pair": {"radii": np.array([0.1, 0.11]), "baseline": np.array([0.45])},
    "twist": {"scales": np.array([1.1, 0.9])},
    "steered": {"radius": np.array([0.1]), "wheelbase": np.array([0.6]), "steering_offset": np.array([0.05])},
}


def with_wheels(setup, kind="pair"):
    """The setup with wheel0 in its state and layout; no motion that wheels could follow, which its Jacobians need not.

    Readings are constant: where they are not, the time derivative of a pose between stamps is exact to the part of the
    interval squared only (test_poses), and this check asks for more.
    """
    wheels = {
        "rotation": so3.exp(np.array([0.03, -0.05, 0.4])),
        "translation": np.array([-0.2, 0.1, -0.15]),
        "time_offset": np.array([0.013]),
        "clock_rate": np.array([-90.0]),
        **DRIVES[kind],
    }
    entries = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in setup.layout.blocks]
    entries += [("wheel0", k, "rotation" if k == "rotation" else "vector", len(v), True) for k, v in wheels.items()]
    values = setup.state.values | {("wheel0", k): v for k, v in wheels.items()} | {("wheel0", MIDDLE): np.array([0.2])}
    gyro, accel = (np.ones((len(x), 1)) * x[5] for x in (setup.imu.gyro, setup.imu.accel))
    imu, state = replace(setup.imu, gyro=gyro, accel=accel), replace(setup.state, values=values)
    return replace(setup, layout=make_layout(entries), state=state, imu=imu)


def wheel_sample(
    unlike, setup_of, factor, imu_free=False, rate_hz=70.0, loss="none", curved=False, kind="pair", restarts=False,
    unit=False,
):  # fmt: skip
    setup = with_wheels(setup_of(unlike, imu_free=imu_free, size=unit), kind)
    setup = with_two_clocks(setup) if restarts else setup
    setup = in_unit(setup) if unit else setup
    rng = np.random.default_rng(4)
    # The last stamps lie beyond the IMU's recording.
    seconds = np.arange(0.0, setup.imu.seconds[-1], 1.0 / rate_hz)
    angles = 0.2 * np.cumsum(rng.normal(size=(len(seconds), 2)), axis=0)
    if kind == "steered":
        steer = np.cumsum(0.05 * rng.normal(size=len(seconds)))
        others = np.stack([np.cos(steer), np.sin(steer), np.ones(len(steer))], axis=1)
        angles = np.concatenate([angles[:, :1], np.cumsum(others, axis=0) / rate_hz], axis=1)
    noise = WheelNoise(1.0, 0.5, 0.3, loss, LOSS_SCALE, 0.7, 0.9, 0.4)
    own = "wheel0", seconds, angles, EstimatedMotion(setup.state, setup.imu, 9.81, 0.5), noise, setup.layout
    times = {"times": seconds + setup.state.values["wheel0", "time_offset"][0]} if restarts else {}
    made = factor.build(*own, **times) if kind == "pair" else factor.build(*own, kind, **times)
    state = setup.perturbed(rng, 0.3)

    return row_sample(setup, state, made, loss if curved else "none", curved)


def ground_sample(unlike, setup_of, plane, seen=True):
    """Wheels that are tilted on the plane and high above it."""
    setup = with_wheels(setup_of(unlike))
    key = ("plane 0", "plane")
    own = {("wheel0", "ground_height"): np.array([0.05])}
    own |= {key: plane_of(np.array([0.1, -0.2, -1.0]), np.array([0.3, 0.2, -0.4]))} if seen else {}
    entries = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in setup.layout.blocks]
    entries += [("wheel0", "ground_height", "vector", 1, True)] + ([(*key, "plane", 3, True)] if seen else [])
    state = replace(setup.state, values=setup.state.values | own)
    setup = replace(setup, layout=make_layout(entries), state=state)
    ground = Ground(plane, 0.3, 0.1, 0.4, 0.2)
    made = GroundFactor.build("wheel0", ground, (key if seen else None,), state, setup.layout)
    at = setup.perturbed(np.random.default_rng(3), 0.3)

    def residual(at):
        out = made.output()
        for piece in make_pieces(len(at.seconds), setup.layout.size):
            made.accumulate(at, piece, out, sums=False)
        return out.residual.ravel()

    def accumulate(at, piece, sums):
        return made.accumulate(at, piece, made.output(), sums)

    return Sample("GroundFactor", setup, at, accumulate, residual, white(residual), made=made)


def with_poses(setup, starts):
    """The setup with mocap0 in its state and layout, and the keyframes of recordings that begin at `starts`; readings
    are constant, as in `with_wheels`."""
    rng = np.random.default_rng(6)
    mount = {"rotation": so3.exp(rng.normal(size=3)), "translation": rng.normal(size=3), "time_offset": np.zeros(1)}
    mount |= {"scale": np.array([1.03]), "position_rotation": np.array([0.4, -0.2, 0.5])}
    mount |= {"clock_rate": np.array([70.0])}
    entries = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in setup.layout.blocks]
    entries += [("mocap0", k, "rotation" if k == "rotation" else "vector", len(v), True) for k, v in mount.items()]
    values = (
        setup.state.values
        | {("mocap0", k): v for k, v in mount.items()}
        | {("mocap0", MIDDLE): np.linspace(0.2, 0.3, len(starts))}
    )
    for k in range(1, len(starts)):
        entries += [(in_recording("board0", k), "tilt", "tilt", 2, True)]
        values[in_recording("board0", k), "tilt"] = so3.exp(rng.normal(size=3))
    for k in range(len(starts)):
        entries += [(frame_of("mocap0", k), "frame_rotation", "rotation", 3, True)]
        entries += [(frame_of("mocap0", k), "frame_translation", "vector", 3, True)]
        values[frame_of("mocap0", k), "frame_rotation"] = so3.exp(rng.normal(size=3))
        values[frame_of("mocap0", k), "frame_translation"] = rng.normal(size=3)
    gyro, accel = (np.ones((len(x), 1)) * x[5] for x in (setup.imu.gyro, setup.imu.accel))
    imu = replace(setup.imu, gyro=gyro, accel=accel)
    return replace(
        setup, layout=make_layout(entries), imu=imu, state=replace(setup.state, values=values, starts=starts)
    )


def pose_sample(
    unlike, setup_of, factor, imu_free=False, loss="none", curved=False, rate_hz=90.0, starts=(0,), restarts=False
):
    """Poses that wander by 0.1 to 0.3 rad and m, far from what the state predicts: residuals are large."""
    setup = with_poses(setup_of(unlike, imu_free=imu_free), starts)
    setup = with_two_clocks(setup, starts[1]) if restarts else setup
    rng = np.random.default_rng(7)
    seconds = np.arange(0.0, setup.imu.seconds[-1], 1.0 / rate_hz)
    rotation = np.array([so3.exp(v) for v in np.cumsum(0.1 * rng.normal(size=(len(seconds), 3)), axis=0)])
    position = np.cumsum(0.1 * rng.normal(size=(len(seconds), 3)), axis=0)
    stamps = np.round(1e9 * seconds).astype(np.int64)
    joins = (int(stamps[len(stamps) // 2]),) if restarts else ()
    stream = PoseStream("mocap0", stamps, rotation, position, joins_ns=joins)
    motion = EstimatedMotion(setup.state, setup.imu, 9.81, 0.5)
    made = factor.build(stream, motion, PoseNoise(0.5, 0.3, loss, LOSS_SCALE), setup.layout)
    state = setup.perturbed(rng, 0.3)

    return row_sample(setup, state, made, loss if curved else "none", curved)


POSITIONS_HAVE = ("translation", "time_offset", "clock_rate")


def position_sample(
    unlike, setup_of, imu_free=False, frame="frame_yaw", loss="none", curved=False, starts=(0,), restarts=False,
    stated=True, density=0.0, increments=False,
):  # fmt: skip
    """Fixes that wander by 0.3 m, far from what the state predicts, with correlated covariances where they are
    `stated`; the frame is levelled, turned anyhow, or that of the target. density: of their slow offset, or 0, and
    every fourth fix is then an outlier; `increments`: the factor of this offset."""
    setup = with_poses(setup_of(unlike, imu_free=imu_free), starts)
    blocks = [b for b in setup.layout.blocks if b.sensor != "mocap0" or b.name in POSITIONS_HAVE]
    values = dict(setup.state.values)
    entries = []
    for b in blocks:
        if frame == "frame_yaw" and b.name == "frame_rotation":
            entries.append((b.sensor, "frame_yaw", "vector", 1, True))
            values[b.sensor, "frame_yaw"] = np.array([2.0 + len(entries)])
        else:
            entries.append((b.sensor, b.name, b.kind, b.size, b.start is not None))
    for entry in knot_entries("mocap0", len(starts)) if density else ():
        entries.append(entry)
        values[entry[:2]] = 0.3 * np.sin(np.arange(3.0) + len(entries))
    setup = replace(setup, layout=make_layout(entries), state=replace(setup.state, values=values))
    setup = with_two_clocks(setup, starts[1]) if restarts else setup
    rng = np.random.default_rng(8)
    seconds = np.arange(0.0, setup.imu.seconds[-1], 1.0 / 25.0)
    stamps = np.round(1e9 * seconds).astype(np.int64)
    root = rng.normal(size=(len(seconds) if stated else 0, 3, 3)) + 2.0 * np.eye(3)
    position = np.cumsum(0.3 * rng.normal(size=(len(seconds), 3)), axis=0)
    joins = (int(stamps[len(stamps) // 2]),) if restarts else ()
    stream = PositionStream("mocap0", stamps, position, root @ root.transpose(0, 2, 1), joins_ns=joins)
    made = PositionFactor.build(
        stream, EstimatedMotion(setup.state, setup.imu, 9.81, 0.5), PositionNoise(0.3, 0.5, loss, LOSS_SCALE),
        setup.layout, "target" if frame == "tilt" else "mocap0",
    )  # fmt: skip
    if increments:
        made = OffsetWalkFactor.build(stream, EstimatedMotion(setup.state, setup.imu, 9.81, 0.5), density, setup.layout)
    elif density:
        made = replace(made.with_slow_offset(stream, density), used=np.arange(len(made.seconds)) % 4 > 0)
    state = setup.perturbed(rng, 0.3)

    return row_sample(setup, state, made, loss if curved else "none", curved)


def board_sample(kind, loss: Loss = "none", curved=False):
    """Points at rest, anywhere near planes of two bodies, one of which stands in the scene."""
    rng, n = np.random.default_rng(9), 60
    target = Scene(("wall", "floor"), (Checkerboard(4, 5, 0.1, sheet=(0.8, 0.9)), AprilGrid(2, 2, 0.1, 0.3)))
    bodies = Bodies(target, (0, 1))
    entries = [spec.entry("lidar0", spec.name != "time_offset") for spec in Lidar.parameters]
    layout = make_layout([*entries, TILT.entry("board0", False), *bodies.pose_entries()])
    values = {("wall", "sheet_middle"): np.zeros(2)} | {
        (b.sensor, b.name): so3.exp(rng.normal(size=3)) if b.kind == "rotation" else 0.1 * rng.normal(size=b.size)
        for b in layout.blocks
    }
    values["board0", "tilt"] = np.eye(3)
    rotation = np.array([so3.exp(v) for v in rng.normal(size=(4, 3))])
    still = np.zeros((4, 3)), np.zeros((4, 6)), values
    state = State(np.arange(4.0), rotation, rng.normal(size=(4, 3)), *still)
    keyframe, normal = np.repeat(np.sort(rng.integers(0, 4, n // 2)), 2), rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = BoardPoints(
        keyframe.astype(float), 3.0 * rng.normal(size=(n, 3)), keyframe, keyframe, rng.integers(0, 2, n), normal,
        rng.normal(size=n), np.ones(n),
    )  # fmt: skip
    noise, sigma = LidarNoise(1.0, 0.0, loss, LOSS_SCALE), rng.uniform(0.5, 2.0, n if kind == ON_BOARDS else n // 2)
    made = BoardFactor("lidar0", kind, points, sigma, noise, bodies, (0,), 4, layout)
    setup = SimpleNamespace(layout=layout, columns_scale=lambda: np.full(layout.size, 1e-2))
    return row_sample(setup, state, steep_only(made, state), loss if curved else "none", curved)


def steep_only(made, state):
    """The factor without grazing beams, whose residuals bend within a step."""
    steep = np.abs(made.rows_of_points(slice(None), state, False)[1]) > 0.4
    steep = np.repeat(steep.reshape(len(made.sigma), -1).all(axis=1), made.points_per_row)
    return replace(made, points=made.points.some(steep), sigma=made.sigma[steep[:: made.points_per_row]])


def moving_board_sample(unlike, setup_of):
    """Rings that cross the edges of a sheet in two recordings, each end at its own instant, up to 30 ms from the
    keyframe that both ends share."""
    setup, rng, n = setup_of(unlike, imu_free=True), np.random.default_rng(11), 80
    old = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in setup.layout.blocks]
    layout = make_layout([*old, *(spec.entry("lidar0") for spec in Lidar.parameters), SHEET_MIDDLE.entry("board0")])
    more = {b.key: 0.1 * rng.normal(size=b.size) for b in layout.blocks if b.key not in setup.state.values}
    more |= {("lidar0", "rotation"): so3.exp(rng.normal(size=3)), ("lidar0", MIDDLE): np.array([0.2])}
    setup = replace(setup, layout=layout, state=replace(setup.state, values=setup.state.values | more))
    setup = with_two_clocks(setup)
    layout, state = setup.layout, setup.perturbed(rng, 0.02)
    keyframe = np.repeat(np.sort(rng.integers(1, len(state.seconds) - 1, n // 2)), 2)
    seconds = seconds_at(state, "lidar0")[keyframe] + rng.uniform(-0.03, 0.03, n)
    normal = rng.normal(size=(n, 3)) * [1.0, 1.0, 0.0]
    points = BoardPoints(
        seconds, 3.0 * rng.normal(size=(n, 3)), keyframe, keyframe, np.zeros(n, dtype=int), normal, rng.normal(size=n),
        np.ones(n),
    )  # fmt: skip
    bodies, sigma = Bodies(Checkerboard(4, 5, 0.1, sheet=(0.8, 0.9)), (0,)), rng.uniform(0.5, 2.0, n // 2)
    noise, count = LidarNoise(1.0, 0.0, "none", LOSS_SCALE), len(state.seconds)
    made = BoardFactor("lidar0", ON_EDGES, points, sigma, noise, bodies, state.starts, count, layout, setup.imu, 9.81)
    return row_sample(setup, state, steep_only(made, state), "none", False)


def patch_sample(loss: Loss = "none", curved=False):
    """Rows of any combinations of points on patches, of three LiDARs of which one is the body."""
    rng, n, names = np.random.default_rng(10), 40, ("lidar0", "lidar1", "lidar2")
    specs = [(name, spec) for name in names for spec in Lidar.parameters]
    free = [name != "lidar0" and spec.name in ("rotation", "translation") for name, spec in specs]
    layout = make_layout([spec.entry(name, f) for (name, spec), f in zip(specs, free, strict=True)])
    values = {
        (b.sensor, b.name): so3.exp(rng.normal(size=3)) if b.kind == "rotation" else rng.normal(size=b.size)
        for b in layout.blocks
    }
    still = np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3)), np.zeros((4, 3)), np.zeros((4, 6))
    normal, offset, moments = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), rng.normal(size=(n, 3, 3))
    rows = PatchRows(offset, moments, normal, rng.normal(size=(n, 3)), np.sort(rng.integers(0, 4, n)), 0.02)
    none = PatchPoints(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0, int))
    noise = LidarNoise(1.0, 0.0, loss, LOSS_SCALE)
    made = PatchFactor("lidar0", names, none, rows, noise, (0,), 4, layout)
    setup = SimpleNamespace(layout=layout, columns_scale=lambda: np.full(layout.size, 1e-2))
    return row_sample(setup, State(np.arange(4.0), *still, values), made, loss if curved else "none", curved)


SAMPLES = {
    "imu": ("ImuFactor", lambda u, s, f: imu_sample(u, s, False)),
    "imu, intrinsics": ("ImuFactor", lambda u, s, f: imu_sample(u, s, True)),
    "imu, size effect": ("ImuFactor", lambda u, s, f: imu_sample(u, s, True, places=True)),
    "imu, unit of length": ("ImuFactor", lambda u, s, f: imu_sample(u, s, False, unit=True)),
    "imu, intrinsics, unit of length": ("ImuFactor", lambda u, s, f: imu_sample(u, s, True, unit=True)),
    "mounted imu": ("MountedImuFactor", lambda u, s, f: mounted_imu_sample(u, s, False)),
    "mounted imu, intrinsics, gaps": ("MountedImuFactor", lambda u, s, f: mounted_imu_sample(u, s, True, True)),
    "slow motion": ("SlowMotion", lambda u, s, f: slow_motion_sample(u, s)),
    "radtan, inertial": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 0)),
    "radtan, kinematic, intrinsics": (
        "CornerFactor",
        lambda u, s, f: corner_sample(u, s, f, 0, "kinematic", imu_free=True),
    ),
    "equidistant, inertial, intrinsics": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 1, imu_free=True)),
    "equidistant, kinematic": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 1, "kinematic")),
    "equidistant, pose": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 1, "pose")),
    "radtan, pose, intrinsics": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 0, "pose", imu_free=True)),
    "common shift": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 0, field=1)),
    "common field": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 1, "pose", field=3)),
    "huber": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 0, loss="huber")),
    "cauchy": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 1, loss="cauchy")),
    "huber, common field": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 0, loss="huber", field=3)),
    "huber, curved": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 0, loss="huber", curved=True)),
    "cauchy, curved": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 0, "pose", loss="cauchy", curved=True)),
    "cauchy, common shift, curved": (
        "CornerFactor",
        lambda u, s, f: corner_sample(u, s, f, 1, loss="cauchy", field=1, curved=True),
    ),
    "size of the target": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 1, size=True)),
    "three bodies": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 0, imu_free=True, split=True, size=True)),
    "three bodies, huber, common shift, pose": (
        "CornerFactor",
        lambda u, s, f: corner_sample(u, s, f, 1, "pose", loss="huber", field=1, curved=True, split=True),
    ),
    "clocks that restart": (
        "CornerFactor",
        lambda u, s, f: corner_sample(u, s, f, 0, imu_free=True, restarts=True),
    ),
    "rolling shutter": ("CornerFactor", lambda u, s, f: corner_sample(u, s, f, 0, imu_free=True, rolls=True)),
    "rolling shutter, columns, three bodies, pose": (
        "CornerFactor",
        lambda u, s, f: corner_sample(u, s, f, 1, "pose", field=1, split=True, rolls=True),
    ),
    "features, clocks that restart": (
        "FeatureFactor",
        lambda u, s, f: feature_sample(u, s, f, imu_free=True, restarts=True),
    ),
    "features": ("FeatureFactor", lambda u, s, f: feature_sample(u, s, f)),
    "features, intrinsics, kinematic": (
        "FeatureFactor",
        lambda u, s, f: feature_sample(u, s, f, "kinematic", imu_free=True),
    ),
    "features, pose": ("FeatureFactor", lambda u, s, f: feature_sample(u, s, f, "pose")),
    "features on planes": ("FeatureFactor", lambda u, s, f: feature_sample(u, s, f, on_planes=True)),
    "features on planes, intrinsics, huber, curved": (
        "FeatureFactor",
        lambda u, s, f: feature_sample(u, s, f, loss="huber", imu_free=True, curved=True, on_planes=True),
    ),
    "features on planes, cauchy, curved, pose": (
        "FeatureFactor",
        lambda u, s, f: feature_sample(u, s, f, "pose", "cauchy", curved=True, on_planes=True),
    ),
    "features, rolling shutter": ("FeatureFactor", lambda u, s, f: feature_sample(u, s, f, imu_free=True, rolls=True)),
    "features, huber": ("FeatureFactor", lambda u, s, f: feature_sample(u, s, f, loss="huber")),
    "features, cauchy, curved, pose": (
        "FeatureFactor",
        lambda u, s, f: feature_sample(u, s, f, "pose", "cauchy", curved=True),
    ),
    "lidar": ("LidarFactor", lambda u, s, f: lidar_sample(*s)),
    "lidar, noisy gyroscope": ("LidarFactor", lambda u, s, f: lidar_sample(*s, beam=0.02, imu_free=True, noisy=30.0)),
    "lidar, huber, beam, kinematic, intrinsics": (
        "LidarFactor",
        lambda u, s, f: lidar_sample(*s, scheme="kinematic", loss="huber", beam=0.02, imu_free=True),
    ),
    "lidar, cauchy, pose, intrinsics": (
        "LidarFactor",
        lambda u, s, f: lidar_sample(*s, scheme="pose", loss="cauchy", imu_free=True),
    ),
    "lidar, errors of rings": (
        "LidarFactor",
        lambda u, s, f: lidar_sample(*s, beam=0.02, noisy=30.0, rings=True),
    ),
    "lidar, clock that restarts": ("LidarFactor", lambda u, s, f: lidar_sample(*s, imu_free=True, restarts=True)),
    "shared surfaces": ("PatchFactor", lambda u, s, f: patch_sample()),
    "shared surfaces, huber, curved": ("PatchFactor", lambda u, s, f: patch_sample("huber", True)),
    "lidar, sheet, noisy gyroscope, beam": (
        "LidarFactor",
        lambda u, s, f: lidar_sample(*s, beam=0.02, noisy=30.0, sheet=True),
    ),
    "points on boards": ("BoardFactor", lambda u, s, f: board_sample(ON_BOARDS)),
    "edges of boards in motion": ("BoardFactor", lambda u, s, f: moving_board_sample(u, s)),
    "edges of boards, huber, curved": ("BoardFactor", lambda u, s, f: board_sample(ON_EDGES, "huber", True)),
    "prior on a rotation": ("Prior", lambda u, s, f: prior_sample(u, s, "cam1", "rotation")),
    "prior on a vector": ("Prior", lambda u, s, f: prior_sample(u, s, "cam0", "intrinsics")),
    "prior on IMU intrinsics": ("Prior", lambda u, s, f: prior_sample(u, s, "imu0", "intrinsics")),
    "wheels": ("IncrementFactor", lambda u, s, f: wheel_sample(u, s, IncrementFactor)),
    "wheels, intrinsics": ("IncrementFactor", lambda u, s, f: wheel_sample(u, s, IncrementFactor, True)),
    "wheels with fewer stamps than keyframes": (
        "IncrementFactor",
        lambda u, s, f: wheel_sample(u, s, IncrementFactor, rate_hz=9.0),
    ),
    "wheels, huber": ("IncrementFactor", lambda u, s, f: wheel_sample(u, s, IncrementFactor, loss="huber")),
    "wheels, cauchy, curved": (
        "IncrementFactor",
        lambda u, s, f: wheel_sample(u, s, IncrementFactor, loss="cauchy", curved=True),
    ),
    "speed and yaw rate": ("IncrementFactor", lambda u, s, f: wheel_sample(u, s, IncrementFactor, kind="twist")),
    "steered, intrinsics": (
        "IncrementFactor",
        lambda u, s, f: wheel_sample(u, s, IncrementFactor, True, kind="steered"),
    ),
    "steered, huber, curved": (
        "IncrementFactor",
        lambda u, s, f: wheel_sample(u, s, IncrementFactor, loss="huber", curved=True, kind="steered"),
    ),
    "wheels, unit of length": (
        "IncrementFactor",
        lambda u, s, f: wheel_sample(u, s, IncrementFactor, loss="huber", curved=True, unit=True),
    ),
    "steered, unit of length": (
        "IncrementFactor",
        lambda u, s, f: wheel_sample(u, s, IncrementFactor, True, kind="steered", unit=True),
    ),
    "planar poses, unit of length": (
        "RelativePoseFactor",
        lambda u, s, f: wheel_sample(u, s, RelativePoseFactor, unit=True),
    ),
    "wheels, clock that restarts": (
        "IncrementFactor",
        lambda u, s, f: wheel_sample(u, s, IncrementFactor, True, restarts=True),
    ),
    "planar poses, clock that restarts": (
        "RelativePoseFactor",
        lambda u, s, f: wheel_sample(u, s, RelativePoseFactor, restarts=True),
    ),
    "ground, level": ("GroundFactor", lambda u, s, f: ground_sample(u, s, "level", False)),
    "ground, floor": ("GroundFactor", lambda u, s, f: ground_sample(u, s, "floor")),
    "planar poses": ("RelativePoseFactor", lambda u, s, f: wheel_sample(u, s, RelativePoseFactor)),
    "planar poses, intrinsics": ("RelativePoseFactor", lambda u, s, f: wheel_sample(u, s, RelativePoseFactor, True)),
    "planar poses, huber, curved": (
        "RelativePoseFactor",
        lambda u, s, f: wheel_sample(u, s, RelativePoseFactor, loss="huber", curved=True),
    ),
    "poses": ("AbsolutePoseFactor", lambda u, s, f: pose_sample(u, s, AbsolutePoseFactor)),
    "poses of two recordings, intrinsics": (
        "AbsolutePoseFactor",
        lambda u, s, f: pose_sample(u, s, AbsolutePoseFactor, True, starts=(0, 5)),
    ),
    "poses, cauchy, curved": (
        "AbsolutePoseFactor",
        lambda u, s, f: pose_sample(u, s, AbsolutePoseFactor, loss="cauchy", curved=True),
    ),
    "relative poses": ("RelativePosesFactor", lambda u, s, f: pose_sample(u, s, RelativePosesFactor)),
    "relative poses, intrinsics, few": (
        "RelativePosesFactor",
        lambda u, s, f: pose_sample(u, s, RelativePosesFactor, True, rate_hz=9.0),
    ),
    "relative poses, huber": (
        "RelativePosesFactor",
        lambda u, s, f: pose_sample(u, s, RelativePosesFactor, loss="huber"),
    ),
    "poses of two recordings, clock that restarts": (
        "AbsolutePoseFactor",
        lambda u, s, f: pose_sample(u, s, AbsolutePoseFactor, starts=(0, 5), restarts=True),
    ),
    "relative poses, clock that restarts": (
        "RelativePosesFactor",
        lambda u, s, f: pose_sample(u, s, RelativePosesFactor, True, starts=(0, 5), restarts=True),
    ),
    "positions": ("PositionFactor", lambda u, s, f: position_sample(u, s)),
    "positions, tilted frame, huber, intrinsics": (
        "PositionFactor",
        lambda u, s, f: position_sample(u, s, True, "frame_rotation", loss="huber", stated=False),
    ),
    "positions, frame of the target": ("PositionFactor", lambda u, s, f: position_sample(u, s, frame="tilt")),
    "positions of two recordings, clock that restarts, cauchy, curved": (
        "PositionFactor",
        lambda u, s, f: position_sample(u, s, loss="cauchy", curved=True, starts=(0, 5), restarts=True),
    ),
    "positions with a slow offset and outliers, huber": (
        "PositionFactor",
        lambda u, s, f: position_sample(u, s, loss="huber", density=0.4),
    ),
    "positions of two recordings with a slow offset": (
        "PositionFactor",
        lambda u, s, f: position_sample(u, s, density=0.4, starts=(0, 5), restarts=True),
    ),
    "slow offset": ("OffsetWalkFactor", lambda u, s, f: position_sample(u, s, density=0.4, increments=True)),
    "slow offset in two recordings": (
        "OffsetWalkFactor",
        lambda u, s, f: position_sample(u, s, density=0.4, starts=(0, 5), restarts=True, increments=True),
    ),
    "bias prior": ("accumulate_bias_prior", lambda u, s, f: bias_prior_sample(u, s)),
}


def factors_in_the_source():
    """Whatever adds to the normal equations: classes with `accumulate`, functions named so, of modules `residual`,
    `*_factor` and `arrowhead` of sensors and of what they share."""
    found = set()
    packages = (icalib.sensors, icalib.optim)
    for module in (m for p in packages for m in pkgutil.walk_packages(p.__path__, f"{p.__name__}.")):
        if module.name.endswith((".residual", "_factor", ".arrowhead")):
            for key, thing in vars(importlib.import_module(module.name)).items():
                own = getattr(thing, "__module__", None) == module.name and not inspect.isabstract(thing)
                if own and (hasattr(thing, "accumulate") or (key.startswith("accumulate") and callable(thing))):
                    found.add(key)
    return found


def test_every_factor_has_a_sample():
    assert factors_in_the_source() == {factor for factor, _ in SAMPLES.values()}


def sums_of(sample, dense):
    n, layout = len(sample.state.seconds), sample.setup.layout
    pieces = make_pieces(n, layout.size, layout.keyframe_dim)
    cost = sum(sample.accumulate(sample.state, p, True) for p in pieces)
    return cost, *dense(pieces, n)


def moved(sample, d):
    layout, n = sample.setup.layout, len(sample.state.seconds)
    o = layout.keyframe_dim * n
    return sample.state.retract(layout, d[:o].reshape(n, -1), d[o:])


def cost_at(sample, d):
    state = moved(sample, d)
    return sum(sample.accumulate(state, p, False) for p in make_pieces(len(state.seconds), sample.setup.layout.size))


def scales(sample):
    """Steps of each column: of the size that parameters have."""
    layout = sample.setup.layout
    one = [1e-2, 1e-2, 1e-2, 1e-3, 1e-2] + [1e-2, 1e-3, 1e-2] * len(layout.further_imus)
    chain = np.tile(np.repeat(one, 3), len(sample.state.seconds))
    return np.concatenate([chain, sample.setup.columns_scale()])


@pytest.fixture(scope="module")
def sample_of(unlike, setup_of, factor_of, features_of, features_on_planes, sparse_room, room_of):
    """Makes the sample of a name, once."""

    @cache
    def made_as(name):
        factor, make = SAMPLES[name]
        in_room = factor == "LidarFactor"
        factors = (features_of, features_on_planes) if factor == "FeatureFactor" else factor_of
        made = make(unlike, (sparse_room, room_of) if in_room else setup_of, factors)
        assert made.factor == factor
        return made

    return made_as


def directions(sample, H, singly):
    """(n, m): random steps of all columns at once, in which a wrong sum shows. singly: instead of them one column each,
    for two keyframes and all calibration parameters of the factor, so that none is small beside the others."""
    dim, rng = sample.setup.layout.keyframe_dim, np.random.default_rng(10)
    chain, first = dim * len(sample.state.seconds), dim * (len(sample.state.seconds) // 2)
    counts = np.diag(H) > 0.0
    alone = (
        counts
        & (np.arange(len(H)) >= first)
        & ((np.arange(len(H)) >= chain) | (np.arange(len(H)) < first + 2 * dim))
        & singly
    )
    mixed = [
        rng.normal(size=(len(H), m)) * (own & ~alone)[:, None] / np.sqrt(max(1, (own & ~alone).sum()))
        for own, m in ((counts, 6), (~counts, 2))
    ]
    return np.concatenate([np.eye(len(H))[:, alone], *mixed], axis=1)


FIRST = {factor: name for name, (factor, _) in reversed(SAMPLES.items())}  # the first sample of each factor


@each("name", SAMPLES)
def test_sums_are_those_of_numeric_derivatives(name, sample_of, dense):
    sums_are_those_of_numeric_derivatives(sample_of(name), dense, name in FIRST.values())


@pytest.mark.full
@each("name", SAMPLES)
def test_sums_are_those_of_numeric_derivatives_by_each_column(name, sample_of, dense):
    sums_are_those_of_numeric_derivatives(sample_of(name), dense, True)


def sums_are_those_of_numeric_derivatives(sample, dense, singly):
    _, H, g = sums_of(sample, dense)
    y, W = sample.weights(sample.state)
    scale, h = scales(sample), 5e-3
    D = directions(sample, H, singly) * scale[:, None]
    J, slope = np.empty((len(y), D.shape[1])), np.empty(D.shape[1])
    for n, d in enumerate(h * D.T):
        # Five points, whose error is of the fourth order, so that the step is large beside the rounding of
        # hundreds of readings.
        far, near = ((moved(sample, k * d), moved(sample, -k * d)) for k in (2, 1))
        J[:, n], slope[n] = (
            (8 * (f(near[0]) - f(near[1])) - (f(far[0]) - f(far[1]))) / (12 * h)
            for f in (sample.residual, sample.potential)
        )
    H, g = D.T @ H @ D, D.T @ g
    numeric_H, numeric_g = J.T @ (W @ J), J.T @ y + slope
    size = np.sqrt(np.maximum(np.diag(numeric_H), 1e-9 * np.diag(numeric_H).max()))
    assert np.abs(numeric_g).max() > 0
    # Interpolated are mostly columns of biases, which have little effect within an image.
    off = (5e-3 if singly else 5e-6) if sample.rolls else 2e-6
    np.testing.assert_allclose(H / np.outer(size, size), numeric_H / np.outer(size, size), rtol=0, atol=off)
    np.testing.assert_allclose(
        g / size, numeric_g / size, rtol=0, atol=off * np.sqrt(y @ sample.residual(sample.state))
    )


@each("name", SAMPLES)
def test_gradient_is_the_slope_of_the_cost(name, sample_of, dense):
    sample = sample_of(name)
    cost, _, g = sums_of(sample, dense)
    assert cost > 0
    rng, scale, h = np.random.default_rng(9), scales(sample), 2e-5
    for _ in range(4):  # each moves all columns
        d = rng.normal(size=len(g)) * scale
        slope = (cost_at(sample, h * d) - cost_at(sample, -h * d)) / (2 * h)
        tolerance = 1e-4 if sample.rolls else sample.tolerance
        assert slope == pytest.approx(g @ d, rel=tolerance, abs=tolerance * float(np.linalg.norm(g * scale)))


@each("name", [name for name in SAMPLES if "rolling" in name])
def test_the_column_of_a_readout_time_is_not_interpolated(name, sample_of, dense):
    sample = sample_of(name)
    _, H, g = sums_of(sample, dense)
    y, W = sample.weights(sample.state)
    k, h = int(sample.setup.layout.columns(*readout_key(sample))[0]) - sample.setup.layout.size, 5e-6
    step = h * np.eye(len(H))[k]
    J = (sample.residual(moved(sample, step)) - sample.residual(moved(sample, -step))) / (2 * h)
    assert H[k, k] == pytest.approx(J @ (W @ J), rel=1e-4)
    assert g[k] == pytest.approx(J @ y, rel=1e-4)


def readout_key(sample):
    return next(b.key for b in sample.setup.layout.blocks if b.name == "readout")


@each("name", SAMPLES)
def test_cost_without_sums_is_the_cost_with_them(name, sample_of, dense):
    sample = sample_of(name)
    assert cost_at(sample, np.zeros(len(scales(sample)))) == pytest.approx(sums_of(sample, dense)[0], rel=1e-13)


@each("name", SAMPLES)
def test_rows_are_the_residuals_by_kind(name, sample_of):
    """Number, chi^2, RMS and unit are those that the factor gives for each kind; times are those of the keyframes."""
    sample = sample_of(name)
    if sample.made is None:
        assert sample.factor in ("Prior", "accumulate_bias_prior")
        return
    made, state = sample.made, sample.state
    out = output_at(made, state)
    rows, squares, sizes = made.rows(out, state), made.squares(out), made.sizes(out)
    common = {kind for _, kind in squares if kind in (SHIFT, DELAY)}
    assert {(r.sensor, r.kind) for r in rows} >= {key for key in squares if key[1] not in {*common, ON_PLANES}}
    for r in rows:
        assert r.residual.shape == r.sigma.shape == r.whitened.shape == r.root.shape
        assert len(r.seconds) == len(r.residual) > 0
        assert state.seconds[0] - 0.1 < r.seconds.min() and r.seconds.max() < state.seconds[-1] + 0.1
        if not common:  # these have a part of the corners' residuals
            assert (r.weighted**2).sum() == pytest.approx(squares[r.sensor, r.kind].chi2, rel=1e-4)
        size = sizes[r.sensor, r.kind]
        if size.rms is not None and r.unit:
            assert (np.sqrt(np.mean(r.residual[r.root > 0.0] ** 2)), r.unit) == (pytest.approx(size.rms), size.unit)
    if hasattr(made, "W"):  # whitened jointly
        variance = np.diagonal(np.linalg.inv(made.W.transpose(0, 2, 1) @ made.W), axis1=1, axis2=2)
        np.testing.assert_allclose(np.concatenate([r.sigma for r in rows], axis=1) ** 2, variance)
