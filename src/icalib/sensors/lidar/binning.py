"""Sums the points of LiDAR scans to moments, from which the point-to-plane residuals of a pass follow.

A residual n . (p + R x) - d is linear in (1, x). For the points of one plane in one time bin, the sum of squares
follows exactly from ten weighted moments of (1, x). So do its derivatives by the pose of the bin and by the plane.
Points are first moved to the centre of their bin: within a step of 1 ms by the twist of the LiDAR, from step to step by
its poses. The remaining error is at most an eighth of the acceleration times the square of the step: 1e-6 m at 5 m/s^2.

Range noise moves a point both across its plane and along it. J^T r of noisy points therefore has a nonzero mean, which
grows with the incidence of the beams. This bias reaches 0.8 standard deviations of a focal length in a room where roll
and pitch of the LiDAR constrain the images. The minimised term is r^2 over the variance of r, which depends on the
incidence (n . R x)^2 / |x|^2. The derivative of this variance removes the bias. It is linear in R^T n and is stored
with the moments as the incidence term.

Compiled sums over the points of LiDAR scans: see `binning`.

The points of a scan are sorted by time step and plane first. Points of one step and plane share pose, twist and plane,
so the inner loop works on their coordinates alone and is vectorised.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import LidarStream
from icalib.errors import EstimationError
from icalib.motion.poses import EstimatedMotion, instants, sweep, usable
from icalib.optim.arrowhead import in_parallel
from icalib.optim.rows import LOSSES, weight
from icalib.rig import Loss
from icalib.sensors.lidar.spec import N_RINGS, OF_RINGS

BIN_S = 3e-3  # duration of a bin; its points share the pose perturbation of its centre
COARSE_BIN_S = 11e-3  # duration of a bin in early passes: fewer bins while the state is still inaccurate
BIN_STEP_S = 1e-3  # duration of a step within a bin; a constant twist errs by 1e-6 m at 5 m/s^2
MAX_OUTLINE_POINTS = 500_000  # points of a LiDAR from which the extent of planes is found; bounds the memory
POINTS_PER_CHUNK = 150_000  # points of a thread at a time; their entries need 20 MB at most


@dataclass(frozen=True)
class LidarNoise:
    """Noise of a point's distance from its plane. sigma [m]: isotropic part. beam_sigma [m]: range noise along the
    beam, projected on the normal. loss: robust loss; loss_scale: its scale in standard deviations. edge_scale: noise of
    the middle of a ring on a sheet over that of rounding to beams. inflation: factor on the noise of points on a sheet,
    whose errors correlate. flatness [m]: deviation from planes of surfaces at rest that LiDARs share."""

    sigma: float
    beam_sigma: float = 0.0
    loss: Loss = "none"
    loss_scale: float = 2.5
    edge_scale: float = 3.0  # before residuals are known: beams are as wide as their steps, and the pose is rough
    inflation: float = 1.0
    flatness: float = 0.02  # walls and roads within a metre or two

    @property
    def along(self) -> float:
        """Standard deviation of a point along its beam [m]."""
        return float(np.hypot(self.sigma, self.beam_sigma))


NO_RINGS = np.zeros(0, np.uint8)


@dataclass(frozen=True)
class AssociatedPoints:
    """Points of one LiDAR and their planes. plane (N,) int32: row of `planes` for each point, -1: none. planes (P, 6):
    normal, and a point [m], in the world frame. ring (N,) uint8: ring of each point, of K, if errors of rings matter.
    """

    stream: LidarStream
    plane: np.ndarray
    planes: np.ndarray
    ring: np.ndarray = field(default_factory=lambda: NO_RINGS)


@dataclass(frozen=True)
class Moments:
    """Moments of n time bins of one LiDAR, ordered by time. An entry is one plane in one bin; bin j has the entries
    start[j]:start[j + 1].

    seconds (n,): centres of the bins on the LiDAR's clock, since its first stamp; plane, count (E,): plane and number
    of points of each entry. root (E, 10): lower Cholesky factor L, row by row, of the moments sum w (1, x) (1, x)^T; w
    is the robust weight of a point over its variance. incidence (E, 4): incidence term, the change of half the chi^2
    with the variances, incidence . (1, R_world_lidar^T n). rings (E, 3 K, 8) float32, K = 0 without rings: for points
    of each ring that move by s_e off the plane per rad of elevation, by s_o per m of offset and by s_a per rad of
    azimuth, L^-1 sum w s (1, x), the change of half the chi^2 with the variances, and sum w s s_e, w s s_o and w s s_a:
    s is s_e first, then s_o, then s_a.
    """

    seconds: np.ndarray
    start: np.ndarray
    plane: np.ndarray
    count: np.ndarray
    root: np.ndarray
    incidence: np.ndarray
    rings: np.ndarray


def take_moments(cloud: AssociatedPoints, motion: EstimatedMotion, noise: LidarNoise, bin_s: float = BIN_S) -> Moments:
    """Moments of all points that lie on a plane, with poses, planes and residuals at the state of `motion`.

    Points in IMU gaps that are not bridged are left out. Groups of scans are summed one after another on two threads,
    which bounds the memory. Raises EstimationError if no point is left.
    """
    groups = _scan_groups(cloud.stream)
    seconds, bins, *entries = zip(
        *in_parallel(lambda group: _moments_of(cloud, motion, noise, bin_s, group), groups), strict=True
    )
    at, (plane, count, root, incidence, rings) = np.concatenate(seconds), (np.concatenate(e) for e in entries)
    if not len(root):
        raise EstimationError(
            f"{cloud.stream.name}: no point lies on a plane while {motion.imu.name} was running; check that the clocks "
            "overlap, or the time_offset in the rig file."
        )
    before = np.cumsum([0, *(len(s) for s in seconds[:-1])])
    bin_of = np.concatenate(bins) + np.repeat(before, [len(b) for b in bins])
    order = np.lexsort((plane, bin_of, at[bin_of]))  # by time first: scans may overlap
    bin_of = bin_of[order]
    first = np.flatnonzero(np.diff(bin_of, prepend=-1))
    start = np.append(first, len(bin_of))
    return Moments(at[bin_of[first]], start, *(e[order] for e in (plane, count, root, incidence, rings)))


def _scan_groups(stream: LidarStream) -> Iterator[slice]:
    """Groups of consecutive scans that have about POINTS_PER_CHUNK points together."""
    ends = np.searchsorted(stream.start, np.arange(0, stream.start[-1], POINTS_PER_CHUNK))
    edges = np.unique(np.append(ends, len(stream.stamps_ns)))
    return (slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True))


def _scans_with_steps(
    stream: LidarStream, plane: np.ndarray, step_s: float, per_bin: int, group: slice, ring: np.ndarray = NO_RINGS
) -> tuple[Scans, np.ndarray, slice]:
    """A group of scans divided into steps of step_s, per_bin of which make a bin; the middles of the steps (n,) on the
    LiDAR's clock [s]; and the slice of the points. plane (N,), ring (N,): of each point of the stream."""
    start = stream.start[group.start : group.stop + 1]
    points = slice(int(start[0]), int(start[-1]))
    start, offset_s = start - start[0], stream.offset_s[points]
    first, count = np.empty(len(start) - 1, np.int64), np.empty(len(start) - 1, np.int64)
    step_range(start, offset_s, 1.0 / step_s, per_bin, first, count)
    step_start = np.concatenate([[0], np.cumsum(count)])
    number = np.arange(step_start[-1]) - np.repeat(step_start[:-1] - first, count)
    seconds = np.repeat(stream.seconds[group], count) + (number + 0.5) * step_s
    scans = Scans(start, offset_s, stream.xyz[points], plane[points], ring[points], first, step_start)
    return scans, seconds, points


def _moments_of(
    cloud: AssociatedPoints, motion: EstimatedMotion, noise: LidarNoise, bin_s: float, group: slice
) -> tuple[np.ndarray, ...]:
    """Centres [s] of the bins of a group of scans; and bin, plane, count, root, incidence and rings of each entry."""
    per_bin = steps_of(bin_s)
    scans, seconds, _ = _scans_with_steps(cloud.stream, cloud.plane, bin_s / per_bin, per_bin, group, cloud.ring)
    times = instants(cloud.stream, motion.state.values, seconds)
    # All steps of a bin are propagated from one keyframe: trajectories of two keyframes may differ before convergence.
    lidar = sweep(motion, cloud.stream.name, times, np.repeat(times[per_bin // 2 :: per_bin], per_bin))
    poses = _bin_poses(len(times), len(times) // per_bin)
    fill_bin_poses(lidar, per_bin, usable(motion.imu, times, motion.max_gap_s), poses)
    weights = RangeWeights(noise.sigma**2, noise.beam_sigma**2, LOSSES[noise.loss], noise.loss_scale)
    size, n_errors = min(len(scans.xyz), len(poses.p_world_bin) * len(cloud.planes)), N_ERRORS * (len(cloud.ring) > 0)
    entries = (*_empty_entries(size), np.empty((size, n_errors, RING_SUMS), np.float32))
    k = bin_scans(scans, lidar, poses, per_bin, cloud.planes, weights, per_bin / bin_s, entries)
    return seconds[per_bin // 2 :: per_bin], *(e[:k].copy() for e in entries)


def _bin_poses(steps: int, bins: int) -> BinPoses:
    """Uninitialised arrays for the poses of steps and bins."""
    known, R_bin_step, p_bin_step = np.empty(steps, np.bool_), np.empty((steps, 3, 3)), np.empty((steps, 3))
    return BinPoses(known, R_bin_step, p_bin_step, np.empty((bins, 3, 3)), np.empty((bins, 3)))


def _empty_entries(n: int) -> tuple[np.ndarray, ...]:
    """Uninitialised arrays for n entries: bin, plane, count, root, incidence."""
    numbers = (np.empty(n, np.int64) for _ in range(3))
    return *numbers, np.empty((n, N_MOMENTS)), np.empty((n, 4))


def steps_of(bin_s: float) -> int:
    """Number of steps of a bin of bin_s seconds. It is odd, so that the middle of a step is the centre of the bin."""
    return max(2 * (int(bin_s / BIN_STEP_S + 0.5) // 2) + 1, 1) if bin_s > BIN_STEP_S else 1


def each_in_world(
    motion: EstimatedMotion, stream: LidarStream, use: Callable[[slice, np.ndarray, np.ndarray], None]
) -> None:
    """Calls `use` for each group of consecutive points, on two threads: with their slice of the stream, the points
    (n, 3) in the world frame, and positions (n, 3) of the LiDAR at their instants, float32 [m].

    Within a step the LiDAR moves with its twist. In gaps of the IMU its motion follows the nearest reading.
    """

    def move(group: slice) -> None:
        scans, seconds, range_of_points = _scans_with_steps(stream, stream.plane, BIN_STEP_S, 1, group)
        lidar = sweep(motion, stream.name, instants(stream, motion.state.values, seconds))
        points, origins = np.empty_like(scans.xyz), np.empty_like(scans.xyz)
        move_to_world(scans, lidar, BIN_STEP_S, points, origins)
        use(range_of_points, points, origins)

    in_parallel(move, _scan_groups(stream))


def in_world(motion: EstimatedMotion, stream: LidarStream) -> tuple[np.ndarray, np.ndarray]:
    """All points (N, 3) of a LiDAR in the world frame, and positions (N, 3) of the LiDAR, as in `each_in_world`."""
    points, origins = np.empty((len(stream.xyz), 3), np.float32), np.empty((len(stream.xyz), 3), np.float32)

    def keep(group: slice, moved: np.ndarray, seen_from: np.ndarray) -> None:
        points[group], origins[group] = moved, seen_from

    each_in_world(motion, stream, keep)
    return points, origins


def points_on_planes(motion: EstimatedMotion, stream: LidarStream, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) on planes in the world frame [m], about MAX_OUTLINE_POINTS at most, and the plane of each (n,).
    plane (N,): plane of each point of the stream, -1: none."""
    some = (plane >= 0) & (np.arange(len(plane)) % (len(plane) // MAX_OUTLINE_POINTS | 1) == 0)
    return in_world(motion, stream.some(some))[0], plane[some]


N_MOMENTS = 10  # products of (1, x, y, z), lower triangle row by row
N_SUMS = N_MOMENTS + 3  # the moments, then the gradient of the incidence term
N_ERRORS = len(OF_RINGS) * N_RINGS  # errors of rings, 3 K
LEAST_LEVEL_M = 1e-6  # from the LiDAR's z axis: a point on it has no azimuth
RING_SUMS = 5 + len(OF_RINGS)  # numbers of each of them in an entry, see `Moments.rings`
MAX_INCIDENCE_CHI2 = 16.0  # 4 sigma; larger values do not enter the incidence term: outliers, or an inaccurate state
MIN_PIVOT = 1e-13  # relative to the diagonal moment; a smaller pivot is a rounding error of float64


class Scans(NamedTuple):
    """S scans of N points, and the time steps into which the points fall.

    start (S + 1,): points of scan i are start[i]:start[i + 1]; offset_s (N,): time since the stamp of the scan; xyz
    (N, 3) [m]; plane (N,): plane of each point, -1: none; ring (N,): its ring; empty where these do not matter.
    first_step (S,): number of the first step of a scan, counted from its stamp. step_start (S + 1,): position of this
    step among all steps. Both are multiples of the steps per bin.
    """

    start: np.ndarray
    offset_s: np.ndarray
    xyz: np.ndarray
    plane: np.ndarray
    ring: np.ndarray
    first_step: np.ndarray
    step_start: np.ndarray


class BinPoses(NamedTuple):
    """Poses of the LiDAR at n steps and m bins. known (n,) bool: IMU readings cover the step and its bin. R_bin_step
    (n, 3, 3), p_bin_step (n, 3) [m]: pose at the middle of each step, in the frame of the LiDAR at the centre of its
    bin. R_world_bin (m, 3, 3), p_world_bin (m, 3) [m]: pose at the centre of each bin."""

    known: np.ndarray
    R_bin_step: np.ndarray
    p_bin_step: np.ndarray
    R_world_bin: np.ndarray
    p_world_bin: np.ndarray


class RangeWeights(NamedTuple):
    """Noise and robust loss of points. variance [m^2]: isotropic part of the variance of the distance from a plane;
    beam_variance [m^2]: variance along the beam; loss: number of the robust loss; scale: in standard deviations."""

    variance: float
    beam_variance: float
    loss: int
    scale: float


@njit(cache=True, nogil=True)
def step_range(start, offset_s, per_s, per_bin, first, count):
    """Fills first (S,), the first step of each scan counted from its stamp, and count (S,), its number of steps. Scans
    have whole bins of per_bin steps; per_s: steps per second. A scan without points has no step."""
    for i in range(len(start) - 1):
        least, most = np.inf, -np.inf
        for n in range(start[i], start[i + 1]):
            least, most = min(least, offset_s[n]), max(most, offset_s[n])
        empty = start[i + 1] == start[i]
        first[i] = 0 if empty else per_bin * (int(np.floor(np.float64(least) * per_s)) // per_bin)
        count[i] = 0 if empty else per_bin * ((int(np.floor(np.float64(most) * per_s)) - first[i]) // per_bin + 1)


@njit(cache=True, nogil=True)
def fill_bin_poses(motion, per_bin, ok, poses):
    """Fills `poses` for bins of per_bin steps. motion: `Sweep` at the middles of the n steps; ok (n,) bool: IMU
    readings cover the step."""
    for c in range(len(ok) // per_bin):
        m = c * per_bin + per_bin // 2
        R, p = motion.rotation[m], motion.position[m]
        for i in range(3):
            poses.p_world_bin[c, i] = p[i]
            for j in range(3):
                poses.R_world_bin[c, i, j] = R[i, j]
        for b in range(c * per_bin, (c + 1) * per_bin):
            poses.known[b] = ok[b] and ok[m]
            for i in range(3):
                poses.p_bin_step[b, i] = 0.0
                for j in range(3):
                    poses.p_bin_step[b, i] += R[j, i] * (motion.position[b, j] - p[j])
                    poses.R_bin_step[b, i, j] = 0.0
                    for k in range(3):
                        poses.R_bin_step[b, i, j] += R[k, i] * motion.rotation[b, k, j]


@njit(cache=True, nogil=True, inline="always")
def _fill_distance_at(R, p, plane, m):
    """Fills m (4,) = (n . p - d, R^T n), such that m . (1, x) is the distance [m] of point x, in the LiDAR's frame,
    from the plane (6,): normal n, point."""
    m[0] = 0.0
    for a in range(3):
        m[0] += plane[a] * (p[a] - plane[3 + a])
        m[1 + a] = R[0, a] * plane[0] + R[1, a] * plane[1] + R[2, a] * plane[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _sort_scan(i, scans, per_s, n_planes, ends, points):
    """Sorts the points of scan i by step and plane (counting sort).

    Fills points (4 or 5, n): x, y, z [m], time since the middle of the step [s], and the ring, if any; and ends: the
    group of a step and plane ends before ends[step * n_planes + plane], where the next group begins.
    """
    first_step, step_s = scans.first_step[i], 1.0 / per_s
    # Unsigned indices spare the test whether an index counts from the end.
    first, last = np.uint64(scans.start[i]), np.uint64(scans.start[i + 1])
    ends[:] = 0
    for n in range(first, last):
        if scans.plane[n] >= 0:
            k = int(np.floor(np.float64(scans.offset_s[n]) * per_s)) - first_step
            ends[np.uint64(k * n_planes + scans.plane[n])] += 1
    before = 0
    for key in range(len(ends)):
        ends[key], before = before, before + ends[key]
    for n in range(first, last):
        if scans.plane[n] >= 0:
            offset = np.float64(scans.offset_s[n])
            k = int(np.floor(offset * per_s))
            key = np.uint64((k - first_step) * n_planes + scans.plane[n])
            to = np.uint64(ends[key])
            points[0, to], points[1, to], points[2, to] = scans.xyz[n, 0], scans.xyz[n, 1], scans.xyz[n, 2]
            points[3, to] = offset - (k + 0.5) * step_s
            if len(scans.ring):
                points[4, to] = scans.ring[n]
            ends[key] += 1


@njit(cache=True, nogil=True, inline="always")
def _moved_by_twist(x, y, z, dt, rate, velocity):
    """Point (x, y, z), measured dt seconds after the middle of its step, in the LiDAR's frame at that middle. The twist
    is integrated to second order; rate [rad/s], velocity [m/s] of the LiDAR in LiDAR axes."""
    (w0, w1, w2), (v0, v1, v2), h = rate, velocity, 0.5 * dt
    mx, my, mz = x + h * (w1 * z - w2 * y), y + h * (w2 * x - w0 * z), z + h * (w0 * y - w1 * x)
    return (
        x + dt * (v0 + w1 * mz - w2 * my),
        y + dt * (v1 + w2 * mx - w0 * mz),
        z + dt * (v2 + w0 * my - w1 * mx),
    )


@njit(cache=True, nogil=True, inline="always")
def _weighed(x, y, z, m, weights):
    """Weight of point (x, y, z) with the distance m (4,) from a plane; and its g, such that half its chi^2 changes with
    its variance by -g (x, y, z) times the change of m[1:]."""
    across = m[1] * x + m[2] * y + m[3] * z
    distance, square = m[0] + across, x * x + y * y + z * z
    over = 1.0 / (weights.variance * square + weights.beam_variance * across * across)
    w = square * over
    chi2 = distance * distance * w
    robust = weight(weights.loss, weights.scale, chi2)[0]
    return w * robust, robust * chi2 * weights.beam_variance * across * over if chi2 < MAX_INCIDENCE_CHI2 else 0.0


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _add_points(points, begin, end, R, p, rate, velocity, m, weights, sums):
    """Adds the weighted points begin:end, of one time step of a scan and one plane, to sums (13,), see N_SUMS.

    R, p: pose of the LiDAR in the middle of the step, relative to that in the middle of its bin; rate, velocity: its
    twist; m (4,): distance from the plane, see
    `_fill_distance_at`. The loop holds scalars only, so that the compiler vectorises it.
    """
    xs, ys, zs, dts = points[0, begin:end], points[1, begin:end], points[2, begin:end], points[3, begin:end]
    rate, velocity = (rate[0], rate[1], rate[2]), (velocity[0], velocity[1], velocity[2])
    R00, R01, R02, p0 = R[0, 0], R[0, 1], R[0, 2], p[0]
    R10, R11, R12, p1 = R[1, 0], R[1, 1], R[1, 2], p[1]
    R20, R21, R22, p2 = R[2, 0], R[2, 1], R[2, 2], p[2]
    m0, n0, n1, n2 = m[0], m[1], m[2], m[3]
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = g0 = g1 = g2 = 0.0
    for n in range(len(xs)):
        x, y, z, dt = np.float64(xs[n]), np.float64(ys[n]), np.float64(zs[n]), np.float64(dts[n])
        a, b, c = _moved_by_twist(x, y, z, dt, rate, velocity)
        x, y = R00 * a + R01 * b + R02 * c + p0, R10 * a + R11 * b + R12 * c + p1
        z = R20 * a + R21 * b + R22 * c + p2
        w, g = _weighed(x, y, z, (m0, n0, n1, n2), weights)
        g0, g1, g2 = g0 - g * x, g1 - g * y, g2 - g * z
        wx, wy, wz = w * x, w * y, w * z
        s0, s1, s2, s3, s4 = s0 + w, s1 + wx, s2 + wx * x, s3 + wy, s4 + wy * x
        s5, s6, s7, s8, s9 = s5 + wy * y, s6 + wz, s7 + wz * x, s8 + wz * y, s9 + wz * z
    added = (s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, g0, g1, g2)
    for k in range(N_SUMS):
        sums[k] += added[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_rings(points, begin, end, R, p, rate, velocity, m, weights, rings):
    """Adds the points of `_add_points` to rings (3 K, 8), see `Moments`, not yet times L^-1. A higher beam moves its
    point by |x| per rad, across the beam, an offset along it, and an azimuth about the LiDAR's z axis. Turns within the
    step are neglected there."""
    rate, velocity = (rate[0], rate[1], rate[2]), (velocity[0], velocity[1], velocity[2])
    for n in range(begin, end):
        x, y, z, dt = (np.float64(points[0, n]), np.float64(points[1, n]), np.float64(points[2, n]), points[3, n])
        level = max(np.sqrt(x * x + y * y), LEAST_LEVEL_M)
        level_part, up_part, sideways = 0.0, 0.0, 0.0
        for i in range(3):
            level_part += m[1 + i] * (R[i, 0] * x + R[i, 1] * y) / level
            up_part += m[1 + i] * R[i, 2]
            sideways += m[1 + i] * (R[i, 1] * x - R[i, 0] * y)
        along = (level_part * level + up_part * z) / np.sqrt(level**2 + z**2)
        moves = (up_part * level - level_part * z, -along, sideways)
        a, b, c = _moved_by_twist(x, y, z, np.float64(dt), rate, velocity)
        x, y = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + p[0], R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + p[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + p[2]
        w, g = _weighed(x, y, z, m, weights)
        for f in range(3):
            of_ring, s = rings[f * N_RINGS + int(points[4, n])], moves[f]
            of_ring[0] += w * s
            of_ring[1] += w * s * x
            of_ring[2] += w * s * y
            of_ring[3] += w * s * z
            of_ring[4] -= g * s if f != 1 else 0.0  # an offset leaves incidences as they are
            of_ring[5] += w * s * moves[0]
            of_ring[6] += w * s * moves[1]
            of_ring[7] += w * s * moves[2]


@njit(cache=True, nogil=True, inline="always")
def _factorise(M):
    """Replaces moments M (10,) by their lower Cholesky factor. A column whose pivot is below MIN_PIVOT becomes 0."""
    for j in range(4):
        d = M[j * (j + 1) // 2 + j]
        least = MIN_PIVOT * d
        for k in range(j):
            d -= M[j * (j + 1) // 2 + k] ** 2
        f = 1.0 / np.sqrt(d) if d > least else 0.0
        M[j * (j + 1) // 2 + j] = d * f
        for i in range(j + 1, 4):
            s = M[i * (i + 1) // 2 + j]
            for k in range(j):
                s -= M[i * (i + 1) // 2 + k] * M[j * (j + 1) // 2 + k]
            M[i * (i + 1) // 2 + j] = s * f


@njit(cache=True, nogil=True, inline="always")
def _write_entry(c, q, number, m, sums, ring_sums, entries, total):
    """Writes the entry of plane q in bin c at `total`: `number` points with the sums (13,), and (3 K, 8) of rings."""
    bins, plane, count, root, incidence, rings = entries
    bins[total], plane[total], count[total] = c, q, number
    for k in range(N_MOMENTS):
        root[total, k] = sums[k]
    _factorise(root[total])
    for k in range(3):
        incidence[total, 1 + k] = sums[N_MOMENTS + k]
    incidence[total, 0] = -(sums[10] * m[1] + sums[11] * m[2] + sums[12] * m[3])
    for k in range(rings.shape[1]):
        for i in range(4):
            for j in range(i):
                ring_sums[k, i] -= root[total, i * (i + 1) // 2 + j] * ring_sums[k, j]
            pivot = root[total, i * (i + 1) // 2 + i]
            ring_sums[k, i] = ring_sums[k, i] / pivot if pivot > 0.0 else 0.0
        for i in range(RING_SUMS):
            rings[total, k, i] = ring_sums[k, i]


@njit(cache=True, nogil=True, inline="always")
def _bin_scan(i, scans, motion, poses, per_bin, planes, weights, sorted_points, entries, total):
    """Writes the entries of scan i from `total` on, in the order of bins and planes. Returns the new total."""
    ends, points = sorted_points
    first, m, sums = scans.step_start[i], np.empty(4), np.empty(N_SUMS)
    ring_sums = np.empty((entries[5].shape[1], RING_SUMS))
    for c in range(first // per_bin, scans.step_start[i + 1] // per_bin):
        for q in range(len(planes)):
            number = 0
            for b in range(c * per_bin, (c + 1) * per_bin):
                key = (b - first) * len(planes) + q
                begin, end = ends[key - 1] if key else 0, ends[key]
                if begin == end or not poses.known[b]:
                    continue
                if number == 0:
                    _fill_distance_at(poses.R_world_bin[c], poses.p_world_bin[c], planes[q], m)
                    for k in range(N_SUMS):
                        sums[k] = 0.0
                    ring_sums[:] = 0.0
                R, p, rate, velocity = poses.R_bin_step[b], poses.p_bin_step[b], motion.rate[b], motion.velocity[b]
                _add_points(points, begin, end, R, p, rate, velocity, m, weights, sums)
                if len(ring_sums):
                    _add_rings(points, begin, end, R, p, rate, velocity, m, weights, ring_sums)
                number += end - begin
            if number:
                _write_entry(c, q, number, m, sums, ring_sums, entries, total)
                total += 1
    return total


@njit(cache=True, nogil=True)
def bin_scans(scans, motion, poses, per_bin, planes, weights, per_s, entries):
    """Sums the points of all scans in bins of per_bin steps. Returns the number of entries.

    motion: `Sweep` at the steps; planes (P, 6): normal, point; per_s: steps per second. Fills `entries`: bin, plane,
    count, root, incidence and rings of each entry, see `Moments`.
    """
    n_keys, n_points, total = 0, 0, 0
    for i in range(len(scans.start) - 1):
        n_keys = max(n_keys, (scans.step_start[i + 1] - scans.step_start[i]) * len(planes))
        n_points = max(n_points, scans.start[i + 1] - scans.start[i])
    ends, points = np.empty(n_keys, np.int64), np.empty((5 if len(scans.ring) else 4, n_points), np.float32)
    for i in range(len(scans.start) - 1):
        scan_ends = ends[: (scans.step_start[i + 1] - scans.step_start[i]) * len(planes)]
        _sort_scan(i, scans, per_s, len(planes), scan_ends, points)
        # int: the literal 0 has a type of its own, for which numba would compile everything again
        total = _bin_scan(i, scans, motion, poses, per_bin, planes, weights, (scan_ends, points), entries, int(total))
    return total


@njit(cache=True, nogil=True)
def move_to_world(scans, motion, step_s, points, origins):
    """Fills `points` (N, 3), all points in the world [m], and `origins` (N, 3), the position of the LiDAR at the
    instant of each point [m]. motion: `Sweep` at the middles of steps of step_s seconds."""
    for i in range(len(scans.start) - 1):
        for n in range(scans.start[i], scans.start[i + 1]):
            offset = np.float64(scans.offset_s[n])
            k = int(np.floor(offset * (1.0 / step_s)))
            b, dt = scans.step_start[i] + k - scans.first_step[i], offset - (k + 0.5) * step_s
            x, v, w = scans.xyz[n], motion.velocity[b], motion.rate[b]
            for a in range(3):
                points[n, a] = origins[n, a] = motion.position[b, a]
            for c in range(3):
                d, e = (c + 1) % 3, (c + 2) % 3
                turned = x[c] + dt * (w[d] * x[e] - w[e] * x[d])
                for a in range(3):
                    points[n, a] += motion.rotation[b, a, c] * (turned + dt * v[c])
                    origins[n, a] += motion.rotation[b, a, c] * dt * v[c]
