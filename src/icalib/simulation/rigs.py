"""The rig that a user would write for a simulated recording."""

from __future__ import annotations

from typing import Literal

import numpy as np

from icalib.rig import Camera, ImuSensor, Parameter, Rig, Settings
from icalib.simulation.scenario import GRAVITY_WORLD, Scenario, SimCamera
from icalib.simulation.simulate import raw_time_offset

Treatment = Literal["free", "start", "fixed"] | Parameter


def settings_for(scenario: Scenario) -> Settings:
    """Settings that model just what the scenario disturbs; no empirical factor."""
    return Settings(
        loss="huber" if scenario.outlier_fraction > 0.0 else "none",
        outlier_std=4.0 if scenario.outlier_fraction > 0.0 else 0.0,
        bloom=any(c.bloom_px != 0.0 for c in scenario.cameras),
        board_shape=any(b != 0.0 for b in scenario.bow),
        blur_noise=scenario.blur_s > 0.0,
        common_error=scenario.shift_px > 0.0,
        splits=0,
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
) -> Rig:
    """The scenario's rig, noise as simulated (as stated by the scenario, where its noise is switched off).

    Each group of parameters, of all cameras alike: "free" (no guess), "start" (free, from the truth), "fixed" (at the
    truth), or a Parameter. settings: by default those of `settings_for`.
    """

    def camera(sim: SimCamera) -> Camera:
        return Camera(
            sim.name,
            f"{sim.name}/corners.csv",
            sim.model,
            sim.resolution,
            corner_noise_px=sim.corner_noise_px,
            rotation=_parameter(rotation, sim.T_imu_cam[:3, :3]),
            translation=_parameter(translation, sim.T_imu_cam[:3, 3]),
            time_offset=_parameter(time_offset, [raw_time_offset(scenario, sim)]),
            intrinsics=_parameter(intrinsics, sim.intrinsics),
            distortion=_parameter(distortion, sim.distortion),
            bloom=_parameter(bloom, [sim.bloom_px]),
        )

    imu = ImuSensor("imu0", "imu0/data.csv", scenario.imu_noise, _parameter(imu_intrinsics, scenario.imu_intrinsics))
    return Rig(
        imu,
        tuple(camera(c) for c in scenario.cameras),
        scenario.target,
        gravity=float(np.linalg.norm(GRAVITY_WORLD)),
        settings=settings_for(scenario) if settings is None else settings,
    )


def _parameter(treatment: Treatment, truth: object) -> Parameter:
    if isinstance(treatment, Parameter):
        return treatment
    if treatment == "free":
        return Parameter()
    return Parameter("free" if treatment == "start" else "fixed", np.array(truth, dtype=np.float64))
