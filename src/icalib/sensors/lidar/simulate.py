"""Simulated LiDARs: points of the room and its boards, each measured from the pose of the sensor at its instant."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.base.yaml_nodes import YamlValue
from icalib.data.measurements import LidarStream
from icalib.errors import RigError
from icalib.sensors.lidar.spec import (
    N_RINGS,
    RANGE_OFFSET,
    RANGE_SCALE,
    RING_AZIMUTHS,
    RING_ELEVATIONS,
    RING_OFFSETS,
    Lidar,
)
from icalib.sensors.parameter import Parameter
from icalib.tools.simulation.output import BagWriter
from icalib.tools.simulation.room import Room, RoomSurfaces, nearest
from icalib.tools.simulation.scenario import (
    BagEvent,
    BagTopic,
    Report,
    SimRecord,
    SimScene,
    SimSensor,
    TrueParameters,
    at_least,
    interval,
    limited,
    mounted_fields,
    true_ratio,
)
from icalib.tools.simulation.trajectory import LEAD_S, Drive, TrueTrajectory, stamped

_FIRING_S = 2.304e-6  # between the firings of two lasers of a column (Velodyne VLP-16 manual)
_CLOUD_MESSAGE = "sensor_msgs/msg/PointCloud2"
EXACT = Parameter("fixed", np.zeros(1))  # ranges, for the rig file
MAX_OFFSET_M = 0.5  # of ranges; that of real LiDARs is some centimetres
_FLOAT32 = 7  # datatype of sensor_msgs/PointField


def _numbers(value: YamlValue) -> tuple[float, ...]:
    return tuple(x.number() for x in value.items())


@dataclass(frozen=True, eq=False)
class SimLidar(SimSensor):
    """True parameters of one LiDAR that spins counterclockwise about its z axis.

    A scan is one turn of azimuth_steps columns with `rings` points, at elevations evenly over elevation_deg. The lasers
    of a column fire 2.304 us apart, or faster if a column is shorter. The stamp of a scan is the instant of its first
    column. Points outside range_m are missing. Noise is along the beam. scale: ratio of true to reported ranges.
    range_offset_m: reported less true ranges; ring_offsets_m: of each ring, in addition. elevation_errors_deg,
    azimuth_errors_deg: true less reported angles of each ring.
    """

    sensor_type: ClassVar[str] = "lidar"
    random_stream: ClassVar[int] = 1000
    measures: ClassVar[str] = "scans"
    effects: ClassVar = {
        RANGE_SCALE.name: ("scale", true_ratio),
        RANGE_OFFSET.name: ("range_offset_m", lambda value: limited(value, MAX_OFFSET_M)),
        RING_OFFSETS.name: ("ring_offsets_m", lambda value: tuple(limited(x, MAX_OFFSET_M) for x in value.items())),
        RING_ELEVATIONS.name: ("elevation_errors_deg", _numbers),
        RING_AZIMUTHS.name: ("azimuth_errors_deg", _numbers),
    }

    rate_hz: float = 8.0
    rings: int = 16
    azimuth_steps: int = 1800
    elevation_deg: tuple[float, float] = (-15.0, 15.0)
    range_m: tuple[float, float] = (0.3, 100.0)
    range_noise_m: float = 0.03
    scale: float = 1.0
    range_offset_m: float = 0.0
    ring_offsets_m: tuple[float, ...] = (0.0,)
    elevation_errors_deg: tuple[float, ...] = (0.0,)
    azimuth_errors_deg: tuple[float, ...] = (0.0,)

    @classmethod
    def parse(cls, name: str, value: YamlValue, start_ns: int) -> SimLidar:
        options = ("rings", "azimuth_steps", "elevation_deg", "range", "noise")
        fields, common = mounted_fields(value, start_ns, options=options)
        chosen: dict[str, Any] = {key: fields[key].whole(1) for key in ("rings", "azimuth_steps") if key in fields}
        if "elevation_deg" in fields:
            chosen["elevation_deg"] = interval(fields["elevation_deg"])
        if "range" in fields:
            chosen["range_m"] = interval(fields["range"])
        if "noise" in fields:
            chosen["range_noise_m"] = at_least(fields["noise"], 0.0)
        return cls(name, **common, **chosen)

    def check(self, room: Room | None, drive: Drive | None) -> None:
        if room is None:
            raise RigError(f"{self.name} needs a room; give the scenario one.")
        of_rings = {"elevation errors": self.elevation_errors_deg, "azimuth errors": self.azimuth_errors_deg}
        for what, errors in (of_rings | {"ring offsets": self.ring_offsets_m}).items():
            if (n := len(errors)) not in (1, self.rings):
                raise RigError(f"{self.name} has {self.rings} rings, but {n} {what}; give one for each ring.")

    def true_parameters(self) -> TrueParameters:
        true = {RANGE_SCALE.name: 1.0 / self.scale - 1.0, RANGE_OFFSET.name: self.range_offset_m}
        values = {name: np.array([value]) for name, value in true.items() if value}
        if any(self.elevation_errors_deg):
            off_deg = np.broadcast_to(self.elevation_errors_deg, self.rings)
            bands = np.rint(np.linspace(0.0, N_RINGS - 1.0, self.rings)).astype(int)  # the mean of several rings
            mean_deg = np.bincount(bands, off_deg, N_RINGS) / np.maximum(np.bincount(bands, minlength=N_RINGS), 1)
            values[RING_ELEVATIONS.name] = np.deg2rad(mean_deg)
        against = {RING_OFFSETS.name: self.ring_offsets_m, RING_AZIMUTHS.name: np.deg2rad(self.azimuth_errors_deg)}
        return TrueParameters(values, {name: list(map(float, of)) for name, of in against.items() if any(of)})

    @property
    def points(self) -> int:
        """Largest number of points in a scan."""
        return self.rings * self.azimuth_steps

    def report(self, scene: SimScene, seed: list[int], progress: Callable[[float], None]) -> Report:
        """All scans. The noise of each scan has its own random stream."""
        assert scene.room is not None  # ensured by `check`
        stamps, seconds = stamped(self, scene.duration_s - LEAD_S - 1.0 / self.rate_hz)
        noise_m = self.range_noise_m * float(scene.noisy)
        start = np.zeros(len(stamps) + 1, dtype=np.int64)
        xyz = np.empty((len(stamps) * self.points, 3), dtype=np.float32)  # unused memory pages are never allocated
        offset, plane = np.empty(len(xyz), dtype=np.float32), np.empty(len(xyz), dtype=np.int32)
        column_s = 1.0 / (self.rate_hz * self.azimuth_steps)
        surfaces = scene.room.surfaces_with(scene.sheets)
        for i, begin in enumerate(seconds):
            noise = noise_m * np.random.default_rng([*seed, i]).standard_normal((self.azimuth_steps, self.rings))
            turn = _turn(self, scene.trajectory, begin, noise)
            free = slice(start[i], None)
            into = _Points(xyz[free], offset[free], plane[free])
            start[i + 1] = start[i] + _fill_points(surfaces, turn, column_s, into)
            progress((i + 1) / len(seconds))
        n = start[-1]
        plane[:n][plane[:n] >= len(scene.room.faces)] = -1  # boards are no planes of the room
        late = offset[:n] / (1.0 + 1e-6 * self.clock_rate_ppm)
        return Report(LidarStream(self.name, stamps, start, late, xyz[:n], plane[:n]))

    def rig_entry(self) -> Lidar:
        near, far = self.range_m
        path = f"{self.name}/scans.npz"
        return Lidar(self.name, path, self.range_noise_m, min_range_m=near, max_range_m=far, range_scale=EXACT)

    def record(self, stream: LidarStream, offset_ns: int) -> SimRecord:
        """Arrays, and PointCloud2 with x, y, z [m] and `time` [s] since the stamp."""
        topic = BagTopic(f"/{self.name}/points", _CLOUD_MESSAGE, _clouds(stream, offset_ns))
        return SimRecord(partial(_write_scans, stream), topic)


SIMULATED = SimLidar


def _write_scans(stream: LidarStream, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {name: getattr(stream, name) for name in ("stamps_ns", "start", "offset_s", "xyz", "plane")}
    np.savez(folder / "scans.npz", **arrays)


def _clouds(lidar: LidarStream, offset_ns: int) -> Iterator[BagEvent]:
    """Messages of all scans, each at the instant of its last point."""
    for i, stamp_ns in enumerate(lidar.stamps_ns.tolist()):
        points = slice(lidar.start[i], lidar.start[i + 1])
        xyz, offset_s = lidar.xyz[points], lidar.offset_s[points]
        lasted_ns = int(offset_s[-1] * 1e9) if len(offset_s) else 0
        yield (
            stamp_ns + offset_ns + lasted_ns,
            lambda bag, stamp_ns=stamp_ns, xyz=xyz, offset_s=offset_s: _cloud(bag, stamp_ns, lidar.name, xyz, offset_s),
        )


def _cloud(bag: BagWriter, stamp_ns: int, frame: str, xyz: np.ndarray, offset_s: np.ndarray) -> Any:
    """PointCloud2 message of points xyz (N, 3) [m] with times offset_s (N,) since the stamp, all float32."""
    names = ("x", "y", "z", "time")
    fields = [bag.make("sensor_msgs/msg/PointField", name, 4 * i, _FLOAT32, 1) for i, name in enumerate(names)]
    rows = np.ascontiguousarray(np.column_stack([xyz, offset_s]), dtype="<f4")
    data, size = rows.view(np.uint8).reshape(-1), 4 * len(names)
    header = bag.header(stamp_ns, frame)
    return bag.make(_CLOUD_MESSAGE, header, 1, len(rows), fields, False, size, size * len(rows), data, True)


class _Turn(NamedTuple):
    """One revolution with A columns of K lasers, and world poses at the start of each column and at the end."""

    rotation: np.ndarray  # (A + 1, 3, 3) R_world_lidar
    position: np.ndarray  # (A + 1, 3)
    beam: np.ndarray  # (A, K, 3) unit directions in the LiDAR's frame
    firing: np.ndarray  # (K,) instants as a share of a column
    noise: np.ndarray  # (A, K) m, with the offset of ranges
    range_m: tuple[float, float]
    scale: float
    reported: np.ndarray  # (A, K, 3) as beam, that the points of the beams have


class _Points(NamedTuple):
    """Arrays for the points of one revolution, at most A K: xyz (n, 3) [m], offset_s (n,), plane (n,)."""

    xyz: np.ndarray
    offset_s: np.ndarray
    plane: np.ndarray


def _turn(lidar: SimLidar, trajectory: TrueTrajectory, begin: float, noise: np.ndarray) -> _Turn:
    """The revolution that begins at `begin` [s], with range noise (A, K) [m]."""
    steps, rings = lidar.azimuth_steps, lidar.rings
    column_s = 1.0 / (lidar.rate_hz * steps)
    rotation, position, _ = trajectory.pose_at(begin + column_s * np.arange(steps + 1))
    firing = np.arange(rings) * min(_FIRING_S / column_s, 1.0 / rings)
    return _Turn(
        rotation @ lidar.T_imu_sensor[:3, :3],
        position + rotation @ lidar.T_imu_sensor[:3, 3],
        _beams(lidar, np.array(lidar.elevation_errors_deg), np.array(lidar.azimuth_errors_deg)),
        firing,
        lidar.range_offset_m + np.array(lidar.ring_offsets_m) + noise,
        lidar.range_m,
        lidar.scale,
        _beams(lidar),
    )


def _beams(lidar: SimLidar, off_deg: np.ndarray | float = 0.0, turn_deg: np.ndarray | float = 0.0) -> np.ndarray:
    """(A, K, 3) unit directions in the LiDAR's frame. off_deg, turn_deg: added to elevation and azimuth of each
    ring."""
    azimuth = 2.0 * np.pi * np.arange(lidar.azimuth_steps)[:, None] / lidar.azimuth_steps + np.deg2rad(turn_deg)
    elevation = np.deg2rad(np.linspace(*lidar.elevation_deg, lidar.rings) + off_deg)
    level, up = np.cos(elevation), np.sin(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up + 0.0 * azimuth], axis=2)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_points(surfaces: RoomSurfaces, turn: _Turn, column_s: float, points: _Points) -> int:
    """Fills the points in the order of their instants. Returns their number.

    Within a column of some 0.1 ms the pose is interpolated linearly: wrong by 1e-8 m and rad at 5 m/s^2 and 2 rad/s.
    """
    count = 0
    d, p = np.empty(3), np.empty(3)
    for a in range(len(turn.beam)):
        R0, R1, p0, p1 = turn.rotation[a], turn.rotation[a + 1], turn.position[a], turn.position[a + 1]
        for k in range(len(turn.firing)):
            s, x, y, z = turn.firing[k], turn.beam[a, k, 0], turn.beam[a, k, 1], turn.beam[a, k, 2]
            for i in range(3):
                before = R0[i, 0] * x + R0[i, 1] * y + R0[i, 2] * z
                after = R1[i, 0] * x + R1[i, 1] * y + R1[i, 2] * z
                d[i] = before + s * (after - before)
                p[i] = p0[i] + s * (p1[i] - p0[i])
            distance, face = nearest(surfaces, p[0], p[1], p[2], d[0], d[1], d[2])
            if not (turn.range_m[0] <= distance <= turn.range_m[1]):
                continue
            measured = distance / turn.scale + turn.noise[a, k]
            for i in range(3):
                points.xyz[count, i] = measured * turn.reported[a, k, i]
            points.offset_s[count] = (a + s) * column_s
            points.plane[count] = face
            count += 1
    return count
