"""Estimated quantities: inertial states at the keyframes, and the calibration parameters.

A keyframe is (R_world_imu, p, v, b_g, b_a): 15 tangent dimensions in this order (iCalib paper (2)). Each further IMU
adds nine: its velocity relative to the first IMU, and its biases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from icalib.geometry import planes, so3
from icalib.geometry.planes import tangents

KEYFRAME_DIM = 15  # tangent dimensions of a keyframe with one IMU
FURTHER_IMU_DIM = 9  # those that each further IMU adds
POSE_DIM = 6  # of these, rotation and position
Key = tuple[str, str]  # sensor (or body, plane, frame), name of the parameter
Kind = Literal["vector", "nuisance", "rotation", "tilt", "plane"]
Entry = tuple[str, str, Kind, int, bool]  # sensor, name, kind, size, whether it is estimated


def in_recording(name: str, recording: int) -> str:
    """Key prefix of a quantity that each recording has separately, such as the attitude of the target; `recording`
    counts from 0."""
    return name if recording == 0 else f"{name} in recording {recording + 1}"


@dataclass(frozen=True)
class Block:
    """One group of calibration parameters. kind: its perturbation; start: its first calibration column, None if fixed.

    rotation: R <- R Exp(d). tilt (2 columns): R_world_board <- Exp((d0, d1, 0)) R_world_board; the rotation about
    gravity is the gauge freedom of the world frame. plane (3 columns): see `geometry.planes.moved`. vector, nuisance:
    addition.
    """

    sensor: str
    name: str
    kind: Kind
    size: int
    start: int | None

    @property
    def key(self) -> Key:
        return self.sensor, self.name

    @property
    def columns(self) -> np.ndarray:
        """(size,) calibration columns, -1 where fixed."""
        return np.full(self.size, -1) if self.start is None else np.arange(self.start, self.start + self.size)

    @property
    def is_nuisance(self) -> bool:
        """True for imperfections of a sensor or target, which a proper prior always bounds."""
        return self.kind == "nuisance"


@dataclass(frozen=True)
class Layout:
    """Order of the calibration parameters, and their columns in the normal equations. further_imus: names of the IMUs
    after the first, in the order of their states in a keyframe. shows_places: whether any measurement depends on the
    place of the body, so that its path is more than dead reckoning."""

    blocks: tuple[Block, ...]
    further_imus: tuple[str, ...] = ()
    shows_places: bool = True

    @property
    def size(self) -> int:
        """B, the number of calibration columns."""
        return sum(b.size for b in self.blocks if b.start is not None)

    @property
    def keyframe_dim(self) -> int:
        """D, the tangent dimensions of a keyframe."""
        return KEYFRAME_DIM + FURTHER_IMU_DIM * len(self.further_imus)

    @property
    def free(self) -> tuple[Block, ...]:
        """Blocks that are estimated."""
        return tuple(b for b in self.blocks if b.start is not None)

    @property
    def essential(self) -> np.ndarray:
        """Columns of all estimated parameters but nuisance parameters."""
        return np.concatenate([np.arange(0), *(b.columns for b in self.free if not b.is_nuisance)])

    def block(self, sensor: str, name: str) -> Block:
        """The block with this key. Raises StopIteration if there is none."""
        return next(b for b in self.blocks if b.key == (sensor, name))

    def has(self, sensor: str, name: str) -> bool:
        """Whether there is a block with this key."""
        return any(b.key == (sensor, name) for b in self.blocks)

    def is_free(self, sensor: str, name: str) -> bool:
        """Whether the block is estimated."""
        return self.block(sensor, name).start is not None

    def columns(self, sensor: str, *names: str) -> np.ndarray:
        """Calibration columns of the blocks `names` of `sensor`, in this order; -1 where fixed."""
        return np.concatenate([self.block(sensor, n).columns for n in names])


def make_layout(entries: list[Entry], further_imus: Sequence[str] = ()) -> Layout:
    """Layout of the entries in their order; estimated ones get consecutive calibration columns. further_imus: see
    `Layout`."""
    blocks, column = [], 0
    for sensor, name, kind, size, estimated in entries:
        blocks.append(Block(sensor, name, kind, size, column if estimated else None))
        column += size if estimated else 0
    return Layout(tuple(blocks), tuple(further_imus))


# Weight of the first keyframe's rotation against planes (weight 1) or positions (1 m^2): decides only where these are
# degenerate.
FIRST_KEYFRAME_WEIGHT = 1e-4


@dataclass(frozen=True)
class State:
    """One estimate of trajectory and calibration. seconds (K,): keyframe times on the IMU clock since its first stamp;
    world frame z up.

    starts: first keyframe of each recording. Each recording has its own world frame, whose origin is the target's.
    further_imus (K, 9 n), for each of n IMUs after the first: its velocity relative to the first IMU, in the axes of
    the first [m/s], and its biases as in `bias`.
    """

    seconds: np.ndarray
    rotation: np.ndarray  # (K, 3, 3) R_world_imu
    position: np.ndarray  # (K, 3) p_world_imu [m]
    velocity: np.ndarray  # (K, 3) world [m/s]
    bias: np.ndarray  # (K, 6) gyroscope [rad/s], accelerometer [m/s^2]
    values: dict[Key, np.ndarray]
    starts: tuple[int, ...] = (0,)
    further_imus: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        if not self.further_imus.size:
            object.__setattr__(self, "further_imus", np.zeros((len(self.seconds), 0)))

    @property
    def recording(self) -> np.ndarray:
        """(K,) number of the recording of each keyframe."""
        return np.repeat(np.arange(len(self.starts)), np.diff((*self.starts, len(self.seconds))))

    @property
    def recordings(self) -> list[slice]:
        """Slice of the keyframes of each recording."""
        return [slice(a, b) for a, b in pairwise((*self.starts, len(self.seconds)))]

    def retract(self, layout: Layout, chain: np.ndarray, calib: np.ndarray) -> State:
        """The state moved by tangent steps chain (K, D) and calib (B,).

        A tilt of the target rotates the trajectory of its recording with it, exactly. Steps of the keyframes are
        relative to this rotation, and are rotated too. To first order this equals the plain retraction. If gravity is
        weakly observable, the tilt is large compared with the precision of positions relative to the target. The plain
        retraction would then violate the geometry by tilt^2 / 2. Without a target, planes and trajectory rotate by
        their common rotation.
        """
        turns = self._turns(layout, chain, calib)
        values = self.values | {b.key: self._moved(b, calib[b.columns], turns[0]) for b in layout.free}
        R, p, v = np.empty_like(self.rotation), np.empty_like(self.position), np.empty_like(self.velocity)
        for turn, k in zip(turns, self.recordings, strict=True):
            Q = so3.exp(turn)
            d_rotation = np.ascontiguousarray(chain[k, 0:3] - turn @ self.rotation[k])
            d_position = chain[k, 3:6] - np.cross(turn, self.position[k])
            d_velocity = chain[k, 6:9] - np.cross(turn, self.velocity[k])
            R[k] = Q @ self.rotation[k] @ so3.exp_many(d_rotation)
            p[k] = (self.position[k] + d_position) @ Q.T
            v[k] = (self.velocity[k] + d_velocity) @ Q.T
        moved = replace(self, rotation=R, position=p, velocity=v, values=values)
        further = self.further_imus + chain[:, KEYFRAME_DIM:]
        return replace(moved, bias=self.bias + chain[:, 9:KEYFRAME_DIM], further_imus=further)

    def _turns(self, layout: Layout, chain: np.ndarray, calib: np.ndarray) -> list[np.ndarray]:
        """Rotation vector (3,) of each recording's world in world axes [rad]. Zero for several recordings without a
        target, which share planes, and where nothing shows places."""
        tilts = [np.append(calib[b.columns], 0.0) for b in layout.free if b.kind == "tilt"]
        if tilts:
            return tilts
        if len(self.starts) == 1 and layout.shows_places:
            return [self._common_turn(layout, chain, calib)]
        return [np.zeros(3)] * len(self.starts)

    def _common_turn(self, layout: Layout, chain: np.ndarray, calib: np.ndarray) -> np.ndarray:
        """Rotation vector (3,) [rad, world axes] common to all planes in this step, by least squares; without planes,
        of the positions about their mean.

        Unobservable directions, such as the axis of a straight path, follow the first keyframe. On a flat floor all
        sensors can rotate against the IMU: then map and trajectory rotate, and the attitudes of the keyframes do not.
        """
        free = [b for b in layout.free if b.kind == "plane"]
        if free:
            x = np.array([self.values[b.key][:3] for b in free])
            displacement = np.array([calib[b.columns[:2]] @ planes.tangents(n) for b, n in zip(free, x, strict=True)])
        else:
            x, displacement = self.position - self.position.mean(axis=0), chain[:, 3:6] - chain[:, 3:6].mean(axis=0)
        spread = (x.T @ x) / len(x)
        A = np.trace(spread) * np.eye(3) - spread + FIRST_KEYFRAME_WEIGHT * np.eye(3)
        torque = np.cross(x, displacement).mean(axis=0)
        return np.linalg.solve(A, torque + FIRST_KEYFRAME_WEIGHT * (self.rotation[0] @ chain[0, 0:3]))

    def _moved(self, block: Block, d: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Value of `block` moved by `d`, in a world that rotates by `turn` (3,)."""
        old = self.values[block.key]
        if block.kind == "rotation":
            return old @ so3.exp(d)
        if block.kind == "tilt":
            return so3.exp(np.append(d, 0.0)) @ old
        return planes.moved_and_turned(old, d, turn) if block.kind == "plane" else old + d


# Planes of the scene as arrays for compiled kernels.


def plane_value(value: np.ndarray) -> np.ndarray:
    """Plane (6,), normal and point, of the value of a plane, or of a tilt R_world_board (3, 3): z = 0 of the board."""
    return value if value.ndim == 1 else np.concatenate([value[:, 2], np.zeros(3)])


NO_RINGS = np.zeros(0)


class Planes(NamedTuple):
    """P planes in the world: unit normal (P, 3), its derivatives (P, 2, 3) by the first two parameters, and a point
    (P, 3) on each [m]. columns (P, 3 or 5 + K): calibration columns, -1 where fixed. The third parameter is the
    distance. The others are offset and scale of the ranges of a LiDAR, and K errors of its rings.

    Points x of the LiDAR become (x - range_offset x / |x|) / (1 + range_scale): what is left of both errors since the
    pass began. range_unit: derivative of both by the parameters, 1 / (1 + scale at the start). rings (K,): what is
    left of those of rings.
    """

    normal: np.ndarray
    tangents: np.ndarray
    point: np.ndarray
    columns: np.ndarray
    range_offset: float
    range_scale: float
    range_unit: float
    rings: np.ndarray

    @classmethod
    def of(
        cls,
        keys: tuple[Key, ...],
        state: State,
        columns: np.ndarray,
        ranges: tuple[float, float, float] = (0.0, 0.0, 1.0),
        rings: np.ndarray = NO_RINGS,
    ) -> Planes:
        """Planes, or tilts of the target, with the keys `keys` and their values in `state`. A tilt turns its plane
        about x and y of the world. ranges: offset, scale and unit; rings (K,): their errors."""
        value = np.array([plane_value(state.values[key]) for key in keys])
        across = np.array(
            [
                tangents(v[:3]) if state.values[key].ndim == 1 else np.cross(np.eye(3)[:2], v[:3])
                for key, v in zip(keys, value, strict=True)
            ]
        )
        return cls(value[:, :3].copy(), across, value[:, 3:].copy(), columns, *ranges, rings)
