"""The rig that a user would write for a simulated recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from icalib.geometry.targets import NoTarget
from icalib.rig import TRACK_IMAGES, Camera, ImuSensor, Lidar, Parameter, PoseSensor, Rig, Settings, Wheels, by_name
from icalib.rig.kinds import SPECS
from icalib.sensors.sensor import mounted
from icalib.tools.simulation.scenario.robot import SimLidar, SimPoses, SimWheels
from icalib.tools.simulation.scenario.scenario import GRAVITY_WORLD, Scenario, SimCamera
from icalib.tools.simulation.sensors.imu import rotation_from_vector
from icalib.tools.simulation.sensors.simulate import raw_time_offset

Sensor = TypeVar("Sensor", Camera, Lidar, Wheels, PoseSensor)
Robotic = TypeVar("Robotic", Lidar, Wheels, PoseSensor)
Treatment = Literal["free", "start", "fixed"] | Parameter
_GUESS_STREAM = 3000  # of random numbers; see `simulate` for the others


@dataclass(frozen=True)
class GuessError:
    """Standard deviations of a drawn first guess: of each axis of a rotation [rad] and of a translation [m], of a time
    offset [s], and of a focal length, as a share of it."""

    rotation: float = float(np.deg2rad(5.0))
    translation: float = 0.05
    time_offset: float = 0.02
    focal_length: float = 0.03


def settings_for(scenario: Scenario) -> Settings:
    """Settings that model just what the scenario disturbs; no empirical factor."""
    return Settings(
        loss="huber" if scenario.outlier_fraction > 0.0 else "none",
        outlier_std=4.0 if scenario.outlier_fraction > 0.0 else 0.0,
        bloom=any(c.bloom_px != 0.0 for c in scenario.cameras),
        board_shape=any(b != 0.0 for b in scenario.bow),
        blur_noise=scenario.blur_s > 0.0,
        common_error=scenario.shift_px > 0.0,
        segments=0,
    )


def rig_for(
    scenario: Scenario,
    *,
    settings: Settings | None = None,
    rotation: Treatment = "free",
    translation: Treatment = "free",
    time_offset: Treatment = "free",
    intrinsics: Treatment = "fixed",
    distortion: Treatment = "fixed",
    bloom: Treatment = "free",
    imu_intrinsics: Treatment = "fixed",
    drive: Treatment = "free",
) -> Rig:
    """The scenario's rig, noise as simulated (as stated by the scenario, where its noise is switched off).

    Cameras in a room without target and without `features` track its images. Each group of parameters, of all cameras
    alike: "free" (no guess), "start" (free, from the truth), "fixed" (at the truth), or a Parameter. settings: by
    default those of `settings_for`.
    """

    treated = _Treated(scenario, rotation, translation, time_offset, intrinsics, distortion, bloom, drive)
    imu = ImuSensor("imu0", "imu0/data.csv", scenario.imu_noise, _parameter(imu_intrinsics, scenario.imu_intrinsics))
    return Rig(
        by_name(
            imu,
            *(treated.camera(c) for c in scenario.cameras),
            *(treated.lidar(s) for s in scenario.lidars),
            *(treated.wheels(s) for s in scenario.wheels),
            *(treated.poses(s) for s in scenario.poses),
        ),
        replace(scenario.target, size_sigma=0.0) if scenario.board and scenario.cameras else NoTarget(),
        gravity=float(np.linalg.norm(GRAVITY_WORLD)),
        settings=settings_for(scenario) if settings is None else settings,
    )


@dataclass(frozen=True)
class _Treated:
    """Sensors of the rig, with each group of parameters treated alike in all."""

    scenario: Scenario
    rotation: Treatment
    translation: Treatment
    time_offset: Treatment
    intrinsics: Treatment
    distortion: Treatment
    bloom: Treatment
    drive: Treatment

    def _tracks(self, sim: SimCamera) -> str | None:
        if self.scenario.features is not None:
            return f"{sim.name}/tracks.csv"
        return None if self.scenario.board or self.scenario.room is None else TRACK_IMAGES

    def camera(self, sim: SimCamera) -> Camera:
        return Camera(
            sim.name,
            f"{sim.name}/corners.csv",
            sim.model,
            sim.resolution,
            corner_noise_px=sim.corner_noise_px,
            tracks=self._tracks(sim),
            track_noise_px=None if self.scenario.features is None else sim.corner_noise_px,
            rotation=_parameter(self.rotation, sim.T_imu_cam[:3, :3]),
            translation=_parameter(self.translation, sim.T_imu_cam[:3, 3]),
            time_offset=_parameter(self.time_offset, [raw_time_offset(self.scenario, sim)]),
            intrinsics=_parameter(self.intrinsics, sim.intrinsics),
            distortion=_parameter(self.distortion, sim.distortion),
            bloom=_parameter(self.bloom, [sim.bloom_px]),
        )

    def _mounted(self, sensor: Robotic, sim: SimLidar | SimWheels | SimPoses, T_imu_sensor: np.ndarray) -> Robotic:
        return replace(
            sensor,
            rotation=_parameter(self.rotation, T_imu_sensor[:3, :3]),
            translation=_parameter(self.translation, T_imu_sensor[:3, 3]),
            time_offset=_parameter(self.time_offset, [raw_time_offset(self.scenario, sim)]),
        )

    def wheels(self, sim: SimWheels) -> Wheels:
        kind = "rates" if sim.reports == "steering" else sim.reports
        given = Wheels(
            sim.name,
            f"{sim.name}/{kind}.csv",
            "ackermann" if sim.reports == "steering" else "differential",
            wheel_noise=sim.noise,
            speed_noise=sim.speed_noise,
            yaw_noise=sim.yaw_noise,
            steering_noise=sim.steering_noise,
            measures=kind,
            sampling=sim.sampling,
        )
        if sim.allowed_slip is not None:
            given = replace(given, lateral_slip=sim.allowed_slip, vertical_slip=sim.allowed_slip)
        given = replace(given, **{name: _parameter(self.drive, value) for name, value in sim.drive.items()})
        return self._mounted(given, sim, sim.T_imu_wheel)

    def lidar(self, sim: SimLidar) -> Lidar:
        near, far = sim.range_m
        given = Lidar(sim.name, f"{sim.name}/scans.npz", sim.range_noise_m, min_range_m=near, max_range_m=far)
        return self._mounted(given, sim, sim.T_imu_lidar)

    def poses(self, sim: SimPoses) -> PoseSensor:
        noise = sim.rotation_noise, sim.position_noise
        given = PoseSensor(sim.name, f"{sim.name}/poses.csv", sim.kind, *noise, scale_sigma=0.0)
        return self._mounted(given, sim, sim.T_imu_sensor)


def with_drawn_guess(
    rig: Rig, scenario: Scenario, seed: int, error: GuessError | None = None, only: tuple[str, ...] | None = None
) -> Rig:
    """The rig with a guess of each free group, or of those named in `only`, drawn about the truth; the same seed draws
    the same. Principal points are guessed in the middle of the image, and of distortions there is no guess."""
    rng = np.random.default_rng([seed, _GUESS_STREAM])
    spread = GuessError() if error is None else error

    def mount(sim: SimCamera | SimLidar | SimWheels | SimPoses, T_imu_sensor: np.ndarray) -> dict[str, np.ndarray]:
        return _drawn_pose(T_imu_sensor, raw_time_offset(scenario, sim), rng, spread)

    def guessed(sensor: Sensor, drawn: dict[str, np.ndarray]) -> Sensor:
        free = {k: v for k, v in drawn.items() if getattr(sensor, k).mode == "free" and (only is None or k in only)}
        return replace(sensor, **{name: Parameter("free", value) for name, value in free.items()})

    cameras = zip(rig.cameras, scenario.cameras, strict=True)
    lidars = zip(rig.lidars, scenario.lidars, strict=True)
    wheels = zip(rig.wheels, scenario.wheels, strict=True)
    poses = zip(rig.poses, scenario.poses, strict=True)
    return rig.with_sensors(
        *(guessed(c, mount(s, s.T_imu_cam) | _drawn_lens(s, rng, spread)) for c, s in cameras),
        *(guessed(x, mount(s, s.T_imu_lidar)) for x, s in lidars),
        *(guessed(x, mount(s, s.T_imu_wheel) | _drawn_drive(s, rng, spread)) for x, s in wheels),
        *(guessed(x, mount(s, s.T_imu_sensor)) for x, s in poses),
    )


def _drawn_lens(sim: SimCamera, rng: np.random.Generator, error: GuessError) -> dict[str, np.ndarray]:
    focal = np.array(sim.intrinsics[:2]) * (1.0 + error.focal_length * rng.standard_normal())
    return {"intrinsics": np.array([*focal, *(0.5 * (side - 1) for side in sim.resolution)])}


def _drawn_drive(sim: SimWheels, rng: np.random.Generator, error: GuessError) -> dict[str, np.ndarray]:
    """Radii, baseline and the like, as far off as focal lengths; an angle by as many radians."""
    drawn, off = {}, error.focal_length * rng.standard_normal(3)
    for name, value in sim.drive.items():
        own, off = off[: value.size], off[value.size :]
        drawn[name] = value + own * (value if SPECS[name].is_positive else 1.0)
    return drawn


def _drawn_pose(
    T_imu_sensor: np.ndarray, offset: float, rng: np.random.Generator, error: GuessError
) -> dict[str, np.ndarray]:
    """What every sensor has, by the names of its groups."""
    return mounted(
        T_imu_sensor[:3, :3] @ rotation_from_vector(error.rotation * rng.standard_normal(3)),
        T_imu_sensor[:3, 3] + error.translation * rng.standard_normal(3),
        offset + error.time_offset * rng.standard_normal(1),
    )


def _parameter(treatment: Treatment, truth: object) -> Parameter:
    if isinstance(treatment, Parameter):
        return treatment
    if treatment == "free":
        return Parameter()
    return Parameter("free" if treatment == "start" else "fixed", np.array(truth, dtype=np.float64))
