"""The factor of points of one LiDAR on planes: equations (23)-(26) of the iCalib paper.

    residual = n . (p_world_lidar(t) + R_world_lidar(t) x) - d    for each point x at its instant t

Here x is the measured point, turned by the ring_elevation of its ring, less its ring_offset and range_offset along its
beam, over 1 + range_scale. The factor has 1 + range_scale
times this distance, over the value at the start of a pass: its noise does not depend on the scale.

This is the signed form of (24) and (25). A factor stores moments of the points (`take_moments`), computed once per
pass: robust weights and the association with planes stay constant while the solver runs. Its rows are the four whitened
residuals of each plane in a bin, which are equivalent to the residuals of all points there (`kernels`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.motion.factor import FactorKey, RowFactor, Whitened
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import EstimatedMotion as ImuMotion
from icalib.motion.poses import assign_keyframes, instants, offset_at, slices_by_clock
from icalib.motion.sensor_pose import Kinematics, SensorPose
from icalib.optim.arrowhead import Piece, in_parallel
from icalib.optim.state import Key, Layout, Planes, State, plane_value
from icalib.rig import Scheme
from icalib.sensors.lidar import kernels
from icalib.sensors.lidar.binning import (
    BIN_S,
    LEAST_LEVEL_M,
    NO_RINGS,
    AssociatedPoints,
    LidarNoise,
    Moments,
    take_moments,
)
from icalib.sensors.lidar.kernels import N_WHITENED, Bins
from icalib.sensors.lidar.spec import N_RINGS, OF_RINGS, RANGE_OFFSET, RANGE_SCALE

BINS_PER_CHUNK = 512  # poses and Jacobians of so many bins fit the processor cache


def range_errors(state: State, lidar: str) -> tuple[float, float]:
    """What the LiDAR measures too much [m], and measured over true range, less 1; 0 in a state without these
    parameters, as that of its odometry."""
    offset, scale = (float(state.values.get((lidar, x.name), [0.0])[0]) for x in (RANGE_OFFSET, RANGE_SCALE))
    return offset, scale


def true_ranges(stream: LidarStream, state: State) -> LidarStream:
    """The stream with corrected ranges."""
    offset, scale = (np.float32(x) for x in range_errors(state, stream.name))
    if offset == scale == 0.0:
        return stream
    distance = np.linalg.norm(stream.xyz, axis=1, keepdims=True)
    return replace(stream, xyz=stream.xyz * ((1.0 - offset / distance) / (1.0 + scale)))


RINGS_SEEN = "rings seen"  # key of a state: elevations of the lowest and highest ring [rad], band with most points
FEW_POINTS, ENOUGH_POINTS = 1e-5, 500_000  # share of points that may be beyond them; points by which they are found


def elevations(xyz: np.ndarray) -> np.ndarray:
    """(n,) elevations of points xyz (n, 3) above the LiDAR's x-y plane [rad]."""
    return np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))


def rings_seen(stream: LidarStream, state: State | None = None) -> np.ndarray:
    """The value of RINGS_SEEN: that of the state, which holds for parts of the stream, too, or that of the stream."""
    if state is not None and (stream.name, RINGS_SEEN) in state.values:
        return state.values[stream.name, RINGS_SEEN]
    some = elevations(stream.xyz[:: len(stream.xyz) // ENOUGH_POINTS | 1])
    some = some[np.isfinite(some)]
    ends = np.quantile(some, [FEW_POINTS, 1.0 - FEW_POINTS]) if len(some) else np.zeros(2)
    return np.append(ends, np.bincount(_bands(some, *ends), minlength=N_RINGS).argmax())


def rings_of(stream: LidarStream, state: State) -> np.ndarray:
    """(N,) uint8: band of elevation of each point. Bands are evenly spaced, from the middle of the first at the lowest
    ring to the middle of the last at the highest."""
    return _bands(elevations(stream.xyz), *rings_seen(stream, state)[:2])


def _bands(elevation: np.ndarray, low: float, high: float) -> np.ndarray:
    per_band = (N_RINGS - 1) / max(high - low, 1e-9)  # a LiDAR of one ring has one band
    return np.clip(np.rint(np.nan_to_num(elevation - low) * per_band), 0, N_RINGS - 1).astype(np.uint8)


def ring_errors(state: State, lidar: str) -> np.ndarray:
    """(3 K,) elevations [rad], offsets [m], and azimuths [rad] of rings, in the order of OF_RINGS."""
    return np.concatenate([state.values.get((lidar, x.name), np.zeros(N_RINGS)) for x in OF_RINGS])


def true_rings(stream: LidarStream, state: State) -> LidarStream:
    """The stream with corrected rings."""
    if not (off := ring_errors(state, stream.name)).any():
        return stream
    turn, offset, azimuth = off.astype(np.float32).reshape(-1, N_RINGS)[:, rings_of(stream, state)]
    (x, y, z), shorter = stream.xyz.T, 1.0 - offset / np.linalg.norm(stream.xyz, axis=1)
    level, up, along = np.maximum(np.hypot(x, y), LEAST_LEVEL_M), shorter * np.sin(turn), shorter * np.cos(turn)
    ratio = along - up * z / level
    x, y = ratio * (x * np.cos(azimuth) - y * np.sin(azimuth)), ratio * (x * np.sin(azimuth) + y * np.cos(azimuth))
    return replace(stream, xyz=np.column_stack([x, y, z * along + level * up]))


def true_points(stream: LidarStream, state: State) -> LidarStream:
    """The stream with all corrections."""
    return true_ranges(true_rings(stream, state), state)


@dataclass(frozen=True)
class LidarFactor(RowFactor):
    """All scans of one LiDAR.

    keyframe (n,), increasing: keyframe from which the pose of each bin of `moments` is propagated. noise_angle (n,),
    J_rows_noise (E, 3, 4), J_incidence_noise (E, 3): see `Bins`, at the state from which the pass starts. planes: keys,
    in the values of a state, of the planes of the moments; that of a tilt stands for the sheet of the target. Points
    have been corrected by the range_errors and ring_errors (3 K,) of the state from which the pass starts; the latter
    are empty if all are fixed.
    """

    name: str
    moments: Moments
    keyframe: np.ndarray
    noise_angle: np.ndarray
    J_rows_noise: np.ndarray
    J_incidence_noise: np.ndarray
    planes: tuple[Key, ...]
    range_errors: tuple[float, float]
    ring_errors: np.ndarray
    imu: ImuData
    gravity: float
    scheme: Scheme
    layout: Layout
    n_keyframes: int

    @classmethod
    def build(
        cls,
        stream: LidarStream,
        plane: np.ndarray,
        planes: tuple[Key, ...],
        motion: ImuMotion,
        noise: LidarNoise,
        layout: Layout,
        scheme: Scheme = "inertial",
        bin_s: float = BIN_S,
    ) -> LidarFactor:
        """The factor of a pass that starts from `motion`. plane (N,) int32: index of each point into `planes`, -1:
        none. Raises EstimationError if no point is left."""
        values = np.array([plane_value(motion.state.values[p]) for p in planes])
        has_rings = any(b.sensor == stream.name and b.name in (x.name for x in OF_RINGS) for b in layout.free)
        ring = rings_of(stream, motion.state) if has_rings else NO_RINGS
        errors = ring_errors(motion.state, stream.name) if has_rings else np.zeros(0)
        cloud = AssociatedPoints(true_points(stream, motion.state), plane, values, ring)
        moments = take_moments(cloud, motion, noise, bin_s)
        if has_rings:  # that with most points has no offset of its own
            reference = int(rings_seen(stream, motion.state)[-1])
            moments.rings[:, N_RINGS + reference] = moments.rings[:, reference::N_RINGS, 6] = 0.0
        times = instants(stream, motion.state.values, moments.seconds)
        keyframe = assign_keyframes(scheme, motion.state.seconds, times, motion.imu.forwards)
        noise_angle = motion.imu.rotation_sigma(motion.state.seconds[keyframe], times)
        if scheme != "inertial":
            noise_angle[:] = 0.0
        J_rows = np.zeros((len(moments.plane), 3, N_WHITENED), np.float32)
        J_incidence = np.zeros((len(moments.plane), 3), np.float32)
        n = len(motion.state.seconds)
        factor = cls(
            stream.name, moments, keyframe, noise_angle, J_rows, J_incidence, planes,
            range_errors(motion.state, stream.name), errors, motion.imu, motion.gravity, scheme, layout, n,
        )  # fmt: skip
        factor._linearise_noise(motion.state)
        return factor

    def _linearise_noise(self, state: State) -> None:
        """Fills J_rows_noise and J_incidence_noise, on two threads."""

        def fill(ends: tuple[int, int]) -> None:
            for bins, at, columns, planes in self._chunks(state, *ends):
                kernels.linearise_noise(bins, at, columns, planes)

        middle = len(self.keyframe) // 2
        in_parallel(fill, [(0, middle), (middle, len(self.keyframe))])

    @cached_property
    def _plane_columns(self) -> np.ndarray:
        """(P, 5 + 3 K) calibration columns of each plane, see `Planes`. The distance of the target's sheet is known."""
        errors = (RANGE_OFFSET, RANGE_SCALE, *(OF_RINGS if len(self.ring_errors) else ()))
        ranges = [self.layout.block(self.name, x.name).columns for x in errors]
        planes = (np.append(self.layout.block(*p).columns, -1)[: kernels.PLANE_DIM] for p in self.planes)
        return np.array([np.concatenate([plane, *ranges]) for plane in planes])

    @property
    def key(self) -> FactorKey:
        return self.name, "points"

    @property
    def kinds(self) -> dict[str, slice]:
        return {"points": slice(0, N_WHITENED)}

    def output(self) -> Whitened:
        """Empty rows (E, 4) for `accumulate` to fill; the robust weights are included in the moments."""
        return Whitened.without_loss(len(self.moments.plane), N_WHITENED)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`. `curved` has no effect: weights are constant within a pass."""
        into, total = piece.sums(sums), 0.0
        for bins, at, columns, planes in self._chunks(state, *self._bins_of(piece)):
            total += kernels.accumulate(bins, at, columns, planes, into, out.residual)
        return total

    def count(self, out: Whitened, kind: str) -> int:
        """Number of points, as the chi^2 of the rows equals that of all points."""
        return int(self.moments.count.sum())

    def times(self, state: State) -> np.ndarray:
        """(E,) centre of the bin of each entry on the IMU's clock [s]."""
        at = self.moments.seconds + offset_at(state, self.name, self.keyframe, self.moments.seconds)
        return np.repeat(at, np.diff(self.moments.start))

    def rms(self, out: Whitened, kind: str) -> tuple[float, str]:
        """Weighted RMS of the distances of points from their planes, and its unit."""
        weight = float((self.moments.root[:, 0] ** 2).sum())
        return float(np.sqrt((out.residual**2).sum() / weight)), "m"

    def _chunks(self, state: State, b0: int, b1: int) -> Iterator[tuple[Bins, SensorPose, np.ndarray, Planes]]:
        """Yields bins b0:b1 in chunks, with poses of the LiDAR, their calibration columns (c,), and the planes."""
        (offset, scale), (offset0, scale0), m = range_errors(state, self.name), self.range_errors, self.moments
        per_unit = 1.0 / (1.0 + scale0)
        left = per_unit * (offset - offset0), per_unit * (scale - scale0), per_unit
        rings = self.ring_errors
        rings = ring_errors(state, self.name) - rings if len(rings) else rings
        planes = Planes.of(self.planes, state, self._plane_columns, left, rings)
        kinematics = Kinematics(self.name, self.layout, self.imu, self.gravity, self.scheme)
        for columns, a, b in self._chunk_ends(state, kinematics, b0, b1):
            keyframe, noise = self.keyframe[a:b], (self.J_rows_noise, self.J_incidence_noise)
            entries = m.plane, m.root, m.incidence, m.rings
            bins = Bins(keyframe, self.noise_angle[a:b], m.start[a : b + 1], *entries, *noise)
            yield bins, SensorPose.at(kinematics, m.seconds[a:b], keyframe, state), columns, planes

    def _chunk_ends(
        self, state: State, kinematics: Kinematics, b0: int, b1: int
    ) -> Iterator[tuple[np.ndarray, int, int]]:
        """Yields bins b0:b1 in chunks: calibration columns (c,) of their poses, first bin, and the bin after the
        last."""
        for clock, block in slices_by_clock(state, self.name, self.keyframe[b0:b1]):
            columns = kinematics.columns(clock)
            first, last = b0 + block.start, b0 + block.stop
            # Bins on one side of a keyframe share an unknown rotation, so that they must not be separated.
            sides = np.flatnonzero(np.diff(2 * self.keyframe[first:last] + (self.noise_angle[first:last] >= 0.0))) + 1
            sides = np.append(sides, last - first)
            ends = sides[np.searchsorted(sides, np.arange(BINS_PER_CHUNK, last - first, BINS_PER_CHUNK))]
            for a, b in pairwise(np.unique([0, *ends, last - first])):
                yield columns, first + int(a), first + int(b)

    def _bins_of(self, piece: Piece) -> tuple[int, int]:
        """First bin of `piece`, and the bin after its last one. The last keyframe of a piece belongs to the next piece,
        except in the last piece of the trajectory."""
        stop = piece.last + 1 if piece.last == self.n_keyframes - 1 else piece.last
        b0, b1 = np.searchsorted(self.keyframe, [piece.first, stop])
        return int(b0), int(b1)
