"""Compiled: a flat black and white pattern averaged over the cells of a grid finer than the pixels, and its blur.

A pixel whose footprint on the sheet lies in one cell of the pattern has that cell's grey. Every other pixel is cut
into s x s cells, each with a ray of its own, by the rays around the pixel to second order. To first order the place
on the sheet that a cell sees spreads like the sum of two uniform variables, so what lies between two edges of the
pattern is a difference of trapezoids' integrals: an edge is exact wherever it falls in the cell, not rounded to
samples.
"""

from __future__ import annotations

from math import erf

import numpy as np

from icalib.base.compiled import njit

_SLACK = 1.3  # of a pixel's linear footprint, for what the lens bends it


@njit(cache=True, nogil=True, error_model="numpy")
def paint(rays, by_u, by_v, bends, s, R, C, x_edges, y_edges, grey_of, fine):
    """Paints the sheet over the greys in `fine` (H s, W s), s x s cells a pixel.

    rays (H, W, 3) through the pixels' centres, their derivatives, and bends (3, H, W, 3), those by uu, uv and vv; NaN
    where there are none. R, C: rotation from the camera to the sheet, the camera's place on the sheet's frame; grey_of
    (ny, nx): grey of each cell.
    """
    for row in range(rays.shape[0]):
        for col in range(rays.shape[1]):
            X, Y, Xu, Yu, Xv, Yv, hits = _on_sheet(rays[row, col], by_u[row, col], by_v[row, col], R, C)
            if not hits:
                continue
            reach_x, reach_y = 0.5 * _SLACK * (abs(Xu) + abs(Xv)), 0.5 * _SLACK * (abs(Yu) + abs(Yv))
            if X + reach_x < x_edges[0] or X - reach_x > x_edges[-1]:
                continue
            if Y + reach_y < y_edges[0] or Y - reach_y > y_edges[-1]:
                continue
            i, j = _cell(x_edges, X), _cell(y_edges, Y)
            if (
                0 <= i < len(x_edges) - 1
                and 0 <= j < len(y_edges) - 1
                and X - reach_x >= x_edges[i]
                and X + reach_x <= x_edges[i + 1]
                and Y - reach_y >= y_edges[j]
                and Y + reach_y <= y_edges[j + 1]
            ):
                fine[row * s : (row + 1) * s, col * s : (col + 1) * s] = grey_of[j, i]
                continue
            for a in range(s):
                for b in range(s):
                    du, dv = (b + 0.5) / s - 0.5, (a + 0.5) / s - 0.5
                    x, y, z = _ray(rays[row, col], by_u[row, col], by_v[row, col], bends[:, row, col], du, dv)
                    grey, covered = _average(x, y, z, R, C, Xu / s, Yu / s, Xv / s, Yv / s, x_edges, y_edges, grey_of)
                    old = fine[row * s + a, col * s + b]
                    fine[row * s + a, col * s + b] = old * (1.0 - covered) + grey


@njit(cache=True, nogil=True, error_model="numpy")
def paint_discs(rays, by_u, by_v, bends, s, R, C, discs, black, fine):
    """Paints discs (n, 3), centre and radius on the sheet, over the greys in `fine`, as `paint` does rectangles.

    Within a cell, a quarter of a pixel, a disc's edge is taken for straight.
    """
    for row in range(rays.shape[0]):
        for col in range(rays.shape[1]):
            X, Y, Xu, Yu, Xv, Yv, hits = _on_sheet(rays[row, col], by_u[row, col], by_v[row, col], R, C)
            if not hits:
                continue
            reach = 0.5 * _SLACK * (np.hypot(Xu, Yu) + np.hypot(Xv, Yv))
            k = -1
            for i in range(len(discs)):
                if np.hypot(X - discs[i, 0], Y - discs[i, 1]) < discs[i, 2] + reach:
                    k = i
            if k < 0:
                continue
            for a in range(s):
                for b in range(s):
                    du, dv = (b + 0.5) / s - 0.5, (a + 0.5) / s - 0.5
                    d = np.array(_ray(rays[row, col], by_u[row, col], by_v[row, col], bends[:, row, col], du, dv))
                    x, y, xu, yu, xv, yv, hits = _on_sheet(d, by_u[row, col], by_v[row, col], R, C)
                    x, y = x - discs[k, 0], y - discs[k, 1]
                    far = np.hypot(x, y)
                    if not hits or far == 0.0:
                        share = 1.0 if hits else 0.0
                    else:
                        across_u, across_v = (x * xu + y * yu) / far / s, (x * xv + y * yv) / far / s
                        share = _below(discs[k, 2] - far, across_u, across_v)
                    cell = row * s + a, col * s + b
                    fine[cell] += share * (black - fine[cell])


@njit(cache=True, nogil=True)
def _ray(d, d_u, d_v, bend, du, dv):
    """The ray du, dv pixels beside the one that is d."""
    uu, uv, vv = 0.5 * du * du, du * dv, 0.5 * dv * dv
    x = d[0] + du * d_u[0] + dv * d_v[0] + uu * bend[0, 0] + uv * bend[1, 0] + vv * bend[2, 0]
    y = d[1] + du * d_u[1] + dv * d_v[1] + uu * bend[0, 1] + uv * bend[1, 1] + vv * bend[2, 1]
    z = d[2] + du * d_u[2] + dv * d_v[2] + uu * bend[0, 2] + uv * bend[1, 2] + vv * bend[2, 2]
    return x, y, z


@njit(cache=True, nogil=True, error_model="numpy")
def _on_sheet(d, d_u, d_v, R, C):
    """Where a ray meets the sheet, its derivatives by u and v, and whether it does, from either side."""
    z = R[2, 0] * d[0] + R[2, 1] * d[1] + R[2, 2] * d[2]
    t = -C[2] / z
    if not (t > 0.0 and t < 1e12):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False
    x = R[0, 0] * d[0] + R[0, 1] * d[1] + R[0, 2] * d[2]
    y = R[1, 0] * d[0] + R[1, 1] * d[1] + R[1, 2] * d[2]
    x_u = R[0, 0] * d_u[0] + R[0, 1] * d_u[1] + R[0, 2] * d_u[2]
    y_u = R[1, 0] * d_u[0] + R[1, 1] * d_u[1] + R[1, 2] * d_u[2]
    z_u = R[2, 0] * d_u[0] + R[2, 1] * d_u[1] + R[2, 2] * d_u[2]
    x_v = R[0, 0] * d_v[0] + R[0, 1] * d_v[1] + R[0, 2] * d_v[2]
    y_v = R[1, 0] * d_v[0] + R[1, 1] * d_v[1] + R[1, 2] * d_v[2]
    z_v = R[2, 0] * d_v[0] + R[2, 1] * d_v[1] + R[2, 2] * d_v[2]
    Xu, Yu, Xv, Yv = t * (x_u - x / z * z_u), t * (y_u - y / z * z_u), t * (x_v - x / z * z_v), t * (y_v - y / z * z_v)
    return C[0] + t * x, C[1] + t * y, Xu, Yu, Xv, Yv, np.isfinite(Xu + Yu + Xv + Yv)


@njit(cache=True, nogil=True)
def _cell(edges, value):
    """Index of the last edge that is not above `value`, -1 below all."""
    low, high = -1, len(edges)
    while high - low > 1:
        middle = (low + high) // 2
        if edges[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, nogil=True, error_model="numpy")
def _average(x, y, z, R, C, Xu, Yu, Xv, Yv, x_edges, y_edges, grey_of):
    """Mean grey over a cell whose centre has the ray (x, y, z), times the share that the sheet covers; and the share.

    X and Y are averaged apart: exact but where edges of both directions cross the same cell.
    """
    d_z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
    t = -C[2] / d_z
    if not t > 0.0:
        return 0.0, 0.0
    X = C[0] + t * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z)
    Y = C[1] + t * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z)
    reach_x, reach_y = 0.5 * (abs(Xu) + abs(Xv)), 0.5 * (abs(Yu) + abs(Yv))
    i0, i1 = max(_cell(x_edges, X - reach_x), 0), min(_cell(x_edges, X + reach_x), len(x_edges) - 2)
    j0, j1 = max(_cell(y_edges, Y - reach_y), 0), min(_cell(y_edges, Y + reach_y), len(y_edges) - 2)
    grey, covered = 0.0, 0.0
    below = _below(y_edges[j0] - Y, Yu, Yv) if j0 <= j1 else 0.0
    for j in range(j0, j1 + 1):
        above = _below(y_edges[j + 1] - Y, Yu, Yv)
        left = _below(x_edges[i0] - X, Xu, Xv) if i0 <= i1 else 0.0
        for i in range(i0, i1 + 1):
            right = _below(x_edges[i + 1] - X, Xu, Xv)
            share = (right - left) * (above - below)
            grey += share * grey_of[j, i]
            covered += share
            left = right
        below = above
    return grey, covered


@njit(cache=True, nogil=True, error_model="numpy")
def _below(q, a, b):
    """P(a U + b V < q) for U and V uniform between -1/2 and 1/2."""
    a, b = abs(a), abs(b)
    if a < b:
        a, b = b, a
    half, flat = 0.5 * (a + b), 0.5 * (a - b)
    if q <= -half:
        return 0.0
    if q >= half:
        return 1.0
    if q < -flat:
        return (q + half) ** 2 / (2.0 * a * b)
    if q <= flat:
        return 0.5 + q / a
    return 1.0 - (half - q) ** 2 / (2.0 * a * b)


def pixel_kernel(sigma: float, s: int, pad: int) -> np.ndarray:
    """((2 pad + 1) s,) weights of the cells along one axis around a pixel: a box of one pixel, blurred by a Gaussian.

    sigma [px]. The cells' own width adds a variance of 1 / (12 s^2) px^2, which is subtracted from the Gaussian's.
    """
    edges = np.arange((2 * pad + 1) * s + 1) / s - pad - 0.5
    spread = np.sqrt(max(sigma**2 - 1.0 / (12.0 * s * s), 0.0))
    integral = np.array([_ramp(e + 0.5, spread) - _ramp(e - 0.5, spread) for e in edges])
    kernel = np.diff(integral)
    return kernel / kernel.sum()


def _ramp(x: float, sigma: float) -> float:
    """The integral up to x of a step's integral, max(0, x), blurred by a Gaussian of `sigma`."""
    if sigma == 0.0:
        return max(x, 0.0)
    z = x / sigma
    return x * 0.5 * (1.0 + erf(z / np.sqrt(2.0))) + sigma * np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)


@njit(cache=True, nogil=True)
def shrink(fine, kernel, s, out):
    """out (H, W): each pixel the sum of `kernel` along both axes over the cells of `fine` around it."""
    n_rows, n = fine.shape[0], len(kernel)
    narrow = np.empty((n_rows, out.shape[1]))
    for row in range(n_rows):
        for col in range(out.shape[1]):
            total = 0.0
            for k in range(n):
                total += kernel[k] * fine[row, col * s + k]
            narrow[row, col] = total
    for row in range(out.shape[0]):
        out[row] = 0.0
        for k in range(n):
            for col in range(out.shape[1]):
                out[row, col] += kernel[k] * narrow[row * s + k, col]
