"""From the points of LiDAR scans to moments: all that the point-on-plane residuals of a pass depend on.

A residual n . (p + R x) - d is linear in (1, x). So the sum of its squares over the points of one plane in one bin of
time, and all its derivatives by the bin's pose and the plane, follow exactly from ten weighted moments of (1, x).
Points are first moved to the instant of their bin's centre: by the sensor's twist within a step of 1 ms, and from step
to step by its poses. What that leaves is an eighth of the acceleration times the step's length squared at most: 1e-6 m
for 5 m/s^2.

Noise along the beam moves a point across its plane and along it, both at once. So J^T r of noisy points has a mean of
its own, as far from nought as beams are slanted: 0.8 standard deviations of a focal length in a room, where roll and
pitch of the LiDAR hold the images. What is left to minimise is r^2 over the variance of r, which turns with the beam's
incidence; the derivative of that variance takes the mean away. It is linear in R^T n and is kept beside the moments.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from icalib.errors import EstimationError
from icalib.estimation.arrowhead import in_parallel
from icalib.estimation.clocks import instants
from icalib.estimation.corner_weights import weight
from icalib.estimation.lidar_sweep import Motion, sweep
from icalib.estimation.nodes import usable
from icalib.measurements import LidarStream
from icalib.rig import Loss

BIN_S = 3e-3
STEP_S = 1e-3  # of a longer bin
POINTS_AT_A_TIME = 150_000  # by one thread: what a chunk needs beside the cloud stays small
MOMENTS = 10  # of (1, x, y, z), lower triangle row by row
SUMS = MOMENTS + 3  # and the slant
NO_NOISE = 16.0  # a point's chi^2 beyond this comes of a poor state, or of an outlier, and has no part in the slant
LOSSES: dict[Loss, int] = {"none": 0, "huber": 1, "cauchy": 2}
NO_PIVOT = 1e-13  # of a moment: below this a pivot is rounding


@dataclass(frozen=True)
class LidarNoise:
    """Of a point's distance to its plane: sigma [m] whatever the direction, and beam_sigma [m] along the beam, of which
    the cosine of incidence counts. The robust loss, and where it starts to bend, in standard deviations."""

    sigma: float
    beam_sigma: float = 0.0
    loss: Loss = "none"
    loss_scale: float = 2.5


@dataclass(frozen=True)
class Associated:
    """Points of one LiDAR that are known to lie on planes. plane (N,) int32: the row of `planes` (P, 6) that each lies
    on, -1: none."""

    stream: LidarStream
    plane: np.ndarray
    planes: np.ndarray


@dataclass(frozen=True)
class Moments:
    """Bins of one LiDAR, in the order of time, and the planes that each saw: entries start[j]:start[j + 1] of bin j.

    seconds (n,): the bins' instants on the LiDAR's clock, since its first stamp; plane, count (E,): plane and number of
    points of each entry; root (E, 10): lower Cholesky factor L, row by row, of its moments sum w (1, x) (1, x)^T, with
    w the points' robust weights over their variance; slant (E, 4): half the chi^2 changes with the variances, too, by
    slant . (1, R_world_lidar^T n).
    """

    seconds: np.ndarray
    start: np.ndarray
    plane: np.ndarray
    count: np.ndarray
    root: np.ndarray
    slant: np.ndarray


class _Scans(NamedTuple):
    """Points of scans and the steps of time that they fall into: start (S + 1,); first step of each scan, counted from
    its stamp, and its place among all steps (S + 1,), both a multiple of the steps of a bin."""

    start: np.ndarray
    offset_s: np.ndarray
    xyz: np.ndarray
    plane: np.ndarray
    low: np.ndarray
    steps: np.ndarray


class _Cells(NamedTuple):
    """Of each step (n,): its bin, -1 where the LiDAR's motion is not known; where the LiDAR is at its middle, seen from
    the bin's centre (turn, shift). Of each bin (m,): rotation and position of the LiDAR at its centre."""

    bin: np.ndarray
    turn: np.ndarray
    shift: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


class _Weights(NamedTuple):
    """Variances [m^2] of what is alike in all directions, and of what is along the beam; the loss."""

    alike: float
    along: float
    loss: int
    scale: float


@njit(cache=True, nogil=True)
def _step_range(start, offset_s, per_s, each, low, count):
    """First step of each scan, counted from its stamp, and how many there are: whole bins of `each` steps."""
    for i in range(len(start) - 1):
        least, most = np.inf, -np.inf
        for n in range(start[i], start[i + 1]):
            least, most = min(least, offset_s[n]), max(most, offset_s[n])
        empty = start[i + 1] == start[i]
        low[i] = 0 if empty else each * (int(np.floor(np.float64(least) * per_s)) // each)
        count[i] = 0 if empty else each * ((int(np.floor(np.float64(most) * per_s)) - low[i]) // each + 1)


@njit(cache=True, nogil=True)
def _to_centres(motion, each, ok, cells):
    """Fills `cells` for bins of `each` steps."""
    for c in range(len(ok) // each):
        m = c * each + each // 2
        R, p = motion.rotation[m], motion.position[m]
        cells.rotation[c], cells.position[c] = R, p
        for b in range(c * each, (c + 1) * each):
            cells.bin[b] = c if ok[b] and ok[m] else -1
            for i in range(3):
                cells.shift[b, i] = 0.0
                for j in range(3):
                    cells.shift[b, i] += R[j, i] * (motion.position[b, j] - p[j])
                    cells.turn[b, i, j] = 0.0
                    for k in range(3):
                        cells.turn[b, i, j] += R[k, i] * motion.rotation[b, k, j]


@njit(cache=True, nogil=True)
def _see_plane(R, p, plane, seen):
    """seen (4,): (n . p - d, R^T n), so that seen . (1, x) is the distance of a point x in the LiDAR's frame."""
    seen[0] = 0.0
    for a in range(3):
        seen[0] += plane[a] * (p[a] - plane[3 + a])
        seen[1 + a] = R[0, a] * plane[0] + R[1, a] * plane[1] + R[2, a] * plane[2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _add_point(x, y, z, s, seen, weights, sums):
    """Adds one weighted point to the sums in row s. All in one stretch: where noise is alike in all directions, asking
    for it costs more than the division by the same variance."""
    across = seen[s, 1] * x + seen[s, 2] * y + seen[s, 3] * z
    off, square = seen[s, 0] + across, x * x + y * y + z * z
    over = 1.0 / (weights.alike * square + weights.along * across * across)
    w, robust = square * over, 1.0
    chi2 = off * off * w
    if weights.loss:
        robust = weight(weights.loss, weights.scale, chi2)[0]
        w *= robust
    turns = robust * chi2 * weights.along * across * over if chi2 < NO_NOISE else 0.0
    sums[s, 10] -= turns * x
    sums[s, 11] -= turns * y
    sums[s, 12] -= turns * z
    wx, wy, wz = w * x, w * y, w * z
    sums[s, 0] += w
    sums[s, 1] += wx
    sums[s, 2] += wx * x
    sums[s, 3] += wy
    sums[s, 4] += wy * x
    sums[s, 5] += wy * y
    sums[s, 6] += wz
    sums[s, 7] += wz * x
    sums[s, 8] += wz * y
    sums[s, 9] += wz * z


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _bin_scan(i, scans, motion, cells, planes, weights, per_s, each, slot, seen, sums, count, where):
    """Moments of scan i in the order in which its bins and planes were met; returns how many. where (m, 2): which."""
    used, low, first, step_s = 0, scans.low[i], scans.steps[i], 1.0 / per_s
    begin = first // each
    slot[: scans.steps[i + 1] // each - begin] = -1
    # Unsigned indices spare the test of each whether it counts from the end.
    for n in range(np.uint64(scans.start[i]), np.uint64(scans.start[i + 1])):
        q = scans.plane[n]
        if q < 0:
            continue
        offset = np.float64(scans.offset_s[n])
        k = int(np.floor(offset * per_s))
        b = np.uint64(first + k - low)
        c = cells.bin[b]
        if c < 0:
            continue
        s = slot[np.uint64(c - begin), np.uint64(q)]
        if s < 0:
            s = slot[c - begin, q] = used
            used += 1
            _see_plane(cells.rotation[c], cells.position[c], planes[q], seen[s])
            sums[s] = 0.0
            count[s] = 0
            where[s, 0], where[s, 1] = c, q
        dt = offset - (k + 0.5) * step_s
        h = 0.5 * dt
        x, y, z = np.float64(scans.xyz[n, 0]), np.float64(scans.xyz[n, 1]), np.float64(scans.xyz[n, 2])
        w0, w1, w2 = motion.rate[b, 0], motion.rate[b, 1], motion.rate[b, 2]
        mx, my, mz = x + h * (w1 * z - w2 * y), y + h * (w2 * x - w0 * z), z + h * (w0 * y - w1 * x)
        x += dt * (motion.velocity[b, 0] + w1 * mz - w2 * my)
        y += dt * (motion.velocity[b, 1] + w2 * mx - w0 * mz)
        z += dt * (motion.velocity[b, 2] + w0 * my - w1 * mx)
        R, t = cells.turn[b], cells.shift[b]
        mx = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
        my = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
        mz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        _add_point(mx, my, mz, np.uint64(s), seen, weights, sums)
        count[np.uint64(s)] += 1
    return used


@njit(cache=True, nogil=True)
def _root_in_place(M):
    """Moments (10,) -> their lower Cholesky factor; where a pivot is nothing but rounding, its column is 0."""
    for j in range(4):
        d = M[j * (j + 1) // 2 + j]
        least = NO_PIVOT * d
        for k in range(j):
            d -= M[j * (j + 1) // 2 + k] ** 2
        f = 1.0 / np.sqrt(d) if d > least else 0.0
        M[j * (j + 1) // 2 + j] = d * f
        for i in range(j + 1, 4):
            s = M[i * (i + 1) // 2 + j]
            for k in range(j):
                s -= M[i * (i + 1) // 2 + k] * M[j * (j + 1) // 2 + k]
            M[i * (i + 1) // 2 + j] = s * f


@njit(cache=True, nogil=True)
def _bin_scans(scans, motion, cells, planes, weights, per_s, entries):
    """All scans one after the other: entries' bin, plane, count, root and slant; returns how many."""
    bins, plane, count, root, slant = entries
    longest, total, each = 0, 0, max(len(cells.bin) // max(len(cells.position), 1), 1)
    for i in range(len(scans.start) - 1):
        longest = max(longest, (scans.steps[i + 1] - scans.steps[i]) // each)
    n = longest * len(planes)
    slot, seen = np.empty((longest, len(planes)), np.int32), np.empty((n, 4))
    sums, number, where = np.empty((n, SUMS)), np.empty(n, np.int64), np.empty((n, 2), np.int64)
    for i in range(len(scans.start) - 1):
        used = _bin_scan(i, scans, motion, cells, planes, weights, per_s, each, slot, seen, sums, number, where)
        for s in range(used):
            bins[total], plane[total], count[total] = where[s, 0], where[s, 1], number[s]
            root[total] = sums[s, :MOMENTS]
            _root_in_place(root[total])
            slant[total, 0] = 0.0
            for a in range(3):
                slant[total, 1 + a] = sums[s, MOMENTS + a]
                slant[total, 0] -= sums[s, MOMENTS + a] * seen[s, 1 + a]
            total += 1
    return total


def take_moments(cloud: Associated, drive: Motion, noise: LidarNoise, bin_s: float = BIN_S) -> Moments:
    """Moments of all points that lie on a plane, everything as `drive` has it; weights are those of its residuals.

    Points at instants without IMU are left out. Scans are taken one after the other, on two threads; what is needed
    beside the cloud is small. Raises EstimationError where no point is left.
    """
    groups = _groups(cloud.stream)
    seconds, bins, *entries = zip(
        *in_parallel(lambda g: _moments_of(cloud, drive, noise, bin_s, g), groups), strict=True
    )
    at, (plane, count, root, slant) = np.concatenate(seconds), (np.concatenate(e) for e in entries)
    if not len(root):
        raise EstimationError(
            f"{cloud.stream.name}: no point lies on a plane while {drive.imu.name} was running; check that the clocks "
            "overlap, or the time_offset in the rig file."
        )
    before = np.cumsum([0, *(len(s) for s in seconds[:-1])])
    bin_of = np.concatenate(bins) + np.repeat(before, [len(b) for b in bins])
    order = np.lexsort((plane, bin_of, at[bin_of]))  # by time first: scans may overlap
    bin_of = bin_of[order]
    fresh = np.flatnonzero(np.diff(bin_of, prepend=-1))
    start = np.append(fresh, len(bin_of))
    return Moments(at[bin_of[fresh]], start, plane[order], count[order], root[order], slant[order])


def _groups(stream: LidarStream) -> Iterator[slice]:
    """Scans of about the same number of points together."""
    ends = np.searchsorted(stream.start, np.arange(0, stream.start[-1], POINTS_AT_A_TIME))
    edges = np.unique(np.append(ends, len(stream.stamps_ns)))
    return (slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True))


def _laid_out(
    stream: LidarStream, plane: np.ndarray, step_s: float, each: int, own: slice
) -> tuple[_Scans, np.ndarray, slice]:
    """Some of the scans with their steps, `each` so many a bin; the middles of steps in seconds on the LiDAR's clock;
    which points they are."""
    start = stream.start[own.start : own.stop + 1]
    points = slice(int(start[0]), int(start[-1]))
    start, offset_s = start - start[0], stream.offset_s[points]
    low, width = np.empty(len(start) - 1, np.int64), np.empty(len(start) - 1, np.int64)
    _step_range(start, offset_s, 1.0 / step_s, each, low, width)
    steps = np.concatenate([[0], np.cumsum(width)])
    within = np.arange(steps[-1]) - np.repeat(steps[:-1] - low, width)
    seconds = np.repeat(stream.seconds[own], width) + (within + 0.5) * step_s
    return _Scans(start, offset_s, stream.xyz[points], plane[points], low, steps), seconds, points


def _moments_of(
    cloud: Associated, drive: Motion, noise: LidarNoise, bin_s: float, own: slice
) -> tuple[np.ndarray, ...]:
    """Of some of the scans: seconds of the bins, and of each entry bin, plane, count, root and slant."""
    each = steps_of(bin_s)
    scans, seconds, _ = _laid_out(cloud.stream, cloud.plane, bin_s / each, each, own)
    times = instants(cloud.stream, drive.state.values, seconds)
    # All steps of a bin hang on one node: between two nodes a state that has not settled yet may jump.
    motion, n = sweep(drive, cloud.stream.name, times, np.repeat(times[each // 2 :: each], each)), len(times)
    cells = _Cells(
        np.empty(n, np.int64), np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n // each, 3, 3)),
        np.empty((n // each, 3)),
    )  # fmt: skip
    _to_centres(motion, each, usable(drive.imu, times, drive.max_gap_s), cells)
    weights = _Weights(noise.sigma**2, noise.beam_sigma**2, LOSSES[noise.loss], noise.loss_scale)
    most = min(len(scans.xyz), len(cells.position) * len(cloud.planes))
    entries = (
        np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64), np.empty((most, MOMENTS)),
        np.empty((most, 4)),
    )  # fmt: skip
    k = _bin_scans(scans, motion, cells, cloud.planes, weights, each / bin_s, entries)
    return seconds[each // 2 :: each], *(e[:k].copy() for e in entries)


def steps_of(bin_s: float) -> int:
    """Steps of a bin, an odd number: the middle of one is the bin's centre."""
    return max(2 * (int(bin_s / STEP_S + 0.5) // 2) + 1, 1) if bin_s > STEP_S else 1


@njit(cache=True, nogil=True)
def _move_to_world(scans, motion, step_s, points, seen_from):
    """World coordinates of all points, and where the LiDAR was when it saw them."""
    for i in range(len(scans.start) - 1):
        for n in range(scans.start[i], scans.start[i + 1]):
            offset = np.float64(scans.offset_s[n])
            k = int(np.floor(offset * (1.0 / step_s)))
            b, dt = scans.steps[i] + k - scans.low[i], offset - (k + 0.5) * step_s
            x, v, w = scans.xyz[n], motion.velocity[b], motion.rate[b]
            for a in range(3):
                points[n, a] = seen_from[n, a] = motion.position[b, a]
            for c in range(3):
                d, e = (c + 1) % 3, (c + 2) % 3
                turned = x[c] + dt * (w[d] * x[e] - w[e] * x[d])
                for a in range(3):
                    points[n, a] += motion.rotation[b, a, c] * (turned + dt * v[c])
                    seen_from[n, a] += motion.rotation[b, a, c] * dt * v[c]


def in_world(drive: Motion, stream: LidarStream) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a LiDAR in the world frame, float32, and where it was at their instants (N, 3), as `drive` has
    it. Within a step it moves with its twist; at instants without IMU as its nearest reading says."""
    points, seen_from = np.empty((len(stream.xyz), 3), np.float32), np.empty((len(stream.xyz), 3), np.float32)

    def move(own: slice) -> None:
        scans, seconds, ends = _laid_out(stream, stream.plane, STEP_S, 1, own)
        motion = sweep(drive, stream.name, instants(stream, drive.state.values, seconds))
        _move_to_world(scans, motion, STEP_S, points[ends], seen_from[ends])

    in_parallel(move, _groups(stream))
    return points, seen_from
