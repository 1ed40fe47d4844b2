"""Initial guess from pose sensors: the IMU trajectory, extrinsics, and the frame of absolute poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.estimate.estimate import first_pass
from icalib.estimate.problem.inputs import Inputs
from icalib.initialize.steps.initializer import BY_POSES, Initializer, InputsWithMotion, SmoothMotion, Values
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.model.frames import FRAME, frame_of
from icalib.optim.state import State
from icalib.rig import PoseSensor, Rig
from icalib.sensors.pose.initialize.conventions import conventions, is_unstated, other_axes, unstated
from icalib.sensors.pose.initialize.extrinsics import check_rate, pose_values, state_from_poses
from icalib.sensors.pose.initialize.initial_noise import pose_noise
from icalib.sensors.pose.initialize.stop_and_go import is_stop_and_go, state_from_pairs


class PoseInitializer(Initializer[PoseSensor]):
    """The first pose sensor gives the trajectory if neither cameras nor LiDARs give it. All other pose sensors are
    aligned to the trajectory."""

    def motion_rank(self, rig: Rig) -> int | None:
        return BY_POSES if rig.poses else None

    def sources(self, rig: Rig) -> tuple[str, ...]:
        return (rig.poses[0].name,)

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        del fallback
        return state_from_poses(inputs)

    def refined(self, inputs: Inputs, state: State) -> tuple[Inputs, State, Values]:
        """State after one pass of the estimator, and extrinsics that are aligned to this improved trajectory."""
        sensors = inputs.rig.poses
        state = first_pass(inputs, replace(state, values=state.values | self.place(inputs, state, sensors)))
        state = replace(state, values=state.values | self.place(inputs, state, sensors))
        return inputs, state, state.values

    def place(self, inputs: Inputs, state: State, sensors: Sequence[PoseSensor]) -> Values:
        return pose_values(inputs, state, sensors)

    def vertical(self, state: State, sensor: PoseSensor) -> np.ndarray | None:
        frame = state.values.get((frame_of(sensor.name, 0), FRAME[0]))
        return frame[:, 2] if sensor.level and sensor.kind == "absolute" and frame is not None else None

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> tuple[list[BodyPoses], Values]:
        streams = [m.poses[0] for m in recordings]
        if is_unstated(streams[0], rig.poses[0]):
            raise unstated(streams[0])
        return [BodyPoses(s.seconds, s.rotation, s.position) for s in streams], {}

    def check_moving(self, recording: Measurements) -> None:
        for stream in recording.poses:
            check_rate(stream)

    def start_at_rest(
        self, rig: Rig, recordings: Sequence[Measurements], body_poses: Sequence[BodyPoses], values: Values
    ) -> tuple[Inputs, State, Values] | None:
        """Initial guess by hand-eye calibration from pairs of poses, if the robot stood still at each pose; else
        None."""
        if not is_stop_and_go(rig, recordings, body_poses):
            return None
        return state_from_pairs(rig, recordings, body_poses, values)

    def longest_spacing(self, rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
        return motion.spacing_for_poses(*pose_noise([m.poses[0] for m in recordings]))

    def rewritten(self, rig: Rig, recordings: Sequence[Measurements]) -> Iterator[tuple[str, list[Measurements]]]:
        sensor = rig.poses[0]
        each = ([*conventions(m.poses[0], sensor), *other_axes(m.poses[0])] for m in recordings)
        for others in zip(*each, strict=True):
            if others[0].changes == 1 and "position_unit" not in "".join(others[0].fields):
                yield (
                    others[0].sentence(sensor.name),
                    [m.with_streams(x.stream) for m, x in zip(recordings, others, strict=True)],
                )

    def explained(
        self, rig: Rig, recordings: Sequence[Measurements], converges: Callable[[Rig], bool]
    ) -> EstimationError | None:
        """An error that recommends kind: absolute, if relative poses fail but the same poses converge as absolute ones;
        else None."""
        del recordings
        first = rig.poses[0]
        if first.kind != "relative" or not converges(rig.with_sensors(replace(first, kind="absolute"))):
            return None
        return EstimationError(
            f"{first.name}: with kind: relative its poses are too noisy to give the motion, with kind: absolute "
            "they are not; write kind: absolute if they hardly drift over the recording."
        )


INITIALIZER = PoseInitializer()
