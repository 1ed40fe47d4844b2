"""Trajectories of a wheel frame on a floor, in closed form: z is normal to the floor, and its velocity is along x."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from icalib.tools.simulation.motion import readings_of
from icalib.tools.simulation.room import Hills, Room
from icalib.tools.simulation.trajectory import Drive, Jet, Rows, cross, matrices, unit, values

# Function of time: x, y of the wheel frame's origin, and x, y of its heading as a vector of any length.
Path = Callable[[Jet], tuple[Jet, Jet, Jet, Jet]]
_LAP_S = 24.0
_LAP_SHARE = 0.27  # half axes of a lap, relative to the room's sides
_SPEED, _RADIUS_M = 0.5, 1.8  # m/s; of an arc
_WANDER_M = np.array([0.30, 0.05])  # amplitudes, slow and fast, of deviations from the lap: small enough not to stop
_WANDER_HZ = np.array([[0.06, 0.10], [0.25, 0.35]])
_SLIP_HZ = np.array([[0.5, 0.8], [1.4, 2.0]])


@dataclass(frozen=True, eq=False)
class GroundMotion:
    """Trajectory of an IMU that is fixed to a wheel frame, which follows `path` on the floor."""

    path: Path
    hills: Hills | None
    T_wheel_imu: np.ndarray
    sideslip: Callable[[Jet], Jet] | None  # angle [rad] by which the frame is turned out of its direction

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `Trajectory.pose_at`."""
        R_wheel, p_wheel = self._wheel(Jet.time(seconds, 2))
        R, lever = self.T_wheel_imu[:3, :3], self.T_wheel_imu[:3, 3]
        rotation = matrices(R_wheel, 0)
        position = values(p_wheel, 0) + rotation @ lever
        return rotation @ R, position, values(p_wheel, 1) + matrices(R_wheel, 1) @ lever

    def readings_at(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 6) true angular rate [rad/s] and specific force [m/s^2] in the IMU frame."""
        R_wheel, p_wheel = self._wheel(Jet.time(seconds, 3))
        R, lever = self.T_wheel_imu[:3, :3], self.T_wheel_imu[:3, 3]
        acceleration = values(p_wheel, 2) + matrices(R_wheel, 2) @ lever
        return readings_of(matrices(R_wheel, 0) @ R, matrices(R_wheel, 1) @ R, acceleration)

    def rate_at(self, seconds: np.ndarray) -> np.ndarray:
        """See `Trajectory.rate_at`."""
        return self.readings_at(seconds)[:, :3]

    def _wheel(self, time: Jet) -> tuple[Rows, tuple[Jet, Jet, Jet]]:
        """R_world_wheel by rows, and p_world_wheel [m]; the order of the rotation is lower by one than that of
        `time`."""
        x, y, dx, dy = self.path(time)
        if self.sideslip is not None:
            sine, cosine = self.sideslip(time.shortened(len(dx.c) - 1)).sine_cosine()
            dx, dy = cosine * dx - sine * dy, sine * dx + cosine * dy
        z, slope_x, slope_y = _floor(self.hills, x, y)
        along_x, along_y = (slope.shortened(len(dx.c) - 1) for slope in (slope_x, slope_y))
        ahead = unit((dx, dy, along_x * dx + along_y * dy))
        up = unit((-along_x, -along_y, dx.constant(1.0)))
        left = cross(up, ahead)
        return tuple(zip(ahead, left, up, strict=True)), (x, y, z)  # pyright: ignore[reportReturnType]


def _floor(hills: Hills | None, x: Jet, y: Jet) -> tuple[Jet, Jet, Jet]:
    """Height z(x, y) of the floor, dz/dx and dz/dy; zeros without hills."""
    z = slope_x = slope_y = x.constant(0.0)
    if hills is None:
        return z, slope_x, slope_y
    for amplitude, (kx, ky), phase in zip(hills.amplitude, hills.wave, hills.phase, strict=True):
        sine, cosine = (kx * x + ky * y + phase).sine_cosine()
        z = z + amplitude * sine
        slope_x, slope_y = slope_x + (amplitude * kx) * cosine, slope_y + (amplitude * ky) * cosine
    return z, slope_x, slope_y


def ground_motion(
    drive: Drive, room: Room, T_imu_wheel: np.ndarray, duration_s: float, rng: np.random.Generator
) -> GroundMotion:
    """The trajectory of `drive` about the middle of the room, with phases and directions drawn from `rng`."""
    path = _steady(room, duration_s, rng) if drive.kind == "constant-velocity" else _PATHS[drive.kind](room, rng)
    slip = np.deg2rad(drive.sideslip_deg) * np.array([0.6, 0.4])
    sideslip = _wave(slip, _SLIP_HZ, rng) if drive.sideslip_deg else None
    hills = room.hills if drive.kind == "ramps" else None
    return GroundMotion(path, hills, np.linalg.inv(T_imu_wheel), sideslip)


def _wave(amplitude: np.ndarray, band_hz: np.ndarray, rng: np.random.Generator) -> Callable[[Jet], Jet]:
    """A sum of sinusoids of the amplitudes (n,), with frequencies drawn from band_hz (n, 2) and random phases."""
    omega = 2.0 * np.pi * rng.uniform(band_hz[:, 0], band_hz[:, 1])
    phase = rng.uniform(0.0, 2.0 * np.pi, len(amplitude))

    def at(time: Jet) -> Jet:
        total = time.constant(0.0)
        for a, w, p in zip(amplitude, omega, phase, strict=True):
            total = total + a * (w * time + p).sine_cosine()[0]
        return total

    return at


def _curves(room: Room, rng: np.random.Generator) -> Path:
    """Figures of eight about the middle of the room with slow random deviations; the heading is along the path."""
    half_x, half_y = _LAP_SHARE * room.size[0], _LAP_SHARE * room.size[1]
    turn, start = rng.choice([-1.0, 1.0]) * 2.0 * np.pi / _LAP_S, rng.uniform(0.0, 2.0 * np.pi)
    wander_x, wander_y = (_wave(_WANDER_M, _WANDER_HZ, rng) for _ in range(2))

    def at(time: Jet) -> tuple[Jet, Jet, Jet, Jet]:
        angle = turn * time + start
        x = half_x * angle.sine_cosine()[0] + wander_x(time)
        y = half_y * (2.0 * angle).sine_cosine()[0] + wander_y(time)
        return x, y, x.derivative(), y.derivative()

    return at


def _line(rng: np.random.Generator, position: Callable[[Jet], Jet]) -> Path:
    """Motion without rotation along a line through the middle of the room; position: coordinate on the line [m]."""
    heading = rng.uniform(-0.3, 0.3)
    c, s = float(np.cos(heading)), float(np.sin(heading))

    def at(time: Jet) -> tuple[Jet, Jet, Jet, Jet]:
        along = position(time)
        return c * along, s * along, along.constant(c), along.constant(s)

    return at


def _to_and_fro(room: Room, rng: np.random.Generator) -> Path:
    return _line(rng, _wave(np.array([0.25 * room.size[0], 0.15]), np.array([[0.05, 0.08], [0.3, 0.5]]), rng))


def _steady(room: Room, duration_s: float, rng: np.random.Generator) -> Path:
    """Constant velocity along a line, over at most 0.8 of the room's length within the duration."""
    speed = min(_SPEED, 0.8 * room.size[0] / duration_s)
    return _line(rng, lambda time: speed * time - 0.5 * speed * duration_s)


def _still(room: Room, rng: np.random.Generator) -> Path:
    return _line(rng, lambda time: time.constant(0.0))


def _arc(room: Room, rng: np.random.Generator) -> Path:
    rate, start = rng.choice([-1.0, 1.0]) * _SPEED / _RADIUS_M, rng.uniform(0.0, 2.0 * np.pi)
    radius = float(np.copysign(_RADIUS_M, rate))

    def at(time: Jet) -> tuple[Jet, Jet, Jet, Jet]:
        sine, cosine = (rate * time + start).sine_cosine()
        return radius * sine, -radius * cosine, cosine, sine

    return at


def _spin(room: Room, rng: np.random.Generator) -> Path:
    turn = _wave(np.array([1.5, 0.2]), np.array([[0.08, 0.12], [0.3, 0.5]]), rng)

    def at(time: Jet) -> tuple[Jet, Jet, Jet, Jet]:
        sine, cosine = turn(time).sine_cosine()
        return time.constant(0.0), time.constant(0.0), cosine, sine

    return at


_PATHS: dict[str, Callable[[Room, np.random.Generator], Path]] = {
    "planar": _curves,
    "ramps": _curves,
    "straight-line": _to_and_fro,
    "standing": _still,
    "arc": _arc,
    "spin": _spin,
}
