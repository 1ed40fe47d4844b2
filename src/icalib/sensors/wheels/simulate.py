"""Simulated wheels: wheel rates, speed and yaw rate, a steering angle, or relative poses by equation (27) of the
iCalib paper."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.data.measurements import WheelPoses, WheelStream
from icalib.errors import RigError
from icalib.sensors.wheels.spec import WheelKind, Wheels, drive_names
from icalib.tools.simulation.output import BagWriter, write_table
from icalib.tools.simulation.room import Room
from icalib.tools.simulation.scenario import (
    BagEvent,
    BagTopic,
    Report,
    SimRecord,
    SimScene,
    SimSensor,
    TrueParameters,
    at_least,
    mounted_fields,
)
from icalib.tools.simulation.trajectory import LEAD_S, Drive, TrueTrajectory, check_enough, stamped

_GAUSS = np.polynomial.legendre.leggauss(3)  # points and weights on [-1, 1]
_MAX_STEERING_RAD = 1.3  # largest angle of front wheels; those of a car reach 0.7
_SUBSTEPS = 12  # panels of Simpson's rule per relative pose, by which its noise is integrated
_CHUNK = 100_000  # instants evaluated at a time; motion and its derivatives take 2 kB per instant
_KINDS: dict[str, WheelKind] = {"rates": "pair", "steering": "steered", "twist": "twist", "poses": "pair"}
# Required and optional fields of a scenario file for each value of `reports`.
_FIELDS = {
    "rates": (("radii", "baseline"), ("noise", "slip", "allowed_slip", "poses_every")),
    "poses": (("radii", "baseline"), ("noise", "slip", "poses_every")),
    "twist": (("scales",), ("speed_noise", "yaw_noise", "allowed_slip")),
    "steering": (("radius", "wheelbase"), ("steering_offset", "noise", "steering_noise", "allowed_slip")),
}
_COLUMNS = {
    "pair": ("rates", "left [rad/s],right [rad/s]"),
    "steered": ("rates", "wheel [rad/s],steering [rad]"),
    "twist": ("twist", "v [m/s],w [rad/s]"),
}
_SAMPLING = {"interval-mean": "means since the stamp before", "instantaneous": "values at the stamp"}
_JOINT_STATE, _TWIST = "sensor_msgs/msg/JointState", "geometry_msgs/msg/TwistStamped"
_JOINTS = {"pair": ["left_wheel", "right_wheel"], "steered": ["wheel", "steering"]}


@dataclass(frozen=True, eq=False)
class WheelTruth:
    """Readings without noise. seconds (N,): stamps on the IMU's clock; value (N, 2): `rate` of a `WheelStream`, or
    relative poses (N - 1, 3) as in `WheelPoses`."""

    seconds: np.ndarray
    value: np.ndarray


@dataclass(frozen=True, eq=False)
class SimWheels(SimSensor):
    """Simulated wheels. The origin of their frame is midway between the wheels of the axle that is not steered, on the
    floor; x forward, z up.

    radii (left, right) [m], baseline [m]. noise: density of each wheel's rate [rad/s/sqrt(Hz)]. slip: density of
    simulated lateral slip [m/sqrt(s)], for poses only. allowed_slip: density of slip [m/sqrt(s)] that the rig file
    states; None: the default of the rig file, which is that of real wheels.

    reports: type of the readings, sampled by `sampling` as in `WheelStream`. v_x and w_z are speed and yaw rate of the
    wheel frame. rates: (v_x -+ baseline/2 w_z) / radius, left and right. twist: v_x and w_z divided by `scales`.
    steering: v_x / radius for the driven wheel, and the direction of motion of a point a wheelbase ahead, minus
    steering_offset [rad]. poses: relative poses by equation (27) of the iCalib paper, one for every `poses_every`
    readings, with the noise of integrated readings.
    """

    sensor_type: ClassVar[str] = "wheels"
    random_stream: ClassVar[int] = 2000
    rolls: ClassVar[bool] = True

    rate_hz: float = 70.0
    radii: tuple[float, float] = (0.1, 0.1)
    baseline: float = 0.4
    noise: float = 0.03
    slip: float = 0.0
    allowed_slip: float | None = None
    reports: Literal["rates", "twist", "steering", "poses"] = "rates"
    sampling: Literal["interval-mean", "instantaneous"] = "interval-mean"
    poses_every: int = 3
    scales: tuple[float, float] = (1.0, 1.0)
    speed_noise: float = 2e-3  # m/s/sqrt(Hz)
    yaw_noise: float = 1e-2  # rad/s/sqrt(Hz)
    radius: float = 0.1
    wheelbase: float = 0.6
    steering_offset: float = 0.0
    steering_noise: float = 1e-3  # rad/sqrt(Hz)

    @classmethod
    def parse(cls, name: str, value: YamlValue, start_ns: int) -> SimWheels:
        entries = value.entries()
        reports = entries["reports"].choice("reports", tuple(_FIELDS)) if "reports" in entries else cls.reports
        required, options = _FIELDS[reports]
        fields, common = mounted_fields(value, start_ns, required, (*options, "reports", "sampling"))
        chosen: dict[str, Any] = {"reports": reports}
        for key in fields.keys() & {*required, *options}:
            chosen[key] = _number(key, fields[key])
        if "sampling" in fields:
            chosen["sampling"] = fields["sampling"].choice("sampling", ("interval-mean", "instantaneous"))
        return cls(name, **common, **chosen)

    def check(self, room: Room | None, drive: Drive | None) -> None:
        if self.reports != "poses" and not (drive is not None and drive.on_ground):
            raise RigError(
                f"{self.name} cannot roll, because the motion is not that of wheels on a floor; use reports: "
                "poses, or choose a motion on the ground."
            )

    def true_parameters(self) -> TrueParameters:
        names = drive_names(_KINDS[self.reports])
        return TrueParameters({name: np.atleast_1d(np.array(getattr(self, name))) for name in names})

    def report(self, scene: SimScene, seed: list[int], progress: Callable[[float], None]) -> Report:
        """The simulated stream within the time of the IMU, and its truth. Raises RigError if there are too few
        readings, or if the motion needs a steering angle beyond the range of front wheels."""
        rng = np.random.default_rng(seed)
        stamps, seconds = stamped(self, scene.imu_seconds[-1] - LEAD_S)
        if self.reports == "poses":
            stamps, seconds = stamps[:: self.poses_every], seconds[:: self.poses_every]
            check_enough(self.name, stamps)
            true, covariance = relative_poses(self, scene.trajectory, seconds)
            measured = true + _drawn(covariance, rng) * float(scene.noisy)
            return Report(WheelPoses(self.name, stamps, measured, covariance), WheelTruth(seconds, true))
        true = _true_readings(self, scene, seconds)
        noise = self._densities() * np.sqrt(self.rate_hz) * rng.standard_normal(true.shape)
        measured = true + noise * float(scene.noisy)
        stream = WheelStream(self.name, stamps[1:], measured, self.sampling, _KINDS[self.reports])
        return Report(stream, WheelTruth(seconds[1:], true))

    def _densities(self) -> np.ndarray:
        """Noise densities (2,) of the two columns of readings, per sqrt(Hz)."""
        densities = {"twist": [self.speed_noise, self.yaw_noise], "steering": [self.noise, self.steering_noise]}
        return np.array(densities.get(self.reports, [self.noise, self.noise]))

    def rig_entry(self) -> Wheels:
        measures = "rates" if self.reports == "steering" else self.reports
        slip = Wheels.lateral_slip if self.allowed_slip is None else self.allowed_slip
        return Wheels(
            self.name,
            f"{self.name}/{measures}.csv",
            "ackermann" if self.reports == "steering" else "differential",
            wheel_noise=self.noise,
            speed_noise=self.speed_noise,
            yaw_noise=self.yaw_noise,
            steering_noise=self.steering_noise,
            measures=measures,
            sampling=self.sampling,
            lateral_slip=slip,
            vertical_slip=slip,
        )

    def record(self, stream: WheelStream | WheelPoses, offset_ns: int) -> SimRecord:
        """A table, and JointState or TwistStamped messages. Relative poses have no message."""
        if isinstance(stream, WheelPoses):
            topic = f"{self.name} reports relative poses, which no driver sends; they are not written."
        elif stream.kind == "twist":
            topic = BagTopic(f"/{self.name}/twist", _TWIST, _twists(stream, offset_ns))
        else:
            topic = BagTopic(f"/{self.name}/joint_states", _JOINT_STATE, _joint_states(stream, offset_ns))
        return SimRecord(partial(_write_table, stream), topic)


SIMULATED = SimWheels


def _write_table(stream: WheelStream | WheelPoses, folder: Path) -> None:
    if isinstance(stream, WheelStream):
        name, columns = _COLUMNS[stream.kind]
        header = f"t [ns],{columns}; {_SAMPLING[stream.sampling]}"
        write_table(folder / f"{name}.csv", header, stream.stamps_ns, stream.rate)
        return
    header = "from [ns],to [ns],yaw [rad],x [m],y [m],covariance: yaw yaw,yaw x,yaw y,x x,x y,y y"
    stamps, upper = stream.stamps_ns, stream.covariance[:, *np.triu_indices(3)]
    write_table(folder / "poses.csv", header, stamps[:-1], stamps[1:], stream.pose, upper)


def _number(key: str, value: YamlValue) -> Any:
    """The value of a field of `SimWheels` in a scenario file."""
    if key in ("radii", "scales"):
        two = value.items()
        if len(two) != 2:
            words = "[left, right] in metres" if key == "radii" else "[speed, yaw rate]"
            value.fail(f"must be {words}, but has {len(two)} entries.")
        return two[0].positive(), two[1].positive()
    if key == "poses_every":
        return value.whole(1)
    if key == "steering_offset":
        return value.number()
    return at_least(value, 0.0) if key == "slip" or key.endswith("noise") else value.positive()


def _joint_states(wheels: WheelStream, offset_ns: int) -> Iterator[BagEvent]:
    """JointState messages. Positions are angles since the first stamp if readings are interval means, else missing. A
    steering joint has a position and no velocity."""
    angles, rates = np.full(wheels.rate.shape, np.nan), wheels.rate.copy()
    if wheels.sampling == "interval-mean":
        turned = wheels.rate[1:] * np.diff(wheels.stamps_ns)[:, None] * 1e-9
        angles = np.concatenate([np.zeros((1, 2)), np.cumsum(turned, axis=0)])
    if wheels.kind == "steered":
        angles[:, 1], rates[:, 1] = wheels.rate[:, 1], np.nan
    elif wheels.sampling == "instantaneous":
        angles = np.empty((len(rates), 0))
    names = _JOINTS[wheels.kind]
    for stamp_ns, angle, rate in zip(wheels.stamps_ns.tolist(), angles, rates, strict=True):
        yield (
            stamp_ns + offset_ns,
            lambda bag, stamp_ns=stamp_ns, angle=angle, rate=rate: bag.make(
                _JOINT_STATE, bag.header(stamp_ns, wheels.name), names, angle, rate, np.empty(0)
            ),
        )


def _twists(wheels: WheelStream, offset_ns: int) -> Iterator[BagEvent]:
    for stamp_ns, (speed, yaw_rate) in zip(wheels.stamps_ns.tolist(), wheels.rate.tolist(), strict=True):
        yield (
            stamp_ns + offset_ns,
            lambda bag, stamp_ns=stamp_ns, speed=speed, yaw_rate=yaw_rate: _twist(
                bag, stamp_ns, wheels.name, speed, yaw_rate
            ),
        )


def _twist(bag: BagWriter, stamp_ns: int, frame: str, speed: float, yaw_rate: float) -> Any:
    """A TwistStamped message with forward speed [m/s] and yaw rate [rad/s]."""
    linear, angular = (bag.make("geometry_msgs/msg/Vector3", *v) for v in ((speed, 0.0, 0.0), (0.0, 0.0, yaw_rate)))
    return bag.make(_TWIST, bag.header(stamp_ns, frame), bag.make("geometry_msgs/msg/Twist", linear, angular))


def _true_readings(wheels: SimWheels, scene: SimScene, seconds: np.ndarray) -> np.ndarray:
    """Readings without noise (N - 1, 2), as in `WheelStream`, at all instants seconds (N,) except the first."""
    if wheels.sampling == "instantaneous":
        return reported(wheels, scene.trajectory, seconds[1:])
    true = _means(wheels, scene.trajectory, seconds, scene.imu_seconds)
    if wheels.reports == "steering":
        true[:, 1] = reported(wheels, scene.trajectory, seconds[1:])[:, 1]
    return true


def reported(wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray) -> np.ndarray:
    """Instantaneous readings without noise (N, 2), as in `WheelStream`, at seconds (N,) on the clock of the
    trajectory."""
    some = np.split(seconds, range(_CHUNK, len(seconds), _CHUNK))
    return np.concatenate([_reported(wheels, trajectory, s) for s in some])


def _reported(wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray) -> np.ndarray:
    velocity, rate = wheel_velocity(wheels.T_imu_sensor, trajectory, seconds)
    ahead, turning = velocity[:, 0], rate[:, 2]
    if wheels.reports == "twist":
        return np.stack([ahead / wheels.scales[0], turning / wheels.scales[1]], axis=1)
    if wheels.reports == "steering":
        return np.stack([ahead / wheels.radius, _steering(wheels, ahead, turning)], axis=1)
    half = 0.5 * wheels.baseline
    left = (ahead - half * turning) / wheels.radii[0]
    right = (ahead + half * turning) / wheels.radii[1]
    return np.stack([left, right], axis=1)


def _steering(wheels: SimWheels, ahead: np.ndarray, turning: np.ndarray) -> np.ndarray:
    """Measured steering angle (N,) [rad]: the direction of motion of a point a wheelbase ahead, whose velocity is v_x
    along x and wheelbase * w_z along y, minus steering_offset. Raises RigError beyond the range of front wheels."""
    angle = np.arctan2(np.copysign(wheels.wheelbase, ahead) * turning, np.abs(ahead))
    if np.abs(angle).max() > _MAX_STEERING_RAD:
        raise RigError(
            f"{wheels.name} would have to steer by {np.rad2deg(np.abs(angle).max()):.0f} deg; choose a motion with "
            "wider curves that never drives backwards, or a shorter wheelbase."
        )
    return angle - wheels.steering_offset


def wheel_velocity(
    T_imu_wheel: np.ndarray, trajectory: TrueTrajectory, seconds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (N, 3) [m/s] and angular rate (N, 3) [rad/s] of the wheel frame in wheel axes at seconds (N,)."""
    rotation, _, velocity = trajectory.pose_at(seconds)
    rate = trajectory.rate_at(seconds)
    in_imu = np.einsum("nji,nj->ni", rotation, velocity) + np.cross(rate, T_imu_wheel[:3, 3])
    return in_imu @ T_imu_wheel[:3, :3], rate @ T_imu_wheel[:3, :3]


def _means(wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray, imu_seconds: np.ndarray) -> np.ndarray:
    """Mean readings (N - 1, 2) between seconds (N,), by Gauss quadrature. Intervals are split at imu_seconds, where
    rates may jump."""
    within = imu_seconds[(imu_seconds > seconds[0]) & (imu_seconds < seconds[-1])]
    cuts = np.union1d(seconds, within)
    width = np.diff(cuts)
    at = 0.5 * (cuts[:-1] + cuts[1:])[:, None] + 0.5 * width[:, None] * _GAUSS[0]
    rates = reported(wheels, trajectory, at.ravel()).reshape(*at.shape, 2)
    angle = 0.5 * width[:, None] * np.einsum("g,ngw->nw", _GAUSS[1], rates)
    turned = np.concatenate([np.zeros((1, 2)), np.cumsum(angle, axis=0)])[np.searchsorted(cuts, seconds)]
    return np.diff(turned, axis=0) / np.diff(seconds)[:, None]


def relative_poses(wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative poses (K, 3) without noise between consecutive instants (K + 1,) by equation (27) of the iCalib paper:
    yaw = e3 . Log(R_W(k)_W(k+1)) [rad], and x, y of p_W(k)_W(k+1) [m]. Also the covariance (K, 3, 3) that they would
    have if they were integrated from noisy readings."""
    each = _CHUNK // (2 * _SUBSTEPS + 1)
    some = [seconds[k : k + each + 1] for k in range(0, len(seconds) - 1, each)]
    poses, covariances = zip(*(_relative_poses(wheels, trajectory, s) for s in some), strict=True)
    return np.concatenate(poses), np.concatenate(covariances)


def _relative_poses(
    wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    parts = np.linspace(seconds[:-1], seconds[1:], 2 * _SUBSTEPS + 1, axis=1)
    rotation, position = _frames(wheels, trajectory, parts.ravel())
    rotation, position = rotation.reshape(*parts.shape, 3, 3), position.reshape(*parts.shape, 3)
    xy = np.einsum("kji,kmj->kmi", rotation[:, 0], position - position[:, :1])[..., :2]
    yaw = _rotation_vectors(np.einsum("kji,kmjl->kmil", rotation[:, 0], rotation))[..., 2]
    return np.column_stack([yaw[:, -1], xy[:, -1]]), _covariance(wheels, yaw, xy, np.diff(seconds))


def _drawn(covariance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random vectors (K, 3), normally distributed with the covariances (K, 3, 3), which may be singular."""
    size, axes = np.linalg.eigh(covariance)
    return (axes @ (np.sqrt(np.maximum(size, 0.0)) * rng.standard_normal(size.shape))[..., None])[..., 0]


def _frames(wheels: SimWheels, trajectory: TrueTrajectory, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_world_wheel (N, 3, 3) and p_world_wheel (N, 3) [m] at seconds (N,)."""
    rotation, position, _ = trajectory.pose_at(seconds)
    return rotation @ wheels.T_imu_sensor[:3, :3], position + rotation @ wheels.T_imu_sensor[:3, 3]


def _rotation_vectors(rotation: np.ndarray) -> np.ndarray:
    """(..., 3) Log of rotations (..., 3, 3) of less than half a turn: the axis from R - R^T, the angle from atan2."""
    twice = np.stack([rotation[..., i, j] - rotation[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1)
    sine = 0.5 * np.linalg.norm(twice, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1.0))
    return 0.5 * twice * np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 1.0)[..., None]


def _covariance(wheels: SimWheels, yaw: np.ndarray, xy: np.ndarray, duration: np.ndarray) -> np.ndarray:
    """Covariance (K, 3, 3) of yaw, x, y: the noise of rates at each instant, propagated to the end of its interval.

    yaw (K, M), xy (K, M, 2): poses along each interval, M odd for Simpson's rule; duration (K,) [s]. An error of the
    yaw rate rotates the rest of the path about the position of the frame at that instant. An error of the speed moves
    the rest of the path along the x axis of the frame.
    """
    r_l, r_r = wheels.radii
    speeds = np.array([[-r_l, r_r], [0.5 * r_l * wheels.baseline, 0.5 * r_r * wheels.baseline]]) / wheels.baseline
    to_end = xy[:, -1:] - xy
    c, s, none, one = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    J_turn = np.stack([one, -to_end[..., 1], to_end[..., 0]], axis=-1)
    J_speed, J_slip = np.stack([none, c, s], axis=-1), np.stack([none, -s, c], axis=-1)
    J_wheels = np.stack([J_turn, J_speed], axis=-1) @ speeds * wheels.noise
    effect = np.concatenate([J_wheels, J_slip[..., None] * wheels.slip], axis=-1)
    weight = np.where(np.arange(yaw.shape[1]) % 2, 4.0, 2.0)
    weight[[0, -1]] = 1.0
    weight = weight / weight.sum() * duration[:, None]
    return np.einsum("km,kmin,kmjn->kij", weight, effect, effect)
