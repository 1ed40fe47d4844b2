"""Intrinsics of cameras, and relative poses of bodies, from a target of several bodies.

One small tag alone determines neither well. A reconstruction of the scene from all bodies together determines both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.targets.base import Target
from icalib.model.bodies import Bodies
from icalib.rig import Camera, Rig
from icalib.sensors.camera.connected_bodies import choose_bodies, restrict, tied_by_images
from icalib.sensors.camera.initialize.boards.body_groups import register_groups
from icalib.sensors.camera.initialize.boards.bundle_adjustment import CameraIntrinsics
from icalib.sensors.camera.initialize.boards.incremental_scene import place_bodies, reconstruct_scene
from icalib.sensors.camera.initialize.boards.intrinsics import camera_params
from icalib.sensors.camera.initialize.boards.target_scene import TargetScene

TRIAL_FOCAL_WIDTHS = (0.6, 1.0, 0.35)  # focal lengths to try, in image widths: views of 80, 53 and 110 degrees
# Quantile of the image errors by which scenes are compared. The median is insensitive to wrong poses of a few bodies.
SCENE_RMS_QUANTILE = 0.9
EXPECTED_SCENE_RMS_PX = 0.3  # px; a better fit than this is the global minimum, as detected corners are rarely better
MAX_RECONSTRUCTIONS = 4  # from one start; each begins at the intrinsics of the previous one
MAX_REPEATED_ERROR = 0.9  # error over that of the previous reconstruction, above which there is no further one
MAX_SCENE_RMS_PX = 2.0  # px, of the median image in a scene that fits; wrong models and sizes give more
CENTRE_SIGMA = 0.1  # image widths, of the prior of the principal point about the image centre, for regularity only
DISTORTION_SIGMA = 1.0  # of the prior of each distortion coefficient about its start value, for regularity only
MAX_OFF_CENTRE = 0.25  # image sides, by which a principal point may lie outside the image
FOCAL_RANGE = (0.05, 20.0)  # image widths; a fisheye lens has 0.2, a field of view of 5 deg has 11
MAX_FOCAL_RATIO = 2.0  # fx over fy; pixels are square to a few percent, images squeezed to half width are rare
MAX_INVISIBLE_SHARE = 0.05  # share of corners without a ray, which may be outliers


def find_scene(rig: Rig, bodies: Bodies, recordings: Sequence[Measurements]) -> TargetScene:
    """Relative poses of the bodies in use, from the images of all recordings.

    recordings: their streams hold corners of these bodies only. Raises EstimationError if the images do not determine
    the poses; `UnconnectedBodiesError` if they do not determine those of some bodies.
    """
    if not bodies.several:
        return TargetScene(bodies)
    streams = [CornerStream.joined([r.cameras[i] for r in recordings]) for i in range(len(rig.cameras))]
    params = {c.name: scene_intrinsics(rig.target, c, s) for c, s in zip(rig.cameras, streams, strict=True)}
    if rig.cameras_alone and len(tied_by_images(bodies, recordings)) > 1:
        return register_groups(rig, bodies, recordings, params)
    return place_bodies(bodies, streams, [camera_model(c.model) for c in rig.cameras], params)


def intrinsics_of(camera: Camera, stream: CornerStream, target: Target, scene: TargetScene) -> np.ndarray:
    """(P,) intrinsics and distortion: those of `scene` if it has some, else by `camera_params` from single bodies."""
    return scene.params[camera.name] if camera.name in scene.params else camera_params(camera, stream, target)


def scene_intrinsics(target: Target, camera: Camera, stream: CornerStream) -> np.ndarray:
    """(P,) intrinsics and distortion: those of the rig file, else the ones that fit all bodies together best.

    Scenes are reconstructed from several start values. If the camera saw one body only, `camera_params` is used. Raises
    EstimationError if no intrinsics explain the bodies together.
    """
    if camera.intrinsics.value is not None and camera.distortion.value is not None:
        return camera_params(camera, stream, target)
    alone = Measurements.of_streams(stream)
    bodies = choose_bodies(target, [alone], bent=False)
    if not bodies.several:
        return camera_params(camera, stream, target)
    stream = restrict(bodies, alone).cameras[0]
    rms, params = _best_reconstruction(bodies, camera, stream, _starts(target, camera, stream))
    if not rms < MAX_SCENE_RMS_PX:
        error = f"best median error {rms:.1f} px" if np.isfinite(rms) else "the best fit is not a valid lens"
        raise EstimationError(
            f"{camera.name}: no lens of model {camera.model} explains the bodies of the target together ({error}); "
            "check the model, resolution and sizes in the rig file and that no tag is there twice, or give intrinsics."
        )
    return params


def _best_reconstruction(
    bodies: Bodies, camera: Camera, stream: CornerStream, starts: Iterator[CameraIntrinsics]
) -> tuple[float, np.ndarray]:
    """Error of the median image [px] and intrinsics (P,) of the best scene, or of the first one that fits well.

    The reconstruction is repeated from its own result while the error decreases, because better intrinsics correct
    wrong poses of bodies. Returns infinity and an empty array if no scene has plausible intrinsics.
    """
    best, median, params = np.inf, np.inf, np.empty(0)
    for start in starts:
        before = np.inf
        for _ in range(MAX_RECONSTRUCTIONS):
            grown = reconstruct_scene(bodies, [stream], [start])
            lens, rms = grown.state.lenses[0], grown.rms_of(SCENE_RMS_QUANTILE)
            if not is_plausible_lens(lens.model, lens.params, camera.resolution, stream.uv):
                break
            if rms < best:
                best, median, params = rms, grown.rms_of(0.5), lens.params
            if best < EXPECTED_SCENE_RMS_PX:
                return median, params
            if not rms < MAX_REPEATED_ERROR * before:
                break
            before, start = rms, replace(start, params=lens.params)
    return median, params


def is_plausible_lens(model: CameraModel, params: np.ndarray, resolution: tuple[int, int], uv: np.ndarray) -> bool:
    """Whether parameters (P,) can be those of a real lens.

    It has a focal length in `FOCAL_RANGE`, a principal point in or near the image, and rays for nearly all corners
    uv (N, 2) [px], so that its distortion is monotone where it is used.
    """
    if not np.isfinite(params).all():
        return False
    middle = 0.5 * (np.array(resolution) - 1.0)
    _, _, J_point, _ = model.project_with_jacobians(params, np.array([[0.0, 0.0, 1.0]]))
    focal = np.array([J_point[0, 0, 0], J_point[0, 1, 1]])  # px/rad in the middle, which is not fx in every model
    near = np.abs(params[2:4] - middle) < (0.5 + MAX_OFF_CENTRE) * np.array(resolution)
    in_range = (focal > FOCAL_RANGE[0] * resolution[0]) & (focal < FOCAL_RANGE[1] * resolution[0])
    if not (near.all() and in_range.all() and 1.0 / MAX_FOCAL_RATIO < focal[0] / focal[1] < MAX_FOCAL_RATIO):
        return False
    _, valid = model.unproject(params, uv)
    return bool((~valid).mean() < MAX_INVISIBLE_SHARE)


def _starts(target: Target, camera: Camera, stream: CornerStream) -> Iterator[CameraIntrinsics]:
    """Start values: intrinsics from single bodies, if plausible; then start distortions with several focal lengths.

    Fixed values and priors of the rig file are kept in all of them.
    """
    model, width = camera_model(camera.model), camera.resolution[0]
    middle = 0.5 * (np.array(camera.resolution) - 1.0)
    given = [camera.intrinsics, camera.distortion]
    n = len(model.parameter_names)
    free = np.repeat([p.value is None or p.mode == "free" for p in given], [4, n - 4])

    def lens(params: np.ndarray) -> CameraIntrinsics:
        mean = params.copy()
        if camera.intrinsics.value is None:
            mean[2:4] = middle
        sigma = np.concatenate([params[:2], np.full(2, CENTRE_SIGMA * width), np.full(n - 4, DISTORTION_SIGMA)])
        return CameraIntrinsics(model, params, mean, sigma, free)

    with suppress(EstimationError):
        params = camera_params(camera, stream, target)
        if is_plausible_lens(model, params, camera.resolution, stream.uv):
            yield lens(params)
    for distortion in model.start_distortions:
        params = np.array([1.0, 1.0, *middle, *distortion])
        _, _, J_point, _ = model.project_with_jacobians(params, np.array([[0.0, 0.0, 1.0]]))
        for widths in TRIAL_FOCAL_WIDTHS if free[0] else TRIAL_FOCAL_WIDTHS[:1]:
            start = np.array([*np.full(2, widths * width / J_point[0, 0, 0]), *middle, *distortion])
            for part, parameter in zip((slice(0, 4), slice(4, None)), given, strict=True):
                if parameter.value is not None and parameter.mode != "free":
                    start[part] = parameter.value
            yield lens(start)
