"""Kernels against slow, obvious formulas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.special import erf
from tests.cases import each

from icalib.detection.decoding import bilinear, lookup, mapped, popcount, read_cells, unit_homography, visible_cells
from icalib.detection.edge_model import fit_corners, fit_step, solve_small
from icalib.detection.growth import consistent_corners, fit_homography, largest_group
from icalib.detection.saddles import fit_crossing

H_TRUE = np.array([[30.0, 4.0, 100.0], [-3.0, 28.0, 80.0], [0.02, -0.03, 1.0]])


def greys(image):
    """As cameras give them: kernels are compiled for these."""
    return np.round(image).astype(np.uint8)


def step_image(normal, offset, blur, low=40.0, high=200.0, size=60, noise=0.0):
    v, u = np.indices((size, size)).astype(float)
    d = (normal[0] * u + normal[1] * v - offset) / (np.sqrt(2.0) * blur)
    image = low + (high - low) * 0.5 * (1.0 + erf(d))
    return greys(image + noise * np.random.default_rng(0).standard_normal(image.shape))


def test_popcount_and_lookup():
    rng = np.random.default_rng(1)
    values = rng.integers(0, 2**63, 50, dtype=np.uint64)
    assert [popcount(v) for v in values] == [bin(int(v)).count("1") for v in values]
    codes = values[:40].reshape(10, 4)
    assert lookup(codes[6, 3] ^ np.uint64(0b1010), codes) == (6, 3, 2)


def test_bilinear_is_linear_between_pixel_centres():
    image = np.add.outer(10.0 * np.arange(5), 3.0 * np.arange(6))
    assert bilinear(image, 2.25, 3.5) == pytest.approx(3.0 * 2.25 + 35.0)
    assert bilinear(image, 5.0, 4.0) == image[4, 5]


def test_homographies():
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    quad = np.array([mapped(H_TRUE, *p) for p in square])
    np.testing.assert_allclose(unit_homography(quad), H_TRUE, rtol=1e-10, atol=1e-12)
    xy = np.random.default_rng(2).uniform(-1.0, 3.0, (12, 2))
    uv = np.array([mapped(H_TRUE, *p) for p in xy])
    H = fit_homography(xy, uv, 12)
    np.testing.assert_allclose(H / H[2, 2], H_TRUE, rtol=1e-7, atol=1e-9)
    assert mapped(np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]]), 0.0, 0.0) == (-1e9, -1e9)


def test_solve_small():
    M = np.random.default_rng(3).standard_normal((6, 6))
    A, b = M @ M.T + np.eye(6), np.arange(6.0)
    np.testing.assert_allclose(solve_small(A, b), np.linalg.solve(A, b), rtol=1e-10)
    np.testing.assert_array_equal(solve_small(np.zeros((2, 2)), np.ones(2)), 0.0)


def test_read_cells_packs_row_by_row_and_counts_a_white_border():
    grey = np.zeros((6, 6))
    grey[2, 3] = grey[3, 2] = 100.0  # data cells (0, 1) and (1, 0) of 2 x 2
    assert read_cells(grey, 1, 50.0) == (0b0110, 0)
    grey[1, 1] = 100.0
    assert read_cells(grey, 1, 50.0) == (0b0110, 1)
    grey[2, 2] = np.nan
    assert visible_cells(grey, 1) == 0b0111


@each("side", [20.0, 30.0, 50.0])
def test_fit_step_is_the_least_squares_fit(side):
    normal = np.array([np.sin(0.3), -np.cos(0.3)])  # outward, for a side that runs along (cos, sin)
    along = np.array([np.cos(0.3), np.sin(0.3)])
    middle = np.array([30.0, 31.0])
    image = step_image(normal, normal @ middle, 1.1, size=62, noise=3.0)
    p0, p1 = middle - 0.5 * side * along, middle + 0.5 * side * along
    place, blur, contrast, at_ends = fit_step(image, *p0, *p1, 3.0, 3.5)

    v, u = np.indices(image.shape)
    t = ((u - middle[0]) * along[0] + (v - middle[1]) * along[1]) / (0.5 * side)
    d = (u - middle[0]) * normal[0] + (v - middle[1]) * normal[1]
    used = (np.abs(t) * 0.5 * side <= 0.5 * side - 3.0) & (np.abs(d) <= 3.5)
    bend = side >= 24.0

    def residual(p):
        z = (d[used] - p[0] - p[1] * t[used] - bend * p[5] * t[used] ** 2) / (np.sqrt(2.0) * p[2])
        return p[3] + (p[4] - p[3]) * 0.5 * (1.0 + erf(z)) - image[used]

    fit = least_squares(residual, [0.0, 0.0, 1.0, 40.0, 200.0, 0.0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(place, fit.x[[0, 1, 5]] * [1, 1, bend], atol=1e-4)
    assert (blur, contrast) == pytest.approx((fit.x[2], fit.x[4] - fit.x[3]), rel=1e-4)
    J = fit.jac[:, :5]
    ends = np.array([[1.0, s, 0, 0, 0] for s in (-1.0, 1.0)])
    np.testing.assert_allclose(at_ends[:, 0], np.diag(ends @ np.linalg.inv(J.T @ J) @ ends.T), rtol=1e-3)

    def with_bend(b):
        z = lambda p: d[used] - p[0] - p[1] * t[used] - b * t[used] ** 2  # noqa: E731
        step = lambda p: 0.5 * (1.0 + erf(z(p) / (np.sqrt(2.0) * p[2])))  # noqa: E731
        fixed = least_squares(lambda p: p[3] + (p[4] - p[3]) * step(p) - image[used], fit.x[:5], xtol=1e-14, gtol=1e-14)
        return ends @ fixed.x + b

    b = fit.x[5] * bend
    np.testing.assert_allclose(at_ends[:, 1], (with_bend(b + 1e-2) - with_bend(b - 1e-2)) / 2e-2, atol=3e-3)


def test_no_step_where_there_is_none_or_the_image_ends():
    flat = np.full((60, 60), 100, dtype=np.uint8)
    assert np.isnan(fit_step(flat, 10.0, 30.0, 40.0, 30.0, 3.0, 3.0)[3]).all()
    image = step_image(np.array([0.0, -1.0]), -2.0, 1.0)
    assert np.isnan(fit_step(image, 10.0, 2.0, 40.0, 2.0, 3.0, 3.0)[3]).all()


def test_sides_of_a_bent_quad_meet_in_its_corners():
    # A dark quad whose upper edge is bent by 0.3 px, as a lens does: its corners are where the arcs meet.
    v, u = np.indices((100, 100)).astype(float)
    bend = 0.3 * (1.0 - ((u - 50.0) / 30.0) ** 2)
    inside = [(u - 20.0), (80.0 - u), (v - 20.0 + bend), (80.0 - v)]
    grey = np.ones_like(u)
    for d in inside:
        grey = grey * 0.5 * (1.0 + erf(d / np.sqrt(2.0)))
    image = greys(200.0 - 160.0 * grey)
    quad = np.array([(20.4, 19.7), (80.3, 20.2), (79.8, 80.4), (19.6, 79.9)])
    corners, sigma, blur, _ = fit_corners(image, quad, 3.0, 4.0)
    np.testing.assert_allclose(corners, [(20, 20), (80, 20), (80, 80), (20, 80)], atol=0.01)
    np.testing.assert_allclose(blur, 1.0, rtol=0.02)
    assert (sigma > 0.0).all()


@pytest.mark.parametrize("turned", [False, True])
def test_fit_crossing_is_the_least_squares_fit(turned):
    ea, eb = np.array([30.0, 6.0]), np.array([-4.0, 28.0])
    truth, blur = np.array([30.3, 29.6]), (0.9, 1.1)
    v, u = np.indices((60, 60)).astype(float)

    def model(p):
        a, b = p[2], p[3]
        la = np.cos(a) * (v - p[1]) - np.sin(a) * (u - p[0])
        lb = np.sin(b) * (u - p[0]) - np.cos(b) * (v - p[1])
        return p[4] - p[5] * erf(la / (np.sqrt(2.0) * blur[0])) * erf(lb / (np.sqrt(2.0) * blur[1]))

    p_true = np.array([*truth, np.arctan2(ea[1], ea[0]), np.arctan2(eb[1], eb[0]), 120.0, 80.0])
    image = greys(model(p_true) + 3.0 * np.random.default_rng(4).standard_normal(u.shape))
    surroundings = np.array([0.5, np.inf, 0.15])
    sides = (eb, ea, blur[1], blur[0]) if turned else (ea, eb, *blur)
    found = fit_crossing(image, 30.0, 30.0, *sides[:2], surroundings, *sides[2:], 2.0)

    s, t = np.linalg.solve(np.stack([ea, eb], axis=1), np.stack([u - 30.0, v - 30.0]).reshape(2, -1)).reshape(2, 60, 60)
    la, lb = np.linalg.norm(ea), np.linalg.norm(eb)
    margin = 1.5 * max(blur) * la * lb / abs(ea[0] * eb[1] - ea[1] * eb[0])
    white_cells = (s * t < 0.0) & (np.abs(s) > 0.15 - margin / la) & (np.abs(t) > 0.15 - margin / lb)
    used = (np.abs(s) <= 6.0 / la) & (np.abs(t) <= 6.0 / lb) & ~white_cells
    fit = least_squares(lambda p: (model(p) - image)[used], p_true, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(found[:2], fit.x[:2], atol=1e-3)
    sigma = np.sqrt(0.5 * np.trace(np.linalg.inv(fit.jac.T @ fit.jac)[:2, :2]))
    assert found[2:4] == pytest.approx((sigma, 2.0 * fit.x[5]), rel=1e-2)


def bent_distance(u, v, corner, along, curvature):
    """From the edge through the corner along `along`, positive to its left, which bends to the left."""
    along = along / np.linalg.norm(along)
    x, y = u - corner[0], v - corner[1]
    t, d = along[0] * x + along[1] * y, along[1] * x - along[0] * y
    # The distance from a circle, not from a parabola.
    return d if curvature == 0.0 else 1.0 / curvature - np.sign(curvature) * np.hypot(t, d - 1.0 / curvature)


def covered(distance):
    """Share of each of the 8 x 8 parts of a pixel that lies at positive distances [px]."""
    return np.clip(0.5 + 8.0 * distance, 0.0, 1.0)


def photographed(dark, blur):
    """(60, 60) greys of the dark share (480, 480) of 8 x 8 parts of each pixel, blurred."""
    fine = gaussian_filter(200.0 - 160.0 * dark, 8.0 * blur)
    return fine.reshape(60, 8, 60, 8).mean(axis=(1, 3))


FINE_V, FINE_U = (np.indices((480, 480)) + 0.5) / 8.0 - 0.5
CURVATURES = [(0.004, 0.0), (0.0, -0.004), (-0.003, 0.005)]  # 1 / px: of a lens that bends much


@each("curvature", CURVATURES)
@each("turned", [False, True])
def test_a_crossing_moves_to_its_place_where_the_curvature_is_known(curvature, turned):
    ea, eb, corner = np.array([30.0, 6.0]), np.array([-4.0, 28.0]), np.array([30.3, 29.6])
    la = bent_distance(FINE_U, FINE_V, corner, ea, curvature[0])
    lb = bent_distance(FINE_U, FINE_V, corner, eb, curvature[1])
    a, b = covered(la), covered(lb)
    image = photographed(a * (1.0 - b) + (1.0 - a) * b, 0.9)
    blur = np.hypot(0.9, np.sqrt(1.0 / 12.0))
    sides, known = ((eb, ea), curvature[::-1]) if turned else ((ea, eb), curvature)
    surroundings = np.array([0.5, np.inf, np.inf])
    rng, before, after, edges = np.random.default_rng(6), [], [], np.zeros((2, 7))
    for _ in range(20):  # rounding alone moves a corner by 0.003 px; with noise before it, its mean is 0
        noisy = greys(image + rng.uniform(-0.5, 0.5, image.shape))
        u, v, _, _, edges = fit_crossing(noisy, 30.0, 30.0, *sides, surroundings, blur, blur, 2.0)
        before, after = [*before, (u, v)], [*after, np.array([u, v]) + np.array(known) @ edges[:, 4:6]]
        assert (edges[:, 6] == 0.0).all()
    assert np.linalg.norm(np.mean(before, axis=0) - corner) > 0.01
    np.testing.assert_allclose(np.mean(after, axis=0), corner, atol=0.002)
    for edge, side in zip(edges, sides, strict=True):
        np.testing.assert_allclose(edge[2:4], 6.0 * side / np.linalg.norm(side), rtol=0.05)
        np.testing.assert_array_equal(edge[:2], -edge[2:4])


@each("curvature", CURVATURES)
@each("length", [18.0, 36.0])
def test_corners_of_a_quad_move_to_their_places_where_curvatures_are_known(curvature, length):
    """Short sides are fitted as straight ones, long ones with a bend, and noise makes the fitted bend another one."""
    quad = 30.0 + length * (np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) - 0.5) + 0.2
    dark = np.ones_like(FINE_U)
    of_side = (curvature[0], curvature[1], 0.0, 0.0)
    for k, c in enumerate(of_side):
        middle, along = 0.5 * (quad[k] + quad[(k + 1) % 4]), quad[(k + 1) % 4] - quad[k]
        across = np.array([along[1], -along[0]]) / length
        sagitta = 0.0 if c == 0.0 else 1.0 / c - np.sign(c) * np.sqrt(1.0 / c**2 - 0.25 * length**2)
        dark *= covered(-bent_distance(FINE_U, FINE_V, middle - sagitta * across, along, c))
    image = photographed(dark, 0.9)
    rng, before, after, sigma = np.random.default_rng(0), [], [], np.zeros(4)
    for _ in range(40):
        corners, sigma, _, edges = fit_corners(greys(image + 2.0 * rng.standard_normal(image.shape)), quad, 3.0, 4.0)
        known = np.array([[of_side[k], of_side[k - 1]] for k in range(4)])
        moved = corners + ((known - edges[:, :, 6])[:, :, None] * edges[:, :, 4:6]).sum(axis=1)
        before, after = [*before, corners - quad], [*after, moved - quad]
        np.testing.assert_allclose(edges[:, 0, 2:4], np.roll(quad, -1, axis=0) - quad)
        np.testing.assert_allclose(edges[:, 1, :2], np.roll(quad, 1, axis=0) - quad)
    assert np.abs(np.mean(after, axis=0)).max() < 0.01
    scatter = np.sqrt(np.var(after, axis=0).mean())
    assert scatter == pytest.approx(2.0 * np.sqrt((sigma**2).mean()), rel=0.15)
    if length > 24.0:
        assert scatter < 0.9 * np.sqrt(np.var(before, axis=0).mean())
    else:
        assert np.abs(np.mean(before, axis=0)).max() > 0.03


def test_no_crossing_where_there_is_none_or_it_is_too_oblique_or_too_near_the_border():
    flat, surroundings = np.full((60, 60), 100, dtype=np.uint8), np.array([0.5, np.inf, np.inf])
    ea, eb = np.array([30.0, 0.0]), np.array([0.0, 30.0])
    assert np.isnan(fit_crossing(flat, 30.0, 30.0, ea, eb, surroundings, 1.0, 1.0, 2.0)[2])
    v, u = np.indices((60, 60)).astype(float)
    for at, sides, is_there in [(30.0, (ea, eb), True), (1.5, (ea, eb), False), (30.0, (ea, ea + 0.1 * eb), False)]:
        image = greys(120.0 - 80.0 * erf(u - at) * erf(v - 30.0))
        assert np.isfinite(fit_crossing(image, at, 30.0, *sides, surroundings, 0.7, 0.7, 2.0)[2]) == is_there


def grid(noise=0.05):
    xy = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
    uv = np.array([mapped(H_TRUE, *p) for p in xy])
    return xy, uv + noise * np.random.default_rng(5).standard_normal(uv.shape)


@each("row", [0, 14, 35])
def test_a_corner_that_is_off_is_inconsistent_and_no_other(row):
    xy, uv = grid()
    found, side = np.ones(36, dtype=bool), np.full(36, 30.0)
    assert consistent_corners(uv, xy, found, side, (480, 752)).all()
    uv[row] += (4.0, -4.0)
    np.testing.assert_array_equal(np.flatnonzero(~consistent_corners(uv, xy, found, side, (480, 752))), [row])


@each("focal", [120.0, 200.0, 320.0])
@each("row", [0, 14, 77])
def test_a_fisheye_bends_a_board_without_making_corners_inconsistent(focal, row):
    """An equidistant lens that sees the board from near, to 83 degrees from its axis."""
    xy = np.stack(np.meshgrid(np.arange(11.0), np.arange(7.0)), axis=-1).reshape(-1, 2)
    X = np.column_stack([xy - xy.mean(axis=0), np.full(77, 2.5)])
    X = X @ np.array([[1.0, 0.0, 0.0], [0.0, np.cos(0.5), -np.sin(0.5)], [0.0, np.sin(0.5), np.cos(0.5)]]).T
    radius = np.hypot(X[:, 0], X[:, 1])
    uv = (focal * np.arctan2(radius, X[:, 2]) / radius)[:, None] * X[:, :2] + (380.0, 235.0)
    uv += 0.05 * np.random.default_rng(2).standard_normal(uv.shape)
    found, side = np.ones(77, dtype=bool), np.full(77, 40.0)
    assert consistent_corners(uv, xy, found, side, (480, 752)).all()
    row = min(row, 76)
    uv[row] += (6.0, -6.0)
    np.testing.assert_array_equal(np.flatnonzero(~consistent_corners(uv, xy, found, side, (480, 752))), [row])


def test_the_largest_group_of_tags_that_agree_is_kept():
    row, col = np.divmod(np.arange(9), 3)
    board = 1.3 * np.stack([col, row], axis=1)[:, None, :] + np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])
    quads = np.array([[mapped(H_TRUE, *p) for p in tag] for tag in board])
    quads[4] += 60.0  # read where it is not
    known = np.ones(9, dtype=bool)
    known[7] = False
    expected = known.copy()
    expected[4] = False
    np.testing.assert_array_equal(largest_group(known, quads, board), expected)
    assert not largest_group(np.zeros(9, dtype=bool), quads, board).any()
