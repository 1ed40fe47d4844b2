"""The compiled corner factor against slow, obvious formulas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from tests.cases import each

from icalib.optim.arrowhead import Piece, make_pieces
from icalib.sensors.camera.corner_factor import CornerNoise
from icalib.tools.simulation.projection import project


@pytest.fixture(scope="module")
def setup(unlike, setup_of):
    return setup_of(unlike)


@pytest.fixture(scope="module")
def near(setup):
    """Near the truth, where no image lies on a stamp of the IMU: there the rate jumps."""
    return setup.perturbed(np.random.default_rng(8), 0.1)


def run(factor, state, sums=False):
    """Cost, output in double precision, and pieces."""
    out = factor.output(np.float64)
    pieces = make_pieces(factor.n_keyframes, factor.layout.size)
    return sum(factor.accumulate(state, p, out, sums) for p in pieces), out, pieces


def noisy(factor, seed=0, size=1.0):
    uv = factor.stream.uv + size * np.random.default_rng(seed).normal(size=factor.stream.uv.shape)
    return replace(factor, stream=replace(factor.stream, uv=uv))


@each("split", [False, True])
@each("camera", [0, 1])
def test_residual_is_the_obvious_formula_at_the_true_motion(unlike, setup_of, factor_of, camera, split):
    """Board, bloom and camera other than the truth; the IMU where it truly was, 5 ms later, on a stamp of the IMU."""
    setup = setup_of(unlike, split=split, shape=True)
    factor, rng = factor_of(setup, camera), np.random.default_rng(1)
    name, sim_camera = factor.name, setup.sim.scenario.cameras[camera]
    factor = replace(factor, direction=rng.normal(size=factor.stream.uv.shape).astype(np.float32))
    bodies, target = setup.bodies, setup.bodies.target
    shapes = {(body, "shape"): 2e-3 * rng.normal(size=11) for body in bodies.names}
    values = (
        setup.state.values
        | shapes
        | {
            (name, "bloom"): np.array([0.3]),
            (name, "time_offset"): setup.state.values[name, "time_offset"] + 5e-3,
            (name, "translation"): setup.state.values[name, "translation"] + [0.02, -0.05, 0.03],
        }
    )
    _, out, _ = run(factor, replace(setup.state, values=values))
    R, p, _ = setup.truth_at(factor.stream.seconds + values[name, "time_offset"][0])
    R_imu_cam, p_imu_cam = values[name, "rotation"], values[name, "translation"]
    predicted = np.empty_like(factor.stream.uv)
    for n, (i, q) in enumerate(zip(factor.stream.image, factor.stream.point, strict=True)):
        body = target.bodies[target.body[q]]
        point = target.points[q] + shapes[body, "shape"] @ bodies.basis[q]
        if body != bodies.names[0]:
            point = values[body, "rotation"] @ point + values[body, "translation"]
        world = values["board0", "tilt"] @ point
        X = R_imu_cam.T @ (R[i].T @ (world - p[i]) - p_imu_cam)
        predicted[n] = project(sim_camera, X) + values[name, "bloom"] * factor.direction[n]
    np.testing.assert_allclose(out.residual, predicted - factor.stream.uv, rtol=0, atol=5e-8)


def test_at_the_truth_nothing_is_left_between_keyframes_and_at_them(setup, factor_of):
    for camera in (0, 1):
        cost, out, _ = run(factor_of(setup, camera), setup.state)
        assert np.abs(out.residual).max() < 5e-8
        assert cost < 1e-9


@each("scheme", ["inertial", "kinematic", "pose"])
def test_the_lever_arm_turns_with_the_imu(setup, factor_of, scheme):
    factor = factor_of(setup, 1, scheme)
    values = setup.state.values | {("cam1", "time_offset"): setup.state.values["cam1", "time_offset"] + 7e-3}
    state = replace(setup.state, values=values)
    poses, camera = factor.imu_poses(state, 0, len(factor.keyframe)), factor.poses(state)
    R_cw, p_wc = camera.R_sensor_world, camera.p_world_sensor
    for i in range(len(p_wc)):
        np.testing.assert_allclose(
            p_wc[i], poses.position[i] + poses.rotation[i] @ values["cam1", "translation"], atol=1e-14
        )
        np.testing.assert_allclose(R_cw[i], (poses.rotation[i] @ values["cam1", "rotation"]).T, atol=1e-14)


def test_a_detection_one_pixel_to_the_right_has_residual_minus_one(setup, factor_of):
    factor = factor_of(setup, 0)
    uv = factor.stream.uv.copy()
    uv[7] += [1.0, 0.0]
    uv[9] += [0.0, 1.0]
    _, out, _ = run(replace(factor, stream=replace(factor.stream, uv=uv)), setup.state)
    np.testing.assert_allclose(out.residual[7], [-1.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(out.residual[9], [0.0, -1.0], atol=1e-8)


def losses(loss, scale, t):
    """Weight and cost of errors of t standard deviations, as in the textbooks."""
    if loss == "none":
        return np.ones_like(t), t**2 / 2
    if loss == "huber":
        return np.minimum(1.0, scale / t), np.where(t <= scale, t**2 / 2, scale * (t - scale / 2))
    return 1.0 / (1.0 + (t / scale) ** 2), scale**2 / 2 * np.log(1.0 + (t / scale) ** 2)


@each("loss", ["none", "huber", "cauchy"])
def test_weights_and_cost(setup, factor_of, loss):
    factor = noisy(factor_of(setup, 0))
    sigma = np.random.default_rng(2).uniform(0.3, 1.5, len(factor.stream.uv))
    factor = replace(factor, noise=replace(factor.noise, sigma=sigma, loss=loss, loss_scale=2.0))
    cost, out, _ = run(factor, setup.state)
    t = np.linalg.norm(out.residual, axis=1) / sigma
    assert (t > 2.0).any() and (t < 2.0).any()
    weight, each = losses(loss, 2.0, t)
    np.testing.assert_allclose(out.root, np.sqrt(weight) / sigma, rtol=1e-12)
    assert cost == pytest.approx(each.sum(), rel=1e-12)


@each(("loss", "tolerance"), [("none", 1e-9), ("huber", 1e-3), ("cauchy", 1e-3)])
@each("m", [1, 3])
def test_the_common_error_is_the_one_that_explains_the_image_best(setup, factor_of, loss, tolerance, m):
    factor = noisy(factor_of(setup, 0), size=0.6)
    n, rng, tau = len(factor.stream.uv), np.random.default_rng(3), np.array([0.7, 0.5, 0.3])[:m]
    field = rng.normal(size=(n, 2, m))
    shift = rng.normal(size=(len(factor.times), m)) * tau
    uv = factor.stream.uv + np.einsum("nak,nk->na", field, shift[factor.stream.image])
    noise = CornerNoise(np.full(n, 0.6), tau, field, loss, 2.0)
    factor = replace(factor, stream=replace(factor.stream, uv=uv), noise=noise)
    cost, out, _ = run(factor, setup.state)
    best = 0.0
    for i in range(len(factor.times)):
        mine = factor.stream.image == i

        def image_cost(c, mine=mine):
            error = np.linalg.norm(out.residual[mine] + field[mine] @ c, axis=1)
            return losses(loss, 2.0, error / 0.6)[1].sum() + 0.5 * ((c / tau) ** 2).sum()

        least = minimize(image_cost, np.zeros(m), tol=1e-12, method="BFGS", options={"gtol": 1e-6})
        best += least.fun
        np.testing.assert_allclose(out.shared[i].ravel(), least.x, rtol=0, atol=max(tolerance, 1e-6))
    assert cost == pytest.approx(best, rel=tolerance)


def test_estimating_the_common_error_explicitly_gives_the_same_normal_equations(setup, near, factor_of, dense):
    """A shift and a delay as three more unknowns of each image, eliminated by a dense Schur complement."""
    factor = replace(
        noisy(factor_of(setup, 0)), keep=np.random.default_rng(4).random(len(factor_of(setup, 0).keep)) < 0.1
    )
    n = len(factor.stream.uv)
    uv = factor.stream.uv
    field = np.concatenate([np.tile(np.eye(2), (n, 1, 1)), ((uv - [376.0, 240.0]) / 400.0)[:, :, None]], axis=2)
    tau = np.array([0.4, 0.3, 0.2])
    with_field = replace(factor, noise=replace(factor.noise, tau=tau, field=field))
    H, g = dense(run(with_field, near, sums=True)[2], factor.n_keyframes)
    J, r, F = whitened(factor, setup, near, field)
    M = F.T @ F + np.diag(np.tile(tau**-2.0, F.shape[1] // 3))
    taken = np.linalg.solve(M, F.T @ np.column_stack([J, r]))
    expected_H, expected_g = J.T @ J - J.T @ F @ taken[:, :-1], J.T @ r - J.T @ F @ taken[:, -1]
    size = np.sqrt(np.maximum(np.diag(expected_H), 1e-9 * np.diag(expected_H).max()))
    np.testing.assert_allclose(H / np.outer(size, size), expected_H / np.outer(size, size), rtol=0, atol=1e-6)
    np.testing.assert_allclose(g / size, expected_g / size, rtol=0, atol=1e-6 * float(np.linalg.norm(r)))
    _, out, pieces = run(with_field, near)
    pieces, B, cluster = make_pieces(factor.n_keyframes, factor.layout.size + 2), factor.layout.size, np.arange(n) % 2
    for piece in pieces:
        with_field.accumulate_clusters(near, piece, out, cluster, 2, B)
    left = r - F @ np.linalg.solve(M, F.T @ r)
    of_row = np.tile(cluster[factor.keep], 2)
    found = dense(pieces, factor.n_keyframes)[0][:, -2:]
    for k in range(2):
        pulled = np.linalg.solve(M, F.T @ (left * (of_row == k)))
        expected = J.T @ (left * (of_row == k)) - J.T @ F @ pulled
        np.testing.assert_allclose(
            found[: len(size), k] / size, expected / size, rtol=0, atol=1e-6 * float(np.linalg.norm(r))
        )


def whitened(factor, setup, state, field):
    """J by central differences, r, and the common errors' columns F, all over sigma = 0.2; rows: u, then v."""
    o, h = 15 * factor.n_keyframes, 1e-6

    def residual(d):
        _, out, _ = run(factor, state.retract(setup.layout, d[:o].reshape(-1, 15), d[o:]))
        return out.residual[factor.keep].T.ravel() / 0.2

    basis = np.eye(o + setup.layout.size)
    scale = np.concatenate([np.full(o, 10.0), setup.columns_scale() * 500.0])
    J = np.array(
        [(residual(h * s * e) - residual(-h * s * e)) / (2 * h * s) for e, s in zip(basis, scale, strict=True)]
    ).T
    image, f = factor.stream.image[factor.keep], field[factor.keep]
    F = np.concatenate([(image == i)[:, None, None] * f for i in range(len(factor.times))], axis=2) / 0.2
    return J, residual(np.zeros(len(basis))), np.concatenate([F[:, 0], F[:, 1]])


@pytest.mark.parametrize("loss", ["none", "cauchy"])
def test_single_precision_rounds_what_is_kept_and_not_the_sums(setup, near, factor_of, dense, loss):
    factor = noisy(factor_of(setup, 0))
    factor = replace(factor, noise=replace(factor.noise, loss=loss))
    cost, exact, pieces = run(factor, near, sums=True)
    out, others = factor.output(), make_pieces(factor.n_keyframes, factor.layout.size)
    assert sum(factor.accumulate(near, p, out, True) for p in others) == cost
    for a, b in zip(dense(others, factor.n_keyframes), dense(pieces, factor.n_keyframes), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in ((out.residual, exact.residual), (out.root, exact.root)):
        np.testing.assert_array_equal(a, b.astype(np.float32))


def test_corners_left_out_are_as_if_they_were_not_there(setup, factor_of, dense):
    factor = noisy(factor_of(setup, 0))
    keep = np.random.default_rng(6).random(len(factor.keep)) < 0.7
    cost, out, pieces = run(replace(factor, keep=keep), setup.state, sums=True)
    assert (out.root[~keep] == 0).all() and (out.root[keep] > 0).all()
    count = np.bincount(factor.stream.image[keep], minlength=len(factor.times))
    stream = replace(
        factor.stream,
        uv=factor.stream.uv[keep],
        point=factor.stream.point[keep],
        start=np.concatenate([[0], np.cumsum(count)]),
    )
    small = replace(
        factor,
        stream=stream,
        keep=np.ones(keep.sum(), bool),
        noise=replace(factor.noise, field=np.zeros((keep.sum(), 2, 0))),
    )
    cost_small, _, pieces_small = run(small, setup.state, sums=True)
    assert cost == pytest.approx(cost_small, rel=1e-12)
    for a, b in zip(dense(pieces, factor.n_keyframes), dense(pieces_small, factor.n_keyframes), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(b).max())


def test_corners_beyond_the_range_of_the_model_are_left_out(setup, factor_of):
    """A camera turned by 70 deg has part of the board behind it or beyond the monotonic range."""
    factor = noisy(factor_of(setup, 0))
    c, s = np.cos(np.deg2rad(70.0)), np.sin(np.deg2rad(70.0))
    turned = setup.state.values["cam0", "rotation"] @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    state = replace(setup.state, values=setup.state.values | {("cam0", "rotation"): turned})
    params = np.concatenate([state.values["cam0", "intrinsics"], state.values["cam0", "distortion"]])
    _, valid = factor.model.project(params, factor.points_in_camera(state, 0, len(factor.views.image))[0])
    assert valid.any() and not valid.all()
    cost, out, pieces = run(factor, state, sums=True)
    np.testing.assert_array_equal(out.root > 0, valid)
    alone, _, pieces_alone = run(replace(factor, keep=valid), state, sums=True)
    assert np.isfinite(cost) and cost == alone
    for a, b in zip(pieces, pieces_alone, strict=True):
        np.testing.assert_array_equal(a.diagonal, b.diagonal)


@pytest.mark.parametrize("scheme", ["inertial", "pose"])
def test_two_pieces_hold_what_one_holds(setup, near, factor_of, dense, scheme):
    factor = noisy(factor_of(setup, 1, scheme))
    cost, _, pieces = run(factor, near, sums=True)
    assert len(pieces) == 2
    whole = Piece.zeros(0, factor.n_keyframes - 1, factor.layout.size)
    assert factor.accumulate(near, whole, factor.output()) == pytest.approx(cost, rel=1e-12)
    for a, b in zip(dense(pieces, factor.n_keyframes), dense((whole,), factor.n_keyframes), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.abs(b).max())
