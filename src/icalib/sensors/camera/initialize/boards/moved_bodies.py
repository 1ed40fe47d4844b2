"""Whether the bodies of a target stand to each other alike in all recordings.

Each recording's error in the common scene is compared with the errors in scenes of single recordings. Errors of the
lens and of the target are in all of them. Bodies that were moved between recordings raise the first alone.
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

# Ratio of the errors of median images. At 1.5 the movement adds as much again to the errors that single recordings
# leave. At twice that, movements by two standard deviations of the corners would pass.
CHANGED = 1.5


def check_bodies_still(rig: Rig, scene: TargetScene, recordings: Sequence[Measurements]) -> None:
    """Raises EstimationError naming the recording that differs most from the `scene` of all, if it differs clearly."""
    if not scene.bodies.several:
        return
    changes = scene_error_ratios(rig, scene, recordings)
    most = int(np.argmax(changes))
    if changes[most] > CHANGED:
        raise EstimationError(
            f"{recordings[most].name}: the poses of the targets relative to each other differ from the other "
            "recordings; calibrate it alone, or remove the targets that were moved."
        )


def scene_error_ratios(rig: Rig, scene: TargetScene, recordings: Sequence[Measurements]) -> np.ndarray:
    """(n,) RMS error of each recording's median image in the `scene` of all, over the largest in scenes of their own.

    The largest, because few images alike in a scene of their own hide the errors of a wrong lens.
    """
    common, own = np.array([_median_errors(rig, scene, r) for r in recordings]).T
    return common / max(float(own.max()), MIN_CORNER_NOISE_PX)


def _median_errors(rig: Rig, scene: TargetScene, recording: Measurements) -> tuple[float, float]:
    """RMS errors [px] of the recording's median image in the `scene`, and in a scene of its own.

    The latter is corrected for the degrees of freedom that its bodies take. Zeros where the recording is too short to
    show a scene of its own.
    """
    models = [camera_model(c.model) for c in rig.cameras]
    params = [scene.params[c.name] for c in rig.cameras]
    lenses = [fixed_lens(m, p) for m, p in zip(models, params, strict=True)]
    grown = reconstruct_scene(scene.bodies, recording.cameras, lenses)
    placed = tuple(int(k) for k in np.flatnonzero(grown.placed))
    if len(placed) < 2:
        return 0.0, 0.0
    bodies = replace(scene.bodies, used=placed)
    own = TargetScene(bodies, grown.in_frame_of(placed[0], bodies), scene.params)
    streams = restrict(bodies, recording).cameras
    free = 2 * sum(len(s.uv) for s in streams) - 6 * sum(len(s.stamps_ns) for s in streams)
    left = free - 6 * (len(placed) - 1)
    if left <= 0:
        return 0.0, 0.0
    seen = list(zip(streams, models, params, strict=True))

    def median(placing: TargetScene) -> float:
        return float(np.median(np.concatenate([multi_body_poses(*s, placing).rms_px for s in seen])))

    return median(scene), median(own) * float(np.sqrt(free / left))
