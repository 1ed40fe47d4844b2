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

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.errors import EstimationError
from icalib.motion.clocks import instants
from icalib.motion.keyframe_placement import usable
from icalib.motion.sweep import Motion, sweep
from icalib.optim.arrowhead import in_parallel
from icalib.optim.robust_weights import LOSSES
from icalib.rig import Loss
from icalib.sensors.lidar.moments import (
    MOMENTS,
    Cells,
    Scans,
    Weights,
    bin_scans,
    move_to_world,
    step_range,
    to_centres,
)

BIN_S = 3e-3
COARSE_BIN_S = 11e-3  # while all is only about where it is
STEP_S = 1e-3  # of a longer bin
LOOKED_AT = 500_000  # points of a LiDAR show where planes end
POINTS_AT_A_TIME = 150_000  # by one thread: what a chunk needs beside the cloud stays small


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
) -> tuple[Scans, np.ndarray, slice]:
    """Some of the scans with their steps, `each` so many a bin; the middles of steps in seconds on the LiDAR's clock;
    which points they are."""
    start = stream.start[own.start : own.stop + 1]
    points = slice(int(start[0]), int(start[-1]))
    start, offset_s = start - start[0], stream.offset_s[points]
    low, width = np.empty(len(start) - 1, np.int64), np.empty(len(start) - 1, np.int64)
    step_range(start, offset_s, 1.0 / step_s, each, low, width)
    steps = np.concatenate([[0], np.cumsum(width)])
    within = np.arange(steps[-1]) - np.repeat(steps[:-1] - low, width)
    seconds = np.repeat(stream.seconds[own], width) + (within + 0.5) * step_s
    return Scans(start, offset_s, stream.xyz[points], plane[points], low, steps), seconds, points


def _moments_of(
    cloud: Associated, drive: Motion, noise: LidarNoise, bin_s: float, own: slice
) -> tuple[np.ndarray, ...]:
    """Of some of the scans: seconds of the bins, and of each entry bin, plane, count, root and slant."""
    each = steps_of(bin_s)
    scans, seconds, _ = _laid_out(cloud.stream, cloud.plane, bin_s / each, each, own)
    times = instants(cloud.stream, drive.state.values, seconds)
    # All steps of a bin hang on one keyframe: between two keyframes a state that has not settled yet may jump.
    motion, n = sweep(drive, cloud.stream.name, times, np.repeat(times[each // 2 :: each], each)), len(times)
    cells = Cells(
        np.empty(n, np.bool_), np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n // each, 3, 3)),
        np.empty((n // each, 3)),
    )  # fmt: skip
    to_centres(motion, each, usable(drive.imu, times, drive.max_gap_s), cells)
    weights = Weights(noise.sigma**2, noise.beam_sigma**2, LOSSES[noise.loss], noise.loss_scale)
    most = min(len(scans.xyz), len(cells.position) * len(cloud.planes))
    entries = (
        np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64), np.empty((most, MOMENTS)),
        np.empty((most, 4)),
    )  # fmt: skip
    k = bin_scans(scans, motion, cells, each, cloud.planes, weights, each / bin_s, entries)
    return seconds[each // 2 :: each], *(e[:k].copy() for e in entries)


def steps_of(bin_s: float) -> int:
    """Steps of a bin, an odd number: the middle of one is the bin's centre."""
    return max(2 * (int(bin_s / STEP_S + 0.5) // 2) + 1, 1) if bin_s > STEP_S else 1


def in_world(drive: Motion, stream: LidarStream) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of a LiDAR in the world frame, float32, and where it was at their instants (N, 3), as `drive` has
    it. Within a step it moves with its twist; at instants without IMU as its nearest reading says."""
    points, seen_from = np.empty((len(stream.xyz), 3), np.float32), np.empty((len(stream.xyz), 3), np.float32)

    def move(own: slice) -> None:
        scans, seconds, ends = _laid_out(stream, stream.plane, STEP_S, 1, own)
        motion = sweep(drive, stream.name, instants(stream, drive.state.values, seconds))
        move_to_world(scans, motion, STEP_S, points[ends], seen_from[ends])

    in_parallel(move, _groups(stream))
    return points, seen_from


def points_on_planes(drive: Motion, stream: LidarStream, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) in the world frame, about LOOKED_AT at most, of those that lie on planes, and on which (n,); plane
    (N,): -1 where a point of the stream lies on none."""
    some = (plane >= 0) & (np.arange(len(plane)) % (len(plane) // LOOKED_AT | 1) == 0)
    return in_world(drive, stream.some(some))[0], plane[some]
