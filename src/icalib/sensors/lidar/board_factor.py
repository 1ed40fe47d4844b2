"""The factors of points of one LiDAR on the sheets of the target that cameras see, and of rings on these sheets.

    y = R_scene_body^T (R_scene_lidar x (1 - range_offset / |x|) + p_scene_lidar - p_scene_body)

The print of each body is in its plane z = 0, whose pose the corners in the images give: no plane is estimated. The
residual of a point is its distance from the sheet along its beam u, y_z / u_z, as range noise is along the beam.
Distances along z would tilt the sheet: noise moves points of oblique beams sideways, too. range_offset [m] is what the
LiDAR measures too much, the same for all points.

If the size of the sheet is given, its edges are lines n . y = reach in it, with outward normals n. A ring crosses two
of them, on the beams through x1 and x2, which meet the sheet at y1 and y2: the ranges do not matter. The residual of
the ring is (off(y2) - off(y1)) / 2 with off(y) = n . y - reach: how far the middle of its part on the sheet is off.
Wide beams, and beams a little too high or low, shift both ends outwards or inwards alike, which cancels. An edge is
anywhere between two beams, so its crossing has the error of rounding. Rings of a sheet share it where the edge runs
along the columns of beams, or regularly across them. Errors of steps s that are known to differ by a share d of a step
have the covariance s^2 (1/12 - d (1 - d) / 2): the autocorrelation of the sawtooth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import ClassVar

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.detection.planes import PlaneSearch
from icalib.errors import EstimationError
from icalib.geometry.targets.base import BOARD
from icalib.model.bodies import Bodies
from icalib.model.sensor_model import Pass
from icalib.motion.factor import FactorKey, Into, RobustNoise, RowFactor, Whitened, add_rows, rows_by_recording
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import MERGED_WITHIN_S, instants
from icalib.motion.sensor_pose import Kinematics, SensorPose, rows_at
from icalib.optim.arrowhead import Piece
from icalib.optim.rows import Rows
from icalib.optim.state import Layout, State, in_recording
from icalib.sensors.lidar.binning import LidarNoise
from icalib.sensors.lidar.spec import RANGE_OFFSET

# Points nearer to the rim of the sheet are not used: their beams (some 3 mrad wide, 1 cm at 3 m) miss it in part.
RIM_M = 0.02
ON_BOARDS, ON_EDGES = "points on boards", "rings on boards"  # kinds of residuals
EDGE_GATE_M = 0.06  # largest distance from the outline of a point where a ring crosses it
GATE_SIGMAS = 4.0  # largest distance of a used point from its sheet, in standard deviations of the noise


@dataclass(frozen=True)
class BoardPoints:
    """Points of one LiDAR on planes of the target, sorted by keyframe. seconds (n,): since the first stamp, on the
    LiDAR's clock; xyz (n, 3) m; keyframe (n,); body (n,): index of the body of the target. normal (n, 3), reach (n,) m:
    of the sheet or its edge, in the frame of the body; normal . x = reach there. step (n,): distance of beams across
    the edge [m]; 1 for points on sheets."""

    seconds: np.ndarray
    xyz: np.ndarray
    keyframe: np.ndarray
    body: np.ndarray
    normal: np.ndarray
    reach: np.ndarray
    step: np.ndarray

    @classmethod
    def of(
        cls, stream: LidarStream, bodies: Bodies, state: State, off_m: float, edge_m: float = EDGE_GATE_M
    ) -> tuple[BoardPoints, BoardPoints]:
        """Points on the sheets, and points where rings cross their edges, of the scans at keyframes. off_m, edge_m:
        largest distances from a sheet and its outline, at `state`."""
        times = instants(stream, state.values)
        keyframe = np.searchsorted(0.5 * (state.seconds[1:] + state.seconds[:-1]), times)
        at_keyframe = np.abs(times - state.seconds[keyframe]) <= MERGED_WITHIN_S
        R, p = bodies.poses(state.values)
        sheets, edges = [], []
        for scan in np.flatnonzero(at_keyframe):
            xyz = stream.xyz[stream.start[scan] : stream.start[scan + 1]].astype(np.float64)
            k = np.full(len(xyz), keyframe[scan])
            world = in_scene(xyz, stream.name, k, state)
            R_body, p_body = state.rotation[keyframe[scan]], state.position[keyframe[scan]]
            origin = R_body @ state.values[stream.name, "translation"] + p_body
            for b in bodies.used:
                places = np.array([scan, keyframe[scan], b])
                y, outline = (world - p[b]) @ R[b], bodies.target.outlines[b]
                used = xyz[_hits_sheet(y, (origin - p[b]) @ R[b], outline, off_m)]
                sheets.append(
                    (np.tile(places, (len(used), 1)), used, np.tile([0.0, 0.0, 1.0, 0.0, 1.0], (len(used), 1)))
                )
                if bodies.target.has_sheet[b]:
                    at, plane = edge_points(xyz, y, Gate(outline, off_m, edge_m))
                    edges.append((np.tile(places, (len(at), 1)), at, plane))
        return cls._joined(stream, sheets), cls._joined(stream, edges)

    @classmethod
    def _joined(cls, stream: LidarStream, parts: Sequence[tuple[np.ndarray, ...]]) -> BoardPoints:
        none = np.zeros((0, 3), int), np.zeros((0, 3)), np.zeros((0, 5))
        places, xyz, plane = (np.concatenate(x) for x in zip(none, *parts, strict=True))
        order = np.argsort(places[:, 1], kind="stable")
        places, xyz, plane = places[order], xyz[order], plane[order]
        scan, keyframe, body = places.T
        return cls(stream.seconds[scan], xyz, keyframe, body, plane[:, :3], plane[:, 3], plane[:, 4])


def elevations(xyz: np.ndarray) -> np.ndarray:
    """(n,) elevations of points xyz (n, 3) above the LiDAR's x-y plane [rad]."""
    return np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))


def in_scene(xyz: np.ndarray, lidar: str, keyframe: np.ndarray, state: State) -> np.ndarray:
    """(n, 3) points xyz (n, 3) m of a LiDAR, each at its `keyframe` (n,), in the frame of the scene."""
    v = state.values
    offset = v[lidar, RANGE_OFFSET.name][0] / np.linalg.norm(xyz, axis=1, keepdims=True)
    on_body = (1.0 - offset) * xyz @ v[lidar, "rotation"].T + v[lidar, "translation"]
    return np.einsum("nij,nj->ni", state.rotation[keyframe], on_body) + state.position[keyframe]


def on_sheet(points: np.ndarray, outline: np.ndarray, margin_m: float, gate_m: float | np.ndarray) -> np.ndarray:
    """(n,) bool: points (n, 3) in the frame of a body inside the outline of its sheet, grown by margin_m."""
    xy, (low, high) = points[:, :2], outline
    inside = (xy > low - margin_m).all(axis=1) & (xy < high + margin_m).all(axis=1)
    return inside & (np.abs(points[:, 2]) < gate_m)


def _hits_sheet(points: np.ndarray, origin: np.ndarray, outline: np.ndarray, gate_m: float) -> np.ndarray:
    """(n,) bool: points (n, 3) near the sheet whose beams from `origin` (3,) meet it inside its rim. The points
    themselves would be chosen by their noise, which moves those of oblique beams across the rim."""
    height = np.where(np.abs(points[:, 2] - origin[2]) < gate_m, np.inf, points[:, 2] - origin[2])
    met = origin + (points - origin) * (-origin[2] / height)[:, None]
    near = np.abs(points[:, 2]) < gate_m
    return near & on_sheet(met, outline, -RIM_M, np.inf)


# The sheet of the target, whose place images show, in the clouds of a moving LiDAR.

AROUND_SHEET_M = 0.1  # points so near to the sheet belong to no other plane: boards are wider than their print
THROUGH_SHEET, NEAR_SHEET, ON_SHEET = -1, 1, 2


@dataclass(frozen=True)
class TargetSheet:
    """The sheet of the target's reference body. rotation (3, 3): R_world_board; outline (2, 2): see
    `Target.outlines`."""

    rotation: np.ndarray
    outline: np.ndarray

    @classmethod
    def of(cls, bodies: Bodies, state: State, recording: int) -> TargetSheet | None:
        """The sheet in one recording; None if the rig file does not give its size. Then the target may be a wall, a
        screen, or tags apart from one another."""
        if not bodies.used or not bodies.target.has_sheet[bodies.used[0]]:
            return None
        return cls(state.values[in_recording(BOARD, recording), "tilt"], bodies.target.outlines[bodies.used[0]])

    def away(self, points: np.ndarray, origins: np.ndarray, search: PlaneSearch, fewest: int) -> np.ndarray | None:
        """(N,) bool: which of points (N, 3) seen from `origins` (N, 3) are neither on the sheet nor beside it. None if
        it is not seen: fewer than `fewest` points are on it, or most beams go through it, so that it is elsewhere."""
        kinds = self.of_points(points, origins, search)
        hits, through = (np.count_nonzero(kinds == kind) for kind in (ON_SHEET, THROUGH_SHEET))
        return kinds <= 0 if hits >= max(fewest, through) else None

    def of_points(self, points: np.ndarray, origins: np.ndarray, search: PlaneSearch) -> np.ndarray:
        """(N,) int8: ON_SHEET for points (N, 3) whose beams from `origins` (N, 3) hit the sheet, NEAR_SHEET for others
        beside it, THROUGH_SHEET for those behind it, else 0. Where a beam meets the sheet does not depend on its noise,
        which would move points across the rim. The sheet has a front only, and grazing beams do not count."""
        origin = origins @ self.rotation.astype(points.dtype)
        beam = points @ self.rotation.astype(points.dtype) - origin
        y, length = origin + beam, np.sqrt((beam**2).sum(axis=1))
        falls = (origin[:, 2] > 0.0) & (-beam[:, 2] > search.least_cosine * length)
        met = origin - beam * (origin[:, 2] / np.where(falls, beam[:, 2], np.inf))[:, None]
        gate = search.gate * np.sqrt(search.noise_m**2 + search.position_m**2 + (search.angle_rad * length) ** 2)
        near = on_sheet(y, self.outline, AROUND_SHEET_M, gate)
        meets = falls & on_sheet(met, self.outline, -RIM_M, np.inf)
        return np.select(
            [meets & near, near, meets & (y[:, 2] < 0.0)], [ON_SHEET, NEAR_SHEET, THROUGH_SHEET], 0
        ).astype(np.int8)


# Where rings of a spinning LiDAR cross the edges of a sheet: half a step beyond the last beam that hits it.

RING_GAP_RAD = np.deg2rad(0.08)  # elevations of rings are farther apart: 0.11 deg in the densest LiDARs of 128 rings
FEWEST_ON_RING = 6
END_POINTS = 6  # last points of a ring on the sheet, whose line gives the range at the edge
MOST_GRAZING = 0.5  # cosine of the largest angle between a ring and the normal of the edge that it crosses: 60 deg
STEPS_BEYOND = 2.0  # steps between a crossing and the end of the field of view, from which the step itself is not known


@dataclass(frozen=True)
class Gate:
    """Which points of a cloud belong to a sheet of the given outline (2, 2). off_m: largest distance from it; edge_m:
    of a crossing from the outline."""

    outline: np.ndarray
    off_m: float
    edge_m: float = EDGE_GATE_M


def edge_points(xyz: np.ndarray, in_body: np.ndarray, gate: Gate) -> tuple[np.ndarray, np.ndarray]:
    """Points (e, 3) where rings cross the edges of a sheet, in the frame of the LiDAR; and the edges (e, 5): outward
    normal in the frame of the body, its distance from the body's origin, and `BoardPoints.step`. xyz, in_body
    (N, 3): all points of a scan in both frames."""
    near = np.flatnonzero(on_sheet(in_body, gate.outline, gate.edge_m, np.inf))
    elevation = elevations(xyz[near])
    order = np.argsort(elevation)
    x, y = xyz[near, :2].sum(axis=0)
    azimuth = np.arctan2(x * xyz[:, 1] - y * xyz[:, 0], x * xyz[:, 0] + y * xyz[:, 1])
    rings = []
    for ring in np.split(near[order], np.flatnonzero(np.diff(elevation[order]) > RING_GAP_RAD) + 1):
        ends = _ends_of_ring(xyz, in_body, azimuth, ring, gate)
        if ends is not None:
            rings.append(ends)
    ends = np.concatenate([np.zeros((0, 8)), *rings])
    return ends[:, :3], ends[:, 3:]


def _ends_of_ring(
    xyz: np.ndarray, in_body: np.ndarray, azimuth: np.ndarray, ring: np.ndarray, gate: Gate
) -> np.ndarray | None:
    """Both ends (2, 8) of a ring on a sheet: point and edge as in `edge_points`; None if it has none."""
    hits = ring[on_sheet(in_body[ring], gate.outline, gate.edge_m, gate.off_m)]
    turn, order = np.unique(azimuth[hits], return_index=True)  # one of several returns of a beam
    hits = hits[order]
    if len(hits) < FEWEST_ON_RING or np.ptp(elevations(xyz[hits])) > 2.0 * RING_GAP_RAD:
        return None  # a LiDAR without rings, or with rings that do not share an origin
    both, step = np.concatenate([xyz[hits], in_body[hits]], axis=1), float(np.median(np.diff(turn)))
    if min(turn[0] - azimuth.min(), azimuth.max() - turn[-1]) < STEPS_BEYOND * step:
        return None  # the field of view ends there, and not the sheet
    ends = []
    for sign, end in ((-1.0, slice(0, END_POINTS)), (1.0, slice(-END_POINTS, None))):
        at = turn[0 if sign < 0.0 else -1] + 0.5 * sign * step
        slope, value = np.polyfit(turn[end] - at, both[end], 1)
        edge = _edge(value[3:5], sign * slope[3:5] / np.linalg.norm(slope[3:5]), gate)
        if edge is None:
            return None
        ends.append([*value[:3], *edge, step * abs(edge[:2] @ slope[3:5])])
    return np.array(ends)


def _edge(at: np.ndarray, along: np.ndarray, gate: Gate) -> np.ndarray | None:
    """The edge (4,) that a ring leaves at `at` (2,) in the direction `along` (2,); None near corners, or far off."""
    low, high = gate.outline
    apart = np.array([low[0] - at[0], low[1] - at[1], at[0] - high[0], at[1] - high[1]])
    normals = np.array([[-1.0, 0.0], [0.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    k = int(np.argmax(apart))
    others = np.delete(apart, [k, (k + 2) % 4])
    if abs(apart[k]) > gate.edge_m or (others > -EDGE_GATE_M).any() or normals[k] @ along < MOST_GRAZING:
        return None
    return np.array([*normals[k], 0.0, (normals[k] * np.where(k < 2, low, high)).sum()])


def _of_offset_and_slope(phase: np.ndarray) -> float:
    """Largest variance of the offset and slope of n rounding errors of known phase (n,) in steps, over that of
    uncorrelated errors."""
    apart = np.abs(phase[:, None] - phase) % 1.0
    basis, _ = np.linalg.qr(np.column_stack([np.ones(len(phase)), np.arange(len(phase))]))
    return float(np.linalg.eigvalsh(basis.T @ (1.0 - 6.0 * apart * (1.0 - apart)) @ basis)[-1])


@dataclass(frozen=True)
class BoardFactor(RowFactor):
    """Points of one LiDAR on sheets of the target, or pairs of points where a ring crosses their edges. kind: of the
    residuals, ON_BOARDS or ON_EDGES; sigma (m,) m of each residual; starts: first keyframe of each recording."""

    is_sparse: ClassVar[bool] = False
    units: ClassVar[Mapping[str, str]] = {ON_BOARDS: "m", ON_EDGES: "m"}

    name: str
    kind: str
    points: BoardPoints
    sigma: np.ndarray
    noise: LidarNoise
    bodies: Bodies
    starts: tuple[int, ...]
    n_keyframes: int
    layout: Layout
    imu: ImuData | None = None
    gravity: float = 0.0

    @classmethod
    def build(cls, stream: LidarStream, noise: LidarNoise, at: Pass) -> Iterator[BoardFactor]:
        """The factors of a pass. Raises EstimationError if no point lies on a sheet."""
        along = float(np.hypot(noise.sigma, noise.beam_sigma))
        of_kinds = BoardPoints.of(stream, at.bodies, at.state, GATE_SIGMAS * along)
        for kind, points in zip((ON_BOARDS, ON_EDGES), of_kinds, strict=True):
            n, count = len(points.xyz), len(at.state.seconds)
            if kind == ON_BOARDS and not n:
                raise EstimationError(
                    f"{stream.name}: no point lies on the target; check that it is in the field of view of "
                    f"{stream.name}, and the extrinsics in the rig file."
                )
            one = cls(stream.name, kind, points, np.ones(n), noise, at.bodies, at.starts, count, at.layout, at.imu)
            if n:
                sigma = (
                    noise.inflation * along * np.ones(n)
                    if kind == ON_BOARDS
                    else noise.edge_scale * one.rounding(at.state)
                )
                yield replace(one, sigma=sigma)

    def rounding(self, state: State) -> np.ndarray:
        """(m,) standard deviations [m] of the middles of rings by the steps between beams, as large as offset and slope
        of the rings of a sheet need them."""
        off = self.rows_of_points(slice(None), state, False)[0].residual.reshape(-1, 2)
        step = self.points.step.reshape(-1, 2)
        variance = np.empty_like(off)
        sheet = self.points.keyframe[::2] * len(self.bodies.target.bodies) + self.points.body[::2]
        for one in np.split(np.arange(len(off)), np.flatnonzero(np.diff(sheet)) + 1):
            phase = off[one] / step[one]
            shared = [_of_offset_and_slope(phase[:, end]) for end in range(2)]
            variance[one] = step[one] ** 2 / 12.0 * np.maximum(shared, 1.0)
        return 0.5 * np.sqrt(variance.sum(axis=1))

    def noise_sizes(self, out: Whitened) -> tuple[float, float]:
        """Standard deviation of residuals about what fits those of each stop best, an offset and two tilts, in m or
        for rings in units of their rounding; and how many times larger it is in these offsets and tilts. This is above
        1 if errors of one stop correlate."""
        raw = out.residual[:, 0] * (self.noise.edge_scale if self.kind == ON_EDGES else self.sigma)
        root, xyz = out.root[:, 0], self.points.xyz[:: self.points_per_row]
        squares, planes, n = np.zeros(2), 0, 0
        for stop in np.split(np.arange(len(raw)), np.flatnonzero(np.diff(self.keyframe)) + 1):
            x = xyz[stop] - xyz[stop].mean(axis=0)
            axes = np.linalg.svd(x, full_matrices=False)[2][:2]
            basis, _ = np.linalg.qr(root[stop, None] * np.column_stack([np.ones(len(x)), x @ axes.T]))
            weighted = root[stop] * raw[stop]
            along = basis.T @ weighted
            squares += along @ along, weighted @ weighted - along @ along
            planes, n = planes + basis.shape[1], n + max(len(x) - basis.shape[1], 0)
        sigma = float(np.sqrt(squares[1] / max(n, 1)))
        return sigma, max(1.0, float(np.sqrt(squares[0] / planes)) / max(sigma, 1e-9))

    @property
    def key(self) -> FactorKey:
        return self.name, self.kind

    @property
    def kinds(self) -> dict[str, slice]:
        return {self.kind: slice(0, 1)}

    def output(self) -> Whitened:
        return Whitened.empty(len(self.sigma), 1)

    def times(self, state: State) -> np.ndarray:
        return state.seconds[self.keyframe]

    def raw(self, out: Whitened) -> np.ndarray:
        return out.residual * self.sigma[:, None]

    def raw_sigma(self) -> np.ndarray:
        return self.sigma[:, None]

    @cached_property
    def _columns(self) -> np.ndarray:
        """Calibration columns of the LiDAR's pose, its range offset, and the poses of all bodies."""
        offset = self.layout.columns(self.name, RANGE_OFFSET.name)
        poses, _ = self.bodies.columns(self.layout)
        return np.concatenate([Kinematics.of(self).columns(), offset, poses.ravel()])

    @cached_property
    def keyframe(self) -> np.ndarray:
        """(m,) keyframe of each row: of a point, or of both ends of a ring."""
        return self.points.keyframe[:: self.points_per_row]

    @property
    def points_per_row(self) -> int:
        return 2 if self.kind == ON_EDGES else 1

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`."""
        total, into, step = 0.0, Into(piece, out, sums, curved), self.points_per_row
        for _, block in rows_by_recording(self.keyframe, self.starts, self.n_keyframes, piece):
            rows, _ = self.rows_of_points(slice(step * block.start, step * block.stop), state, sums)
            if self.kind == ON_EDGES:
                rows = Rows(*(0.5 * (x[1::2] - x[::2]) for x in rows))
            interval = rows.on_intervals(self.keyframe[block], self.n_keyframes)
            noise = RobustNoise(1.0 / self.sigma[block][:, None, None], self.noise.loss, self.noise.loss_scale)
            total += add_rows(rows, block, interval, self._columns, noise, into)
        return total

    def rows_of_points(self, block: slice, state: State, jacobians: bool) -> tuple[Rows, np.ndarray]:
        """Residuals of the points `block` and their Jacobians; and cosines (n,) of the beams with the normals of the
        sheets."""
        p = self.points
        x, body, of_body = p.xyz[block], p.body[block], p.normal[block]
        at = SensorPose.at(Kinematics.of(self), p.seconds[block], p.keyframe[block], state, jacobians)
        beam = x / np.linalg.norm(x, axis=1, keepdims=True)
        x = x - state.values[self.name, RANGE_OFFSET.name][0] * beam
        R, origin = self.bodies.poses(state.values)
        in_body = partial(np.einsum, "nij,ni->nj", R[body])
        y = np.einsum("nij,nj->ni", at.rotation, x) + at.position - origin[body]
        ray = np.einsum("nij,nj->ni", at.rotation, beam)
        cosine = (R[body, :, 2] * ray).sum(axis=1)
        along = (R[body, :, 2] * y).sum(axis=1) / cosine
        x, y = x - along[:, None] * beam, y - along[:, None] * ray  # where the beam meets the sheet
        residual = along if self.kind == ON_BOARDS else (of_body * in_body(y)).sum(axis=1) - p.reach[block]
        if not jacobians:
            return Rows(residual[:, None], np.zeros((0, 1, 0))), cosine
        # The derivative is that of the distance of this point from the plane through the beam and the edge; for points
        # on the sheet, from the sheet, over the cosine.
        z = np.array([0.0, 0.0, 1.0]) / cosine[:, None]
        of_body = z if self.kind == ON_BOARDS else of_body - (of_body * in_body(ray)).sum(axis=1, keepdims=True) * z
        in_scene = np.einsum("nij,nj->ni", R[body], of_body)
        normal = np.einsum("nij,ni->nj", at.rotation, in_scene)  # in axes of the LiDAR
        J_further = np.zeros((len(x), 1, 1 + self.bodies.columns(self.layout)[0].size))
        J_further[:, 0, 0] = -(normal * beam).sum(axis=1)
        if self.bodies.several:
            J_body = np.concatenate([np.cross(of_body, in_body(y)), -in_scene], axis=1)
            J_further[np.arange(len(x))[:, None], 0, 1 + 6 * body[:, None] + np.arange(6)] = J_body
        J_pose = np.concatenate([np.cross(x, normal), normal], axis=1)[:, None, :]
        return rows_at(residual[:, None], (J_pose,), (at,), J_further), cosine
