"""Compiled rendering of a flat black and white pattern with anti-aliasing by area, and its blur.

A pixel with a footprint on the sheet inside one cell of the pattern has that cell's grey. Every other pixel is divided
into s x s cells. The ray of each cell is a second-order expansion of the rays around the pixel. To first order, the
coordinate on the sheet over a cell is distributed like the sum of two uniform variables. The share of a cell between
two edges of the pattern is thus a difference of two integrals of a trapezoid. It is exact wherever the edge lies, and
not sampled.
"""

from __future__ import annotations

from math import erf

import numpy as np

from icalib.base.compiled import njit

_SLACK = 1.3  # factor on a pixel's linear footprint, which allows for the curvature of the lens


@njit(cache=True, nogil=True, error_model="numpy")
def paint(rays, by_u, by_v, bends, s, R, C, x_edges, y_edges, grey_of, fine):
    """Paints the sheet over the greys in `fine` (H s, W s), with s x s cells per pixel.

    rays (H, W, 3): through the centres of the pixels, NaN for none; by_u, by_v (H, W, 3): their derivatives per pixel;
    bends (3, H, W, 3): second derivatives by uu, uv and vv. R (3, 3): R_sheet_cam; C (3,): position of the camera in
    the sheet's frame [m]; x_edges (nx + 1,), y_edges (ny + 1,): edges of the pattern [m]; grey_of (ny, nx): its greys.
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
    """Paints discs (n, 3), centre x, y and radius [m] on the sheet, over the greys in `fine`; other arguments as in
    `paint`.

    Within a cell, a quarter of a pixel, the edge of a disc is approximated by a line.
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
    """The ray du, dv pixels beside the ray d, by a second-order expansion. d_u, d_v, bend: derivatives, see `paint`."""
    uu, uv, vv = 0.5 * du * du, du * dv, 0.5 * dv * dv
    x = d[0] + du * d_u[0] + dv * d_v[0] + uu * bend[0, 0] + uv * bend[1, 0] + vv * bend[2, 0]
    y = d[1] + du * d_u[1] + dv * d_v[1] + uu * bend[0, 1] + uv * bend[1, 1] + vv * bend[2, 1]
    z = d[2] + du * d_u[2] + dv * d_v[2] + uu * bend[0, 2] + uv * bend[1, 2] + vv * bend[2, 2]
    return x, y, z


@njit(cache=True, nogil=True, error_model="numpy")
def _on_sheet(d, d_u, d_v, R, C):
    """Point x, y at which a ray meets the sheet [m], its derivatives by u and v, and whether the ray meets the sheet
    (from either side)."""
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
    """Index of the last of the ascending edges that is not above `value`; -1 if all are above."""
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
    """Integral of the sheet's grey over a cell with the central ray (x, y, z), and the share of the cell that the sheet
    covers.

    X and Y are averaged separately, which is exact unless edges of both directions cross the cell.
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

    sigma: of the Gaussian [px]; s: cells per pixel; pad: pixels on each side. The width of the cells adds a variance of
    1 / (12 s^2) px^2, which is subtracted from that of the Gaussian.
    """
    edges = np.arange((2 * pad + 1) * s + 1) / s - pad - 0.5
    spread = np.sqrt(max(sigma**2 - 1.0 / (12.0 * s * s), 0.0))
    integral = np.array([_ramp(e + 0.5, spread) - _ramp(e - 0.5, spread) for e in edges])
    kernel = np.diff(integral)
    return kernel / kernel.sum()


def _ramp(x: float, sigma: float) -> float:
    """The ramp function max(0, x), blurred by a Gaussian of standard deviation `sigma`."""
    if sigma == 0.0:
        return max(x, 0.0)
    z = x / sigma
    return x * 0.5 * (1.0 + erf(z / np.sqrt(2.0))) + sigma * np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)


@njit(cache=True, nogil=True)
def shrink(fine, kernel, s, out):
    """Fills out (H, W) with the convolution of `fine` by `kernel` along both axes, sampled at the pixels."""
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
