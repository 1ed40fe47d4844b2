"""The factors of points of one LiDAR on the sheets of the target that cameras see, and of rings on these sheets.

    y = R_scene_body^T (R_scene_lidar x' + p_scene_lidar - p_scene_body)
    x' = x (1 - range_offset / |x|) / (1 + range_scale)

The print of each body is in its plane z = 0, whose pose the corners in the images give: no plane is estimated. The
residual of a point is its distance from the sheet along its beam u, y_z / u_z, as range noise is along the beam.
Distances along z would tilt the sheet: noise moves points of oblique beams sideways, too. range_offset [m] is what the
LiDAR measures too much, the same for all points.

If the size of the sheet is given, its edges are lines n . y = reach in it, with outward normals n. A ring crosses two
of them, on the beams through x1 and x2, which meet the sheet at y1 and y2: the ranges do not matter. The residual of
the ring is (off(y2) - off(y1)) / 2 with off(y) = n . (y - m) - reach: how far the middle of its part on the sheet is
off. In motion each end has its own instant, R_scene_lidar = R_world_board^T R_world_lidar(t), and m is how far the
print is from the middle of the sheet, else 0.
Wide beams, and beams a little too high or low, shift both ends outwards or inwards alike, which cancels. An edge is
anywhere between two beams, so its crossing has the error of rounding. Rings of a sheet share it where the edge runs
along the columns of beams, or regularly across them. Errors of steps s that are known to differ by a share d of a step
have the covariance s^2 (1/12 - d (1 - d) / 2): the autocorrelation of the sawtooth. Scans in which the edges are within
a step of where they were share it, too: one of them counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import ClassVar, NamedTuple

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.detection.planes import PlaneSearch
from icalib.errors import EstimationError
from icalib.geometry.targets.base import BOARD
from icalib.model.bodies import Bodies
from icalib.model.sensor_model import Pass
from icalib.motion.factor import FactorKey, Into, RobustNoise, RowFactor, Whitened, add_rows, rows_by_recording
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import MERGED_WITHIN_S, assign_keyframes, instants, usable
from icalib.motion.sensor_pose import Kinematics, SensorPose, rows_at
from icalib.optim.arrowhead import Piece
from icalib.optim.rows import Rows
from icalib.optim.state import Key, Layout, State, in_recording
from icalib.rig.scene import SHEET_MIDDLE, TILT
from icalib.sensors.lidar.binning import LidarNoise, each_in_world
from icalib.sensors.lidar.residual import elevations, range_errors, true_ranges
from icalib.sensors.lidar.spec import RANGE_OFFSET, RANGE_SCALE

# Points nearer to the rim of the sheet are not used: their beams (some 3 mrad wide, 1 cm at 3 m) miss it in part.
RIM_M = 0.02
ON_BOARDS, ON_EDGES = "points on boards", "rings on boards"  # kinds of residuals
EDGE_GATE_M = 0.06  # largest distance from the outline of a point where a ring crosses it
MOST_SCANS = 300  # of a moving LiDAR whose edges are found: those of more hardly matter, see SHEET_MIDDLE
SIGMAS_PER_MAD = 1.4826  # standard deviation over median absolute deviation, Gaussian
GATE_SIGMAS = 4.0  # largest distance of a used point from its sheet, in standard deviations of the noise


@dataclass(frozen=True)
class BoardPoints:
    """Points of one LiDAR on planes of the target, sorted by keyframe. seconds (n,): since the first stamp, on the
    LiDAR's clock; xyz (n, 3) m; scan, keyframe (n,); body (n,): index of the body of the target. normal (n, 3), reach
    (n,) m: of the sheet or its edge, in the frame of the body; normal . x = reach there. step (n,): distance of beams
    across the edge [m]; 1 for points on sheets."""

    seconds: np.ndarray
    xyz: np.ndarray
    scan: np.ndarray
    keyframe: np.ndarray
    body: np.ndarray
    normal: np.ndarray
    reach: np.ndarray
    step: np.ndarray

    @classmethod
    def of(
        cls, stream: LidarStream, at: Pass, off_m: float, edge_m: float = EDGE_GATE_M
    ) -> tuple[BoardPoints, BoardPoints]:
        """Points on the sheets, none in motion; and points where rings cross their edges. off_m, edge_m: largest
        distances from a sheet and its outline, at the state of the pass."""
        bodies, (R, p) = at.bodies, at.bodies.poses(at.state.values)
        sheets, edges = [], []

        def see(cloud: _Cloud) -> None:
            for b in bodies.used if at.motion is None else bodies.used[:1]:
                y, outline = met_by_beams(*((x - p[b]) @ R[b] for x in cloud.seen)), bodies.target.outlines[b]
                if at.motion is None:
                    used = on_sheet(y, outline, -RIM_M, off_m)
                    plane = np.tile([0.0, 0.0, 1.0, 0.0, 1.0], (int(used.sum()), 1))
                    sheets.append((cloud.scan, b, cloud.measured[used], plane))
                if bodies.target.has_sheet[b]:
                    ends, plane = edge_points(cloud.measured, y, Gate(outline, off_m, edge_m))
                    edges.append((cloud.scan, b, ends, plane))

        if at.motion is None:
            _see_at_rest(stream, at.state, see)
        else:
            _see_in_motion(stream, at, see)
        return cls._joined(stream, at, sheets), cls._joined(stream, at, edges)

    @classmethod
    def _joined(
        cls, stream: LidarStream, at: Pass, parts: Sequence[tuple[int, int, np.ndarray, np.ndarray]]
    ) -> BoardPoints:
        """The points of parts (scan, body, `_Cloud.measured`, plane). Both ends of a ring share a keyframe."""
        each = [(np.tile([scan, b], (len(x), 1)), x, plane) for scan, b, x, plane in parts]
        none = np.zeros((0, 2), int), np.zeros((0, 4)), np.zeros((0, 5))
        places, x, plane = (np.concatenate(one) for one in zip(none, *each, strict=True))
        seconds, state = stream.seconds[places[:, 0]], at.state
        if at.motion is None:
            keyframe = _nearest_keyframe(instants(stream, state.values, seconds), state)
        else:
            seconds = seconds + x[:, 3]
            middle = np.repeat(seconds.reshape(-1, 2).mean(axis=1), 2)
            times, imu = instants(stream, state.values, middle), at.motion.imu
            keyframe = assign_keyframes("inertial", state.seconds, times, imu.forwards)
            keyframe[~usable(imu, times, at.motion.max_gap_s)] = -1
        order = np.lexsort((places[:, 0], keyframe))[np.count_nonzero(keyframe < 0) :]
        seconds, x, places, keyframe, plane = (one[order] for one in (seconds, x, places, keyframe, plane))
        edge = plane[:, :3], plane[:, 3], plane[:, 4]
        return cls(seconds, x[:, :3], places[:, 0], keyframe, places[:, 1], *edge)

    def as_beams_move(self) -> np.ndarray:
        """(n,) bool: ends of rings of scans in which both edges are a step of the beams or more away from where they
        were in the last such scan."""
        azimuth, kept = np.arctan2(self.xyz[:, 1], self.xyz[:, 0]), np.zeros(len(self.xyz), dtype=bool)
        per_step = np.hypot(self.xyz[:, 0], self.xyz[:, 1]) / self.step
        last = np.full(2, np.nan)
        for scan in np.split(np.arange(len(kept)), np.flatnonzero(np.diff(self.scan)) + 1):
            ends = np.angle(np.exp(1j * azimuth[scan]).reshape(-1, 2).sum(axis=0))
            steps = np.abs(np.angle(np.exp(1j * (ends - last)))) * per_step[scan].reshape(-1, 2).mean(axis=0)
            if not steps.min() < 1.0:
                kept[scan], last = True, ends
        return kept

    def some(self, kept: np.ndarray) -> BoardPoints:
        """The points selected by a mask (n,)."""
        return BoardPoints(*(getattr(self, f.name)[kept] for f in fields(self)))


class _Cloud(NamedTuple):
    """A scan. measured (n, 4): points m in the frame of the LiDAR, and their times s since the stamp; seen: points
    (n, 3) m and positions (n or 1, 3) m of the LiDAR in the frame of the scene."""

    scan: int
    measured: np.ndarray
    seen: tuple[np.ndarray, np.ndarray]


def _nearest_keyframe(times: np.ndarray, state: State) -> np.ndarray:
    """(n,) keyframe nearest to each time (n,) on the clock of the body."""
    return np.searchsorted(0.5 * (state.seconds[1:] + state.seconds[:-1]), times)


def _see_at_rest(stream: LidarStream, state: State, see: Callable[[_Cloud], None]) -> None:
    """Calls `see` with the scans at keyframes."""
    times = instants(stream, state.values)
    keyframe = _nearest_keyframe(times, state)
    for scan in np.flatnonzero(np.abs(times - state.seconds[keyframe]) <= MERGED_WITHIN_S).tolist():
        measured, k = _measured(stream, scan), keyframe[scan]
        origin = state.rotation[k] @ state.values[stream.name, "translation"] + state.position[k]
        points = in_scene(measured[:, :3], stream.name, np.full(len(measured), k), state)
        see(_Cloud(scan, measured, (points, origin[None])))


def _see_in_motion(stream: LidarStream, at: Pass, see: Callable[[_Cloud], None]) -> None:
    """Calls `see` with scans that have points on the sheet of the target, MOST_SCANS at most."""
    association, state = at.association, at.state
    on = association.plane[[x.name for x in at.rig.lidars].index(stream.name)] >= association.count
    before = np.concatenate([[0], np.cumsum(on)])[stream.start]
    seen = np.flatnonzero(np.diff(before) > 0)
    seen = seen[:: len(seen) // MOST_SCANS + 1]
    recording = np.searchsorted(state.starts, _nearest_keyframe(instants(stream, state.values), state), side="right")
    scans = stream.some(np.repeat(np.isin(np.arange(len(recording)), seen), np.diff(stream.start)))
    assert at.motion is not None

    def see_group(group: slice, points: np.ndarray, origins: np.ndarray) -> None:
        begin = scans.start[seen]
        for scan in seen[(begin >= group.start) & (begin < group.stop)].tolist():
            of_scan = slice(scans.start[scan] - group.start, scans.start[scan + 1] - group.start)
            R = state.values[in_recording(BOARD, int(recording[scan]) - 1), TILT.name]
            see(_Cloud(scan, _measured(scans, scan), (points[of_scan] @ R, origins[of_scan] @ R)))

    each_in_world(at.motion, true_ranges(scans, state), see_group)


def _measured(stream: LidarStream, scan: int) -> np.ndarray:
    """`_Cloud.measured` (n, 4) of a scan."""
    points = slice(stream.start[scan], stream.start[scan + 1])
    return np.column_stack([stream.xyz[points], stream.offset_s[points]]).astype(np.float64)


def in_scene(xyz: np.ndarray, lidar: str, keyframe: np.ndarray, state: State) -> np.ndarray:
    """(n, 3) points xyz (n, 3) m of a LiDAR, each at its `keyframe` (n,), in the frame of the scene."""
    v, (offset, scale) = state.values, range_errors(state, lidar)
    ratio = (1.0 - offset / np.linalg.norm(xyz, axis=1, keepdims=True)) / (1.0 + scale)
    on_body = ratio * xyz @ v[lidar, "rotation"].T + v[lidar, "translation"]
    return np.einsum("nij,nj->ni", state.rotation[keyframe], on_body) + state.position[keyframe]


def on_sheet(points: np.ndarray, outline: np.ndarray, margin_m: float, gate_m: float | np.ndarray) -> np.ndarray:
    """(n,) bool: points (n, 3) in the frame of a body inside the outline of its sheet, grown by margin_m."""
    xy, (low, high) = points[:, :2], outline
    inside = (xy > low - margin_m).all(axis=1) & (xy < high + margin_m).all(axis=1)
    return inside & (np.abs(points[:, 2]) < gate_m)


def met_by_beams(points: np.ndarray, origins: np.ndarray) -> np.ndarray:
    """(n, 3) x and y where beams from `origins` (n or 1, 3) to `points` (n, 3) meet the sheet z = 0, and the z of the
    points, all in the frame of a body; infinite for beams that do not meet it. Unlike the points themselves, the places
    do not have the noise of ranges, which moves points of oblique beams across the rim."""
    falls = (origins[:, 2] - points[:, 2]) * np.sign(origins[:, 2])
    share = np.where(falls > 0.0, np.abs(origins[:, 2]) / np.where(falls > 0.0, falls, 1.0), np.inf)
    out = np.where(np.isinf(share)[:, None], np.inf, origins + share[:, None] * (points - origins))
    out[:, 2] = points[:, 2]
    return out


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
END_POINTS = 3  # last points of a ring on the sheet, whose line gives the edge that it leaves, and when
MOST_GRAZING = 0.5  # cosine of the largest angle between a ring and the normal of the edge that it crosses: 60 deg
STEPS_BEYOND = 2.0  # steps between a crossing and the end of the field of view, from which the step itself is not known


@dataclass(frozen=True)
class Gate:
    """Which points of a cloud belong to a sheet of the given outline (2, 2). off_m: largest distance from it; edge_m:
    of a crossing from the outline."""

    outline: np.ndarray
    off_m: float
    edge_m: float = EDGE_GATE_M


def edge_points(measured: np.ndarray, met: np.ndarray, gate: Gate) -> tuple[np.ndarray, np.ndarray]:
    """Points and times (e, 4) of the beams on which rings cross the edges of a sheet, as in `measured`; and the edges
    (e, 5): outward normal in the frame of the body, its distance from the body's origin, and `BoardPoints.step`.
    measured (N, 4): points of a scan [m] in the frame of the LiDAR, and times [s] since its stamp; met (N, 3): see
    `met_by_beams`."""
    xyz = measured[:, :3]
    near = np.flatnonzero(on_sheet(met, gate.outline, gate.edge_m, np.inf))
    elevation = elevations(xyz[near])
    order = np.argsort(elevation)
    x, y = xyz[near, :2].sum(axis=0)
    azimuth = np.arctan2(x * xyz[:, 1] - y * xyz[:, 0], x * xyz[:, 0] + y * xyz[:, 1])
    rings = []
    for ring in np.split(near[order], np.flatnonzero(np.diff(elevation[order]) > RING_GAP_RAD) + 1):
        ends = _ends_of_ring(measured, met, azimuth, ring, gate)
        if ends is not None:
            rings.append(ends)
    ends = np.concatenate([np.zeros((0, 9)), *rings])
    return ends[:, :4], ends[:, 4:]


def _ends_of_ring(
    measured: np.ndarray, met: np.ndarray, azimuth: np.ndarray, ring: np.ndarray, gate: Gate
) -> np.ndarray | None:
    """Both ends (2, 9) of a ring on a sheet: point and edge as in `edge_points`; None if it has none."""
    hits = ring[on_sheet(met[ring], gate.outline, gate.edge_m, gate.off_m)]
    turn, order = np.unique(azimuth[hits], return_index=True)  # one of several returns of a beam
    hits = hits[order]
    if len(hits) < FEWEST_ON_RING or np.ptp(elevations(measured[hits])) > 2.0 * RING_GAP_RAD:
        return None  # a LiDAR without rings, or with rings that do not share an origin
    step = float(np.median(np.diff(turn)))
    if min(turn[0] - azimuth.min(), azimuth.max() - turn[-1]) < STEPS_BEYOND * step:
        return None  # the field of view ends there, and not the sheet
    both, ends = np.column_stack([met[hits, :2], measured[hits, 3]]), []
    for sign, end in ((-1.0, slice(0, END_POINTS)), (1.0, slice(-END_POINTS, None))):
        last = 0 if sign < 0.0 else -1
        slope, value = np.polyfit(turn[end] - turn[last] - 0.5 * sign * step, both[end], 1)
        edge = _edge(value[:2], sign * slope[:2] / np.linalg.norm(slope[:2]), gate)
        sooner = np.diff(both[end, 2]) < 0.0
        if edge is None or (sooner.any() and not sooner.all()):  # the turn of the LiDAR begins there
            return None
        x, y, z = measured[hits[last], :3]
        c, s = np.cos(0.5 * sign * step), np.sin(0.5 * sign * step)  # the beam half a step beyond, about the z axis
        ends.append([c * x - s * y, s * x + c * y, z, value[2], *edge, step * abs(edge[:2] @ slope[:2])])
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
        """The factors of a pass; in motion that of rings only. Raises EstimationError if at rest no point lies on a
        sheet."""
        points, edges = cls.seen(stream, noise, at)
        if at.motion is None:
            if not len(points.sigma):
                raise EstimationError(
                    f"{stream.name}: no point lies on the target; check that it is in the field of view of "
                    f"{stream.name}, and the extrinsics in the rig file."
                )
            yield replace(points, sigma=noise.inflation * noise.along * points.sigma)
        else:
            edges = edges.undisturbed(at.state)
        if len(edges.sigma):
            yield replace(edges, sigma=noise.edge_scale * edges.rounding(at.state))

    @classmethod
    def seen(
        cls, stream: LidarStream, noise: LidarNoise, at: Pass, edge_m: float = EDGE_GATE_M
    ) -> tuple[BoardFactor, BoardFactor]:
        """All points on sheets, none in motion, and all rings that cross their edges, at most edge_m [m] from there;
        standard deviations 1."""
        points, edges = BoardPoints.of(stream, at, GATE_SIGMAS * noise.along, edge_m)
        gravity = 0.0 if at.motion is None else at.motion.gravity
        common = noise, at.bodies, at.starts, len(at.state.seconds), at.layout, at.imu, gravity
        return (
            cls(stream.name, ON_BOARDS, points, np.ones(len(points.xyz)), *common),
            cls(stream.name, ON_EDGES, edges, np.ones(len(edges.xyz) // 2), *common),
        )

    def off(self, state: State) -> np.ndarray:
        """(m, 2) how far both ends of rings are beyond the edges of the sheet [m]."""
        return self.rows_of_points(slice(None), state, False)[0].residual.reshape(-1, 2)

    def undisturbed(self, state: State) -> BoardFactor:
        """The factor with rings that are as long as others, of scans between which the sheet moves by a step of the
        beams or more. Something beside or before an edge changes the length; the same beams have the same rounding."""
        if not len(self.sigma):
            return self
        growth = self.off(state).mean(axis=1)
        apart = np.abs(growth - np.median(growth))
        kept = np.repeat(apart <= GATE_SIGMAS * SIGMAS_PER_MAD * np.median(apart), 2)
        points = self.points.some(kept)
        points = points.some(points.as_beams_move())
        return replace(self, points=points, sigma=np.ones(len(points.xyz) // 2))

    def rounding(self, state: State) -> np.ndarray:
        """(m,) standard deviations [m] of the middles of rings by the steps between beams, as large as offset and slope
        of the rings of a sheet need them."""
        off, step = self.off(state), self.points.step.reshape(-1, 2)
        variance = np.empty_like(off)
        sheet = self.points.scan[::2] * len(self.bodies.target.bodies) + self.points.body[::2]
        for one in np.split(np.arange(len(off)), np.flatnonzero(np.diff(sheet)) + 1):
            phase = off[one] / step[one]
            shared = [_of_offset_and_slope(phase[:, end]) for end in range(2)]
            variance[one] = step[one] ** 2 / 12.0 * np.maximum(shared, 1.0)
        return 0.5 * np.sqrt(variance.sum(axis=1))

    def noise_sizes(self, out: Whitened, spent: float) -> tuple[float, float]:
        """Standard deviation of residuals about what fits those of each stop best, an offset and two tilts, in m or
        for rings in units of their rounding; and how many times larger it is in these offsets and tilts. This is above
        1 if errors of one stop correlate. spent: degrees of freedom of the residuals that the estimate takes up. These
        are of offsets and tilts, which alone poses of the target move (REML; Patterson and Thompson 1971)."""
        raw = out.residual[:, 0] * (self.noise.edge_scale if self.kind == ON_EDGES else self.sigma)
        root, xyz = out.root[:, 0], self.points.xyz[:: self.points_per_row]
        if self.kind == ON_BOARDS:  # where beams meet the sheet: noise moves points of oblique beams along it
            xyz = xyz * (1.0 - raw / np.linalg.norm(xyz, axis=1))[:, None]
        squares, planes, n = np.zeros(2), 0, 0
        scan = self.points.scan[:: self.points_per_row]
        for stop in np.split(np.arange(len(raw)), np.flatnonzero(np.diff(scan)) + 1):
            x = xyz[stop] - xyz[stop].mean(axis=0)
            axes = np.linalg.svd(x, full_matrices=False)[2][:2]
            basis, _ = np.linalg.qr(root[stop, None] * np.column_stack([np.ones(len(x)), x @ axes.T]))
            weighted = root[stop] * raw[stop]
            along = basis.T @ weighted
            squares += along @ along, weighted @ weighted - along @ along
            planes, n = planes + basis.shape[1], n + max(len(x) - basis.shape[1], 0)
        sigma = float(np.sqrt(squares[1] / max(n, 1)))
        return sigma, max(1.0, float(np.sqrt(squares[0] / max(planes - spent, 1.0))) / max(sigma, 1e-9))

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

    def _columns(self, recording: int) -> np.ndarray:
        """Calibration columns of the LiDAR's pose, offset and scale of its ranges, tilt of the target and middle of its
        sheet, and the poses of all bodies."""
        ranges = ((self.name, spec.name) for spec in (RANGE_OFFSET, RANGE_SCALE))
        keys = *ranges, self._tilt(recording), self._middle
        each = [self.layout.columns(*k) if self.layout.has(*k) else np.full(2, -1) for k in keys]
        poses, _ = self.bodies.columns(self.layout)
        return np.concatenate([Kinematics.of(self).columns(recording), *each, poses.ravel()])

    @property
    def _middle(self) -> Key:
        """The middle of the sheet of the reference body, the only one in use in motion; at rest it is not estimated."""
        return self.bodies.names[0], SHEET_MIDDLE.name

    def _tilt(self, recording: int) -> Key:
        """The attitude of the target in a recording; at rest all recordings share it."""
        return in_recording(BOARD, 0 if self.imu is None else recording), TILT.name

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
        for recording, block in rows_by_recording(self.keyframe, self.starts, self.n_keyframes, piece):
            rows, _ = self.rows_of_points(slice(step * block.start, step * block.stop), state, sums)
            if self.kind == ON_EDGES:
                rows = Rows(*(0.5 * (x[1::2] - x[::2]) for x in rows))
            interval = rows.on_intervals(self.keyframe[block], self.n_keyframes)
            noise = RobustNoise(1.0 / self.sigma[block][:, None, None], self.noise.loss, self.noise.loss_scale)
            total += add_rows(rows, block, interval, self._columns(recording), noise, into)
        return total

    def rows_of_points(self, block: slice, state: State, jacobians: bool) -> tuple[Rows, np.ndarray]:
        """Residuals of the points `block` and their Jacobians; and cosines (n,) of the beams with the normals of the
        sheets."""
        p, on_boards = self.points, self.kind == ON_BOARDS
        at = SensorPose.at(Kinematics.of(self), p.seconds[block], p.keyframe[block], state, jacobians)
        m, normal = self._meetings(block, state, at), p.normal[block]
        residual = m.along / m.per_unit if on_boards else (normal * m.y).sum(axis=1) - p.reach[block]
        residual = residual - normal[:, :2] @ state.values[self._middle]  # along a sheet, not off it
        if not jacobians:
            return Rows(residual[:, None], np.zeros((0, 1, 0))), m.cosine
        # The derivative is that of the distance of this point from the plane through the beam and the edge; for points
        # on the sheet, from the sheet, over the cosine, as the LiDAR measures lengths: its noise has no other scale.
        z = np.array([0.0, 0.0, 1.0]) / (m.cosine * m.per_unit)[:, None]
        of_body = z if on_boards else normal - (normal * m.ray).sum(axis=1, keepdims=True) * m.per_unit * z
        in_lidar, in_world = (np.einsum("nij,nj->ni", R, of_body) for R in (m.R_lidar_body, m.R_world_body))
        J_further = np.zeros((len(residual), 1, N_FURTHER + self.bodies.columns(self.layout)[0].size))
        J_further[:, 0, 0] = -(in_lidar * m.beam).sum(axis=1) * m.per_unit
        J_further[:, 0, 1] = J_further[:, 0, 0] * m.distance + (m.along if on_boards else 0.0)
        J_further[:, 0, 2:4] = np.cross(in_world, m.in_world)[:, :2]
        J_further[:, 0, 4:6] = -normal[:, :2]
        if self.bodies.several:
            in_scene = np.einsum("nij,nj->ni", self.bodies.poses(state.values)[0][p.body[block]], of_body)
            J_body = np.concatenate([np.cross(of_body, m.y), -in_scene], axis=1)
            of_poses = N_FURTHER + 6 * p.body[block][:, None] + np.arange(6)
            J_further[np.arange(len(J_body))[:, None], 0, of_poses] = J_body
        J_pose = np.concatenate([np.cross(m.x, in_lidar), in_lidar], axis=1)[:, None, :]
        return rows_at(residual[:, None], (J_pose,), (at,), J_further), m.cosine

    def _meetings(self, block: slice, state: State, at: SensorPose) -> _Meetings:
        """Where beams of the points `block` meet the sheets. at: poses of the LiDAR at the instants of the points."""
        p, (R, origin) = self.points, self.bodies.poses(state.values)
        x, body = p.xyz[block], p.body[block]
        boards = np.array([state.values[self._tilt(k)] for k in range(len(self.starts))])
        R_world_scene = boards[np.searchsorted(self.starts, p.keyframe[block], side="right") - 1]
        R_world_body = R_world_scene @ R[body]
        to_body, turned = partial(np.einsum, "nij,ni->nj", R_world_body), partial(np.einsum, "nij,nj->ni")
        body_in_world = turned(R_world_scene, origin[body])
        beam, (offset, scale) = x / np.linalg.norm(x, axis=1, keepdims=True), range_errors(state, self.name)
        x = (x - offset * beam) / (1.0 + scale)
        distance = np.linalg.norm(x, axis=1)
        world, ray = turned(at.rotation, x) + at.position, to_body(turned(at.rotation, beam))
        along = to_body(world - body_in_world)[:, 2] / ray[:, 2]
        x, world = x - along[:, None] * beam, world - along[:, None] * turned(at.rotation, beam)
        R_lidar_body = np.einsum("nji,njk->nik", at.rotation, R_world_body)
        y = to_body(world - body_in_world)
        return _Meetings(
            beam, x, world, y, ray, along, ray[:, 2], R_lidar_body, R_world_body, distance, 1.0 / (1.0 + scale)
        )


N_FURTHER = 6  # columns of a row after those of the pose: offset and scale of ranges, tilt, middle of the sheet


class _Meetings(NamedTuple):
    """Where n beams meet sheets: x, in_world, y (n, 3) m in the frames of the LiDAR, the world and the body; beam, ray
    (n, 3) unit vectors in those of the LiDAR and the body; along (n,) m: of the points behind it; cosine (n,): of beams
    with the normals; distance (n,) m: true range of the points; per_unit: their derivative by the measured one."""

    beam: np.ndarray
    x: np.ndarray
    in_world: np.ndarray
    y: np.ndarray
    ray: np.ndarray
    along: np.ndarray
    cosine: np.ndarray
    R_lidar_body: np.ndarray
    R_world_body: np.ndarray
    distance: np.ndarray
    per_unit: float
