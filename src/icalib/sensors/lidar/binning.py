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
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.errors import EstimationError
from icalib.motion.keyframe_placement import usable
from icalib.motion.sweep import EstimatedMotion, sweep
from icalib.motion.time_offsets import instants
from icalib.optim.arrowhead import in_parallel
from icalib.optim.robust_weights import LOSSES
from icalib.rig import Loss
from icalib.sensors.lidar.moments import (
    N_MOMENTS,
    BinPoses,
    RangeWeights,
    Scans,
    bin_scans,
    fill_bin_poses,
    move_to_world,
    step_range,
)

BIN_S = 3e-3  # duration of a bin; its points share the pose perturbation of its centre
COARSE_BIN_S = 11e-3  # duration of a bin in early passes: fewer bins while the state is still inaccurate
BIN_STEP_S = 1e-3  # duration of a step within a bin; a constant twist errs by 1e-6 m at 5 m/s^2
MAX_OUTLINE_POINTS = 500_000  # points of a LiDAR from which the extent of planes is found; bounds the memory
POINTS_PER_CHUNK = 150_000  # points of a thread at a time; their entries need 20 MB at most


@dataclass(frozen=True)
class LidarNoise:
    """Noise of a point's distance from its plane. sigma [m]: isotropic part. beam_sigma [m]: range noise along the
    beam, projected on the normal. loss: robust loss; loss_scale: its scale in standard deviations."""

    sigma: float
    beam_sigma: float = 0.0
    loss: Loss = "none"
    loss_scale: float = 2.5


@dataclass(frozen=True)
class AssociatedPoints:
    """Points of one LiDAR and their planes. plane (N,) int32: row of `planes` for each point, -1: none. planes (P, 6):
    normal, and a point [m], in the world frame."""

    stream: LidarStream
    plane: np.ndarray
    planes: np.ndarray


@dataclass(frozen=True)
class Moments:
    """Moments of n time bins of one LiDAR, ordered by time. An entry is one plane in one bin; bin j has the entries
    start[j]:start[j + 1].

    seconds (n,): centres of the bins on the LiDAR's clock, since its first stamp; plane, count (E,): plane and number
    of points of each entry. root (E, 10): lower Cholesky factor L, row by row, of the moments sum w (1, x) (1, x)^T; w
    is the robust weight of a point over its variance. incidence (E, 4): incidence term, the change of half the chi^2
    with the variances, incidence . (1, R_world_lidar^T n).
    """

    seconds: np.ndarray
    start: np.ndarray
    plane: np.ndarray
    count: np.ndarray
    root: np.ndarray
    incidence: np.ndarray


def take_moments(cloud: AssociatedPoints, motion: EstimatedMotion, noise: LidarNoise, bin_s: float = BIN_S) -> Moments:
    """Moments of all points that lie on a plane, with poses, planes and residuals at the state of `motion`.

    Points in IMU gaps that are not bridged are left out. Groups of scans are summed one after another on two threads,
    which bounds the memory. Raises EstimationError if no point is left.
    """
    groups = _scan_groups(cloud.stream)
    seconds, bins, *entries = zip(
        *in_parallel(lambda group: _moments_of(cloud, motion, noise, bin_s, group), groups), strict=True
    )
    at, (plane, count, root, incidence) = np.concatenate(seconds), (np.concatenate(e) for e in entries)
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
    return Moments(at[bin_of[first]], start, plane[order], count[order], root[order], incidence[order])


def _scan_groups(stream: LidarStream) -> Iterator[slice]:
    """Groups of consecutive scans that have about POINTS_PER_CHUNK points together."""
    ends = np.searchsorted(stream.start, np.arange(0, stream.start[-1], POINTS_PER_CHUNK))
    edges = np.unique(np.append(ends, len(stream.stamps_ns)))
    return (slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:], strict=True))


def _scans_with_steps(
    stream: LidarStream, plane: np.ndarray, step_s: float, per_bin: int, group: slice
) -> tuple[Scans, np.ndarray, slice]:
    """A group of scans divided into steps of step_s, per_bin of which make a bin; the middles of the steps (n,) on the
    LiDAR's clock [s]; and the slice of the points. plane (N,): plane of each point of the stream."""
    start = stream.start[group.start : group.stop + 1]
    points = slice(int(start[0]), int(start[-1]))
    start, offset_s = start - start[0], stream.offset_s[points]
    first, count = np.empty(len(start) - 1, np.int64), np.empty(len(start) - 1, np.int64)
    step_range(start, offset_s, 1.0 / step_s, per_bin, first, count)
    step_start = np.concatenate([[0], np.cumsum(count)])
    number = np.arange(step_start[-1]) - np.repeat(step_start[:-1] - first, count)
    seconds = np.repeat(stream.seconds[group], count) + (number + 0.5) * step_s
    return Scans(start, offset_s, stream.xyz[points], plane[points], first, step_start), seconds, points


def _moments_of(
    cloud: AssociatedPoints, motion: EstimatedMotion, noise: LidarNoise, bin_s: float, group: slice
) -> tuple[np.ndarray, ...]:
    """Centres [s] of the bins of a group of scans; and bin, plane, count, root and incidence of each entry."""
    per_bin = steps_of(bin_s)
    scans, seconds, _ = _scans_with_steps(cloud.stream, cloud.plane, bin_s / per_bin, per_bin, group)
    times = instants(cloud.stream, motion.state.values, seconds)
    # All steps of a bin are propagated from one keyframe: trajectories of two keyframes may differ before convergence.
    lidar = sweep(motion, cloud.stream.name, times, np.repeat(times[per_bin // 2 :: per_bin], per_bin))
    poses = _bin_poses(len(times), len(times) // per_bin)
    fill_bin_poses(lidar, per_bin, usable(motion.imu, times, motion.max_gap_s), poses)
    weights = RangeWeights(noise.sigma**2, noise.beam_sigma**2, LOSSES[noise.loss], noise.loss_scale)
    entries = _empty_entries(min(len(scans.xyz), len(poses.p_world_bin) * len(cloud.planes)))
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


def in_world(motion: EstimatedMotion, stream: LidarStream) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a LiDAR in the world frame, and positions (N, 3) of the LiDAR at their instants, float32 [m].

    Within a step the LiDAR moves with its twist. In gaps of the IMU its motion follows the nearest reading.
    """
    points, origins = np.empty((len(stream.xyz), 3), np.float32), np.empty((len(stream.xyz), 3), np.float32)

    def move(group: slice) -> None:
        scans, seconds, range_of_points = _scans_with_steps(stream, stream.plane, BIN_STEP_S, 1, group)
        lidar = sweep(motion, stream.name, instants(stream, motion.state.values, seconds))
        move_to_world(scans, lidar, BIN_STEP_S, points[range_of_points], origins[range_of_points])

    in_parallel(move, _scan_groups(stream))
    return points, origins


def points_on_planes(motion: EstimatedMotion, stream: LidarStream, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) on planes in the world frame [m], about MAX_OUTLINE_POINTS at most, and the plane of each (n,).
    plane (N,): plane of each point of the stream, -1: none."""
    some = (plane >= 0) & (np.arange(len(plane)) % (len(plane) // MAX_OUTLINE_POINTS | 1) == 0)
    return in_world(motion, stream.some(some))[0], plane[some]
