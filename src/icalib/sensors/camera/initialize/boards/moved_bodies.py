"""Detects bodies of a target that were moved relative to each other between recordings.

The reprojection error of each recording in the common scene is compared with the errors in scenes that are
reconstructed from single recordings. Errors of lens and target increase all of them. Moved bodies increase only the
error in the common scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.rig import Rig
from icalib.sensors.camera.connected_bodies import restrict
from icalib.sensors.camera.corner_noise import MIN_CORNER_NOISE_PX
from icalib.sensors.camera.initialize.boards.incremental_scene import fixed_lens, reconstruct_scene
from icalib.sensors.camera.initialize.boards.target_scene import TargetScene, multi_body_poses

# Ratio of the reprojection errors of median images. At 1.5, movement adds 1.25 times the error variance in scenes of
# single recordings. At 3, movements by two standard deviations of the corners would not be detected.
MAX_SCENE_ERROR_RATIO = 1.5


def check_bodies_still(rig: Rig, scene: TargetScene, recordings: Sequence[Measurements]) -> None:
    """Raises EstimationError if bodies were moved between recordings.

    scene: the common scene of all recordings. The message names the recording with the largest error ratio.
    """
    if not scene.bodies.several:
        return
    ratios = scene_error_ratios(rig, scene, recordings)
    worst = int(np.argmax(ratios))
    if ratios[worst] > MAX_SCENE_ERROR_RATIO:
        raise EstimationError(
            f"{recordings[worst].name}: the poses of the targets relative to each other differ from the other "
            "recordings; calibrate it alone, or remove the targets that were moved."
        )


def scene_error_ratios(rig: Rig, scene: TargetScene, recordings: Sequence[Measurements]) -> np.ndarray:
    """(n,) RMS error of each recording's median image in the common `scene`, over the largest single-recording error.

    The largest error is the reference, because a scene from few similar images may fit them well with a wrong lens.
    """
    common, single = np.array([_median_errors(rig, scene, r) for r in recordings]).T
    return common / max(float(single.max()), MIN_CORNER_NOISE_PX)


def _median_errors(rig: Rig, scene: TargetScene, recording: Measurements) -> tuple[float, float]:
    """RMS errors [px] of the recording's median image in the common `scene`, and in the scene of this recording.

    The second error is corrected for the degrees of freedom of its bodies. Both are zero if the recording alone does
    not determine relative poses of bodies.
    """
    models = [camera_model(c.model) for c in rig.cameras]
    params = [scene.params[c.name] for c in rig.cameras]
    lenses = [fixed_lens(m, p) for m, p in zip(models, params, strict=True)]
    grown = reconstruct_scene(scene.bodies, recording.cameras, lenses)
    placed = tuple(int(k) for k in np.flatnonzero(grown.placed))
    if len(placed) < 2:
        return 0.0, 0.0
    bodies = replace(scene.bodies, used=placed)
    single = TargetScene(bodies, grown.in_frame_of(placed[0], bodies), scene.params)
    streams = restrict(bodies, recording).cameras
    degrees = 2 * sum(len(s.uv) for s in streams) - 6 * sum(len(s.stamps_ns) for s in streams)
    remaining = degrees - 6 * (len(placed) - 1)
    if remaining <= 0:
        return 0.0, 0.0
    cameras = list(zip(streams, models, params, strict=True))

    def median_rms(scene: TargetScene) -> float:
        return float(np.median(np.concatenate([multi_body_poses(*camera, scene).rms_px for camera in cameras])))

    return median_rms(scene), median_rms(single) * float(np.sqrt(degrees / remaining))
