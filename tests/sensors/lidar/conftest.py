"""Robots with IMU and LiDAR in the paper's room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from tests.typed import not_none

from icalib.data.measurements import LidarStream
from icalib.geometry import so3
from icalib.initialize.trajectories import ExtrinsicsGuess
from icalib.motion.imu_data import ImuData
from icalib.optim.state import State
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.simulation import Simulation, load_scenario, simulate

PAPER = Path(__file__).parents[3] / "examples" / "paper"


@dataclass(frozen=True)
class Robot:
    """A simulated recording, and its truth as a guess and a state."""

    sim: Simulation

    @cached_property
    def imu(self) -> ImuData:
        return ImuData.build(not_none(self.sim.measurements.imu), self.sim.scenario.imu_noise)

    @property
    def streams(self) -> tuple[LidarStream, ...]:
        return self.sim.measurements.lidars

    def truth(self, k: int = 0) -> ExtrinsicsGuess:
        stream, truth = self.streams[k], self.sim.truth
        T = truth.T_imu_sensor[stream.name]
        origins_s = (stream.origin_ns - not_none(self.sim.measurements.imu).origin_ns) * 1e-9
        return ExtrinsicsGuess(T[:3, :3].copy(), T[:3, 3].copy(), truth.time_offset[stream.name] + origins_s)

    def pose_at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """At seconds since the IMU's first stamp."""
        return self.sim.truth.pose_at(t + self.sim.truth.seconds[0])

    def state(self, keyframes: np.ndarray) -> State:
        truth = self.sim.truth
        bias = np.concatenate([truth.gyro_bias.mean(axis=0), truth.accel_bias.mean(axis=0)])
        values = {("imu0", "intrinsics"): np.zeros(24)}
        for k, stream in enumerate(self.streams):
            values |= self.truth(k).values(stream.name)
        return State(keyframes, *self.pose_at(keyframes), np.tile(bias, (len(keyframes), 1)), values)

    def errors(self, found: ExtrinsicsGuess, k: int = 0) -> tuple[np.ndarray, np.ndarray, float]:
        """Of rotation [deg], position [m], time offset [s]."""
        true = self.truth(k)
        turn = so3.log(np.ascontiguousarray(true.rotation.T @ found.rotation))
        return np.rad2deg(turn), found.position - true.position, found.offset - true.offset


def make_robot(duration_s: float, seed: int, *lidars: dict, example: str = "table2-3d", **changes) -> Robot:
    """lidars: how each differs from the paper's; changes: of the scenario."""
    scenario = load_scenario(PAPER / f"{example}.yaml")
    own = tuple(
        replace(scenario.of(SimLidar)[0], **({"name": f"lidar{k}", "azimuth_steps": 600} | d))
        for k, d in enumerate(lidars or ({},))
    )
    alone = replace(scenario, duration_s=duration_s, cameras=(), features=None, board=False, sensors=own, **changes)
    return Robot(simulate(alone, seed))


@pytest.fixture(scope="session")
def robot() -> Callable[..., Robot]:
    return make_robot


@pytest.fixture(scope="session")
def free_robot() -> Robot:
    return make_robot(16.0, 1)
