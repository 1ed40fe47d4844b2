"""Estimation model of a pose sensor: the factor of its poses, their noise, and the frame of absolute poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from icalib.data.measurements import Measurements, PoseStream
from icalib.model.sensor_model import Pass, PassEnd, SensorModel, frame_entries
from icalib.motion.point_planes import PlaneAssociation
from icalib.motion.poses import instants, spaced
from icalib.optim.state import Entry, Key
from icalib.rig import ImuSensor, PoseSensor, Rig
from icalib.sensors.pose.residual import AbsolutePoseFactor, PoseFactor, PoseNoise, RelativePosesFactor

# Noise in the first pass if the rig file states none, then it is estimated. Absolute poses: rad, m; relative poses:
# rad/sqrt(s), m/sqrt(s).
FIRST_ROTATION_NOISE, FIRST_POSITION_NOISE = 0.01, 0.02
MIN_POSE_NOISE = 1e-6  # lower bound in the same units, so that the weights of noise-free simulated poses stay finite


class PoseModel(SensorModel[PoseSensor, PoseNoise]):
    """Model of pose sensors. Noise that the rig file does not state is estimated with post-fit degrees of freedom. If
    no other sensor determines the trajectory, it absorbs most residuals. The first noise estimate is rough, so that
    there is a second."""

    def scene_entries(self, sensor: PoseSensor, rig: Rig, n_recordings: int) -> list[Entry]:
        """Parameters of the frame of absolute poses in each recording. The frame is fixed as the world frame if this
        sensor alone gives the motion."""
        if sensor.kind != "absolute":
            return []
        is_reference = rig.moves_by_poses and sensor is rig.poses[0]
        is_world = is_reference and (rig.imu is None or rig.assumes_motion)
        return frame_entries(sensor.name, n_recordings, not is_world)

    def keyframe_times(
        self, sensors: Sequence[PoseSensor], rig: Rig, streams: Mapping[str, Any], values: Mapping[Key, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Times of poses of the first sensor, at about the keyframe spacing; none if another sensor is the body of an
        assumed motion."""
        if rig.assumes_motion and sensors[0].name != rig.reference_without_imu:
            return {}
        imu, stream = rig.imu or ImuSensor, streams[sensors[0].name]  # the default spacing without an IMU
        return {sensors[0].name: instants(stream, values, spaced(stream.seconds, imu.pose_keyframes_s))}

    def first_noise(self, sensors: Sequence[PoseSensor], rig: Rig, measurements: Measurements) -> dict[str, PoseNoise]:
        return {
            s.name: PoseNoise(
                FIRST_ROTATION_NOISE if s.rotation_noise is None else s.rotation_noise,
                FIRST_POSITION_NOISE if s.position_noise is None else s.position_noise,
                rig.settings.loss,
                rig.settings.loss_scale,
            )
            for s in sensors
        }

    def next_noise(
        self, sensors: Sequence[PoseSensor], noise: Mapping[str, PoseNoise], end: PassEnd
    ) -> dict[str, PoseNoise]:
        factors = {s.name: end.of(s.name).variance_factors() if is_estimated(s) else {} for s in sensors}
        return {s.name: estimated_noise(s, noise[s.name], factors[s.name]) for s in sensors}

    def passes(
        self, sensors: Sequence[PoseSensor], rig: Rig, measurements: Measurements, association: PlaneAssociation
    ) -> int:
        return 2 * any(is_estimated(s) for s in sensors)

    def factors(self, sensor: PoseSensor, stream: PoseStream, noise: PoseNoise, at: Pass) -> Iterator[PoseFactor]:
        """One factor, of absolute or relative poses according to the sensor's kind."""
        if at.motion is None:
            yield AbsolutePoseFactor.at_keyframes(stream, at.state, at.starts, noise, at.layout)
            return
        kind = AbsolutePoseFactor if sensor.kind == "absolute" else RelativePosesFactor
        yield kind.build(stream, at.motion, noise, at.layout)


def is_estimated(sensor: PoseSensor) -> bool:
    """Whether some noise is estimated from residuals."""
    return sensor.rotation_noise is None or sensor.position_noise is None


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
