"""The factors of pose sensors in one pass, the frames that they report in, and their noise from pass to pass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.data.measurements import PoseStream
from icalib.motion.factor import Factor
from icalib.motion.sweep import Motion
from icalib.optim.state import Entry, Layout, State
from icalib.rig import PoseSensor, Settings
from icalib.rig.scene import FRAME
from icalib.sensors.pose.residual import AbsolutePoseFactor, PoseFactor, PoseNoise, RelativePosesFactor, frame_of

# Of a pose sensor whose noise is not given: rad, m; of relative poses rad/sqrt(s), m/sqrt(s).
FIRST_POSE_NOISE = 0.01, 0.02
LEAST_POSE_NOISE = 1e-6


def frame_entries(sensor: PoseSensor, n_recordings: int, estimated: bool = True) -> list[Entry]:
    """Of the calibration parameters: where the frame of absolute poses stands in each recording's world."""
    frames = [frame_of(sensor.name, k) for k in range(n_recordings if sensor.kind == "absolute" else 0)]
    return [spec.entry(frame, estimated) for frame in frames for spec in FRAME]


def first_pose_noise(sensor: PoseSensor, settings: Settings) -> PoseNoise:
    """Noise of a pose sensor before its residuals are known."""
    turn, way = FIRST_POSE_NOISE
    turn = turn if sensor.rotation_noise is None else sensor.rotation_noise
    way = way if sensor.position_noise is None else sensor.position_noise
    return PoseNoise(turn, way, settings.loss, settings.loss_scale)


def next_pose_noise(sensor: PoseSensor, noise: PoseNoise, ratios: dict[str, float]) -> PoseNoise:
    """With the sizes that chi^2 over degrees of freedom shows, by kind of row, where the rig file has none. A kind that
    `ratios` lacks stays as it is."""
    turn, way = (
        max(size * float(np.sqrt(ratios.get(kind, 1.0))), LEAST_POSE_NOISE)
        for kind, size in (("rotation", noise.rotation), ("position", noise.position))
    )
    turn = turn if sensor.rotation_noise is None else noise.rotation
    way = way if sensor.position_noise is None else noise.position
    return PoseNoise(turn, way, noise.loss, noise.loss_scale)


def pose_factor(sensor: PoseSensor, stream: PoseStream, motion: Motion, noise: PoseNoise, layout: Layout) -> PoseFactor:
    kind = AbsolutePoseFactor if sensor.kind == "absolute" else RelativePosesFactor
    return kind.build(stream, motion, noise, layout)


def still_factors(
    streams: Sequence[PoseStream], noise: Sequence[PoseNoise], state: State, starts: tuple[int, ...], layout: Layout
) -> tuple[Factor, ...]:
    """Of pose sensors without an IMU; starts: the first node of each recording."""
    pairs = zip(streams, noise, strict=True)
    return tuple(AbsolutePoseFactor.at_nodes(stream, state, starts, size, layout) for stream, size in pairs)
