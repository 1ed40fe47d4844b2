"""How a pose sensor enters the problem: by its poses, and by the frame in which it reports absolute ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.data.measurements import PoseStream
from icalib.model.frames import frame_entries
from icalib.model.sensor_model import Pass, SensorModel
from icalib.model.statistics import ResidualStatistics
from icalib.motion.clocks import instants
from icalib.optim.state import Entry, Key
from icalib.rig import ImuSensor, PoseSensor, Rig, Settings
from icalib.sensors.pose.residual import AbsolutePoseFactor, PoseFactor, PoseNoise, RelativePosesFactor

# Where the noise is not stated: rad, m; of relative poses rad/sqrt(s), m/sqrt(s).
FIRST_ROTATION_NOISE, FIRST_POSITION_NOISE = 0.01, 0.02
LEAST_NOISE = 1e-6  # rad, m: keeps the weights of poses without any noise finite


class PoseModel(SensorModel[PoseSensor, PoseNoise]):
    """Noise that is not stated is estimated by degrees of freedom: where nothing else shows the motion, it absorbs most
    of the residuals. The first such estimate is a rough one, so there are two."""

    keyframes = "poses"
    only_first_places_keyframes = True

    def scene_entries(self, sensor: PoseSensor, rig: Rig, n_recordings: int) -> list[Entry]:
        """The frame of absolute poses; that of the sensor which alone shows the motion is the world's."""
        if sensor.kind != "absolute":
            return []
        is_reference = rig.moves_by_poses and sensor is rig.poses[0]
        is_world = is_reference and (rig.imu is None or rig.assumes_motion)
        return frame_entries(sensor.name, n_recordings, not is_world)

    def keyframe_times(
        self, sensor: PoseSensor, stream: PoseStream, values: dict[Key, np.ndarray], rig: Rig
    ) -> np.ndarray:
        """Those of poses, as many as are needed."""
        del sensor
        imu = rig.imu or ImuSensor  # its default
        return instants(stream, values, thinned(stream.seconds, imu.pose_keyframes_s))

    def first_noise(self, sensor: PoseSensor, settings: Settings) -> PoseNoise:
        """See `SensorModel`."""
        rotation = FIRST_ROTATION_NOISE if sensor.rotation_noise is None else sensor.rotation_noise
        position = FIRST_POSITION_NOISE if sensor.position_noise is None else sensor.position_noise
        return PoseNoise(rotation, position, settings.loss, settings.loss_scale)

    def next_noise(self, sensor: PoseSensor, noise: PoseNoise, found: ResidualStatistics) -> PoseNoise:
        """See `SensorModel`."""
        if not self.noise_is_estimated(sensor):
            return noise
        return scaled_noise(sensor, noise, found.variance_factors())

    def noise_passes(self, sensor: PoseSensor) -> int:
        """See `SensorModel`."""
        return 2 if sensor.rotation_noise is None or sensor.position_noise is None else 0

    def factors(self, sensor: PoseSensor, stream: PoseStream, noise: PoseNoise, at: Pass) -> Iterator[PoseFactor]:
        """One, of absolute or of relative poses."""
        assert at.motion is not None
        kind = AbsolutePoseFactor if sensor.kind == "absolute" else RelativePosesFactor
        yield kind.build(stream, at.motion, noise, at.layout)

    def still_factors(
        self, sensor: PoseSensor, stream: PoseStream, noise: PoseNoise, at: Pass
    ) -> Iterator[AbsolutePoseFactor]:
        """One, of the poses at keyframes."""
        yield AbsolutePoseFactor.at_keyframes(stream, at.state, at.starts, noise, at.layout)


def scaled_noise(sensor: PoseSensor, noise: PoseNoise, variance_factors: dict[str, float]) -> PoseNoise:
    """The noise times the roots of `variance_factors`, by kind of residual, where it is not stated. A kind that they
    lack stays as it is."""
    rotation, position = (
        max(sigma * float(np.sqrt(variance_factors.get(kind, 1.0))), LEAST_NOISE)
        for kind, sigma in (("rotation", noise.rotation), ("position", noise.position))
    )
    rotation = rotation if sensor.rotation_noise is None else noise.rotation
    position = position if sensor.position_noise is None else noise.position
    return PoseNoise(rotation, position, noise.loss, noise.loss_scale)


def thinned(seconds: np.ndarray, spacing: float) -> np.ndarray:
    """The first of `seconds` (n,), in order, in each stretch of `spacing`, and the last of all."""
    k = np.flatnonzero(np.diff(np.floor(seconds / spacing + 1e-6), prepend=-1.0))
    return seconds[np.append(k, len(seconds) - 1)] if k[-1] < len(seconds) - 1 else seconds[k]


MODEL = PoseModel()
