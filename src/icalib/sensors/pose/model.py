"""Estimation model of a pose sensor: the factor of its poses, their noise, and the frame of absolute poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.data.measurements import PoseStream
from icalib.model.sensor_model import Pass, ResidualStatistics, SensorModel, frame_entries
from icalib.motion.poses import instants, spaced
from icalib.optim.state import Entry, Key
from icalib.rig import ImuSensor, PoseSensor, Rig, Settings
from icalib.sensors.pose.residual import AbsolutePoseFactor, PoseFactor, PoseNoise, RelativePosesFactor

# Noise in the first pass if the rig file states none, then it is estimated. Absolute poses: rad, m; relative poses:
# rad/sqrt(s), m/sqrt(s).
FIRST_ROTATION_NOISE, FIRST_POSITION_NOISE = 0.01, 0.02
MIN_POSE_NOISE = 1e-6  # lower bound in the same units, so that the weights of noise-free simulated poses stay finite


class PoseModel(SensorModel[PoseSensor, PoseNoise]):
    """Model of pose sensors. Noise that the rig file does not state is estimated with post-fit degrees of freedom. If
    no other sensor determines the trajectory, it absorbs most residuals. The first noise estimate is rough, so that
    there is a second."""

    keyframes = "poses"

    def scene_entries(self, sensor: PoseSensor, rig: Rig, n_recordings: int) -> list[Entry]:
        """Parameters of the frame of absolute poses in each recording. The frame is fixed as the world frame if this
        sensor alone gives the motion."""
        if sensor.kind != "absolute":
            return []
        is_reference = rig.moves_by_poses and sensor is rig.poses[0]
        is_world = is_reference and (rig.imu is None or rig.assumes_motion)
        return frame_entries(sensor.name, n_recordings, not is_world)

    def placing_keyframes(self, sensors: Sequence[PoseSensor], rig: Rig) -> Sequence[PoseSensor]:
        """Only the first sensor, see `SensorModel`."""
        return sensors[:1]

    def keyframe_times(
        self, sensor: PoseSensor, stream: PoseStream, values: dict[Key, np.ndarray], rig: Rig
    ) -> np.ndarray:
        """Times of poses at about the keyframe spacing, in seconds on the IMU's clock."""
        imu = rig.imu or ImuSensor  # the default spacing without an IMU
        return instants(stream, values, spaced(stream.seconds, imu.pose_keyframes_s))

    def first_noise(self, sensor: PoseSensor, settings: Settings) -> PoseNoise:
        rotation = FIRST_ROTATION_NOISE if sensor.rotation_noise is None else sensor.rotation_noise
        position = FIRST_POSITION_NOISE if sensor.position_noise is None else sensor.position_noise
        return PoseNoise(rotation, position, settings.loss, settings.loss_scale)

    def next_noise(self, sensor: PoseSensor, noise: PoseNoise, statistics: ResidualStatistics) -> PoseNoise:
        if not self.noise_is_estimated(sensor):
            return noise
        return estimated_noise(sensor, noise, statistics.variance_factors())

    def noise_passes(self, sensor: PoseSensor) -> int:
        return 2 if sensor.rotation_noise is None or sensor.position_noise is None else 0

    def factors(self, sensor: PoseSensor, stream: PoseStream, noise: PoseNoise, at: Pass) -> Iterator[PoseFactor]:
        """One factor, of absolute or relative poses according to the sensor's kind."""
        assert at.motion is not None
        kind = AbsolutePoseFactor if sensor.kind == "absolute" else RelativePosesFactor
        yield kind.build(stream, at.motion, noise, at.layout)

    def still_factors(
        self, sensor: PoseSensor, stream: PoseStream, noise: PoseNoise, at: Pass
    ) -> Iterator[AbsolutePoseFactor]:
        """One factor of the poses that were taken at keyframes, without an IMU."""
        yield AbsolutePoseFactor.at_keyframes(stream, at.state, at.starts, noise, at.layout)


def estimated_noise(sensor: PoseSensor, noise: PoseNoise, variance_factors: dict[str, float]) -> PoseNoise:
    """Noise in which values that the rig file does not state are scaled by the square roots of variance_factors, by
    kind of residual. Without a variance factor the value is unchanged."""
    rotation, position = (
        max(sigma * float(np.sqrt(variance_factors.get(kind, 1.0))), MIN_POSE_NOISE)
        for kind, sigma in (("rotation", noise.rotation), ("position", noise.position))
    )
    rotation = rotation if sensor.rotation_noise is None else noise.rotation
    position = position if sensor.position_noise is None else noise.position
    return PoseNoise(rotation, position, noise.loss, noise.loss_scale)


MODEL = PoseModel()
