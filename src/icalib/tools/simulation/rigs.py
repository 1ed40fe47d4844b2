"""The rig that a user would write for a simulated recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import yaml

from icalib.geometry.targets import NoTarget
from icalib.rig import BY_CLASS, TRACK_IMAGES, UNFILTERED, Camera, ImuSensor, Parameter, Rig, Sensor, Settings, by_name
from icalib.rig.file import rig_to_dict
from icalib.sensors.sensor import Sampling, mounted
from icalib.tools.simulation.motion import rotation_from_vector
from icalib.tools.simulation.recording import raw_time_offset, true_values
from icalib.tools.simulation.scenario import GRAVITY_WORLD, Scenario, SimCamera, SimSensor

Treatment = Literal["free", "start", "fixed"] | Parameter
_HEADER = "# Rig file of a simulated recording: sensors, noise and target, without any value that is estimated.\n"
_GUESS_STREAM = 3000  # number of the random stream of guesses; `simulate` has the others
_MOST_DRAWN = 3  # numbers are drawn for all types of wheels, so that those of other sensors do not depend on it


@dataclass(frozen=True)
class GuessError:
    """Standard deviations of a drawn initial guess. rotation [rad], translation [m]: on each axis; time_offset [s];
    relative: of focal lengths and parameters of special sensors, relative to their values."""

    rotation: float = float(np.deg2rad(5.0))
    translation: float = 0.05
    time_offset: float = 0.02
    relative: float = 0.03


def settings_for(scenario: Scenario) -> Settings:
    """Settings that model exactly the disturbances of the scenario, without inflation of the sigmas by segments."""
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
    scenario: Scenario, *, settings: Settings | None = None, others: Treatment = "free", **named: Treatment
) -> Rig:
    """The scenario's rig, with the noise of the scenario, also if noise is switched off there.

    In a room without target and without `features`, cameras track points of their images. settings: by default those of
    `settings_for`. named, others: how each parameter group of all sensors is treated, "free" (no guess), "start" (free,
    with the truth as guess), "fixed" (at the truth), or a Parameter. named: by name of the group in the rig, with
    imu_intrinsics for the IMU; by default intrinsics, distortion and imu_intrinsics are fixed. others: for groups that
    are not named. Raises TypeError for a name that no group has.
    """
    treated: dict[str, Treatment] = {"imu_intrinsics": "fixed", "intrinsics": "fixed", "distortion": "fixed", **named}
    sims = {sim.name: sim for sim in scenario.mounted}
    plain = [*(_camera(scenario, c) for c in scenario.cameras), *(s.rig_entry() for s in scenario.sensors)]
    known = {"imu_intrinsics", *(spec.name for kind in (Camera, *map(type, plain)) for spec in kind.stated())}
    if unknown := named.keys() - known:
        raise TypeError(f"no group of parameters is called {min(unknown)}.")
    sensors = [_treated(s, true_values(scenario, sims[s.name]), treated, others) for s in plain]
    imu_intrinsics = _parameter(treated["imu_intrinsics"], scenario.imu_intrinsics)
    sampling: Sampling = "interval-mean" if scenario.imu_sampling == "interval-mean" else "instantaneous"
    imu = ImuSensor("imu0", "imu0/data.csv", scenario.imu_noise, imu_intrinsics, low_pass=UNFILTERED, sampling=sampling)
    return Rig(
        by_name(imu, *sensors),
        replace(scenario.target, size_sigma=0.0) if scenario.board and scenario.cameras else NoTarget(),
        gravity=float(np.linalg.norm(GRAVITY_WORLD)),
        gravity_sigma=0.0,
        settings=settings_for(scenario) if settings is None else settings,
    )


def rig_text(scenario: Scenario, topics: Iterable[str] | None = None) -> str:
    """Text of the rig file of a simulated recording: `rig_for` without any true parameter, and with default settings.

    topics: those of a bag, whose sensors alone are in it, and whose cameras have images and no tables.
    """
    imu = BY_CLASS if np.any(scenario.imu_intrinsics) else Parameter("fixed")  # fixed: ideal
    rig = rig_for(scenario, settings=Settings(), intrinsics="free", distortion="free", imu_intrinsics=imu)
    if topics is not None:
        recorded = {topic.split("/")[1] for topic in topics}
        tracks = TRACK_IMAGES if scenario.room is not None else None
        images = {"tracks": tracks, "corner_noise_px": None, "track_noise_px": None}  # noise is that of the detector
        sensors = (s for name, s in rig.sensors.items() if name in recorded)
        rig = replace(rig, sensors=by_name(*(replace(s, **images) if isinstance(s, Camera) else s for s in sensors)))
    return _HEADER + yaml.safe_dump(rig_to_dict(rig), sort_keys=False, default_flow_style=None, width=1000)


def _camera(scenario: Scenario, sim: SimCamera) -> Camera:
    """The camera's entry in the rig, see `SimSensor.rig_entry`."""
    tracks = f"{sim.name}/tracks.csv"
    if scenario.features is None:
        tracks = None if scenario.board or scenario.room is None else TRACK_IMAGES
    return Camera(
        sim.name,
        f"{sim.name}/corners.csv",
        sim.model,
        sim.resolution,
        corner_noise_px=sim.corner_noise_px,
        tracks=tracks,
        track_noise_px=None if scenario.features is None else sim.corner_noise_px,
        rolling=sim.rolling if sim.readout_s else None,
    )


def _treated(
    sensor: Sensor, true: dict[str, np.ndarray], treatments: dict[str, Treatment], others: Treatment
) -> Sensor:
    """The sensor with each parameter group treated as in `rig_for`; true: values by name. Effects, such as
    the rate of a clock, are left as they are unless they have a treatment of their own."""
    usual = {spec.name for spec in sensor.stated() if not spec.is_effect} | treatments.keys()
    groups = usual & true.keys()
    prefix = "imu_" if sensor.is_inertial else ""  # the intrinsics of an IMU are other parameters than those of cameras
    named: dict[str, Treatment] = {
        name: treatments.get(prefix * (name == "intrinsics") + name, others) for name in groups
    }
    return replace(sensor, **{name: _parameter(treatment, true[name]) for name, treatment in named.items()})


def with_drawn_guess(
    rig: Rig, scenario: Scenario, seed: int, error: GuessError | None = None, only: tuple[str, ...] | None = None
) -> Rig:
    """The rig with guesses of its free groups, or of those named in `only`, drawn about the truth. The guess of a
    principal point is the middle of the image; distortions have no guess. The same seed gives the same guesses."""
    rng = np.random.default_rng([seed, _GUESS_STREAM])
    spread = GuessError() if error is None else error
    sims = {sim.name: sim for sim in scenario.mounted}

    def guessed(sensor: Sensor) -> Sensor:
        sim = sims[sensor.name]
        drawn = _drawn_pose(sim.T_imu_sensor, raw_time_offset(scenario, sim), rng, spread)
        is_camera = isinstance(sim, SimCamera)
        drawn |= _drawn_lens(sim, rng, spread) if is_camera else _drawn_values(sensor, sim, rng, spread)
        names = [spec.name for spec in sensor.stated() if spec.name in drawn and (only is None or spec.name in only)]
        free = [name for name in names if getattr(sensor, name).mode == "free"]
        return replace(sensor, **{name: Parameter("free", drawn[name]) for name in free})

    return rig.with_sensors(*map(guessed, rig.mounted))


def _drawn_lens(sim: SimCamera, rng: np.random.Generator, error: GuessError) -> dict[str, np.ndarray]:
    focal = np.array(sim.intrinsics[:2]) * (1.0 + error.relative * rng.standard_normal())
    return {"intrinsics": np.array([*focal, *(0.5 * (side - 1) for side in sim.resolution)])}


def _drawn_values(sensor: Sensor, sim: SimSensor, rng: np.random.Generator, error: GuessError) -> dict[str, np.ndarray]:
    """The true values that the rig file may state, with random errors: relative to the value for lengths and scales, of
    1 rad for an angle."""
    true, drawn = sim.true_parameters().values, dict[str, np.ndarray]()
    specs = [spec for spec in sensor.stated() if spec.name in true]
    off = error.relative * rng.standard_normal(_MOST_DRAWN if specs else 0)
    for spec in specs:
        (errors, off), value = (off[: spec.size], off[spec.size :]), true[spec.name]
        drawn[spec.name] = value + errors * (value if spec.is_positive else 1.0)
    return drawn


def _drawn_pose(
    T_imu_sensor: np.ndarray, offset: float, rng: np.random.Generator, error: GuessError
) -> dict[str, np.ndarray]:
    """Drawn extrinsics and time offset by group name. All are drawn, even groups that the sensor lacks."""
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
