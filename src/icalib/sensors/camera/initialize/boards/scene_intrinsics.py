"""Lenses and poses of a target of several bodies: one small tag alone leaves both unsure, all together do not."""

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

TRIAL_WIDTHS = (0.6, 1.0, 0.35)  # focal lengths to try, in image widths: views of 80, 53 and 110 degrees
JUDGED_SHARE = 0.9  # of the images tell whether a scene fits: where a part of it stands wrongly, most still do
GOOD_RMS_PX = 0.3  # a scene that fits so well needs no other trial: corners are seldom found better
REGROWN = 4  # times that a start is followed
WORTH_GROWING = 0.9  # another time is worth it where the error became so many times the one before
LARGEST_RMS_PX = 2.0  # of the median image in a scene that fits
CENTRE_SIGMA = 0.1  # of the image's width: the prior on the principal point, about the middle
DISTORTION_SIGMA = 1.0  # the prior on each, about where it starts
OFF_CENTRE = 0.25  # of the image's sides, by which a principal point may lie outside the image
FOCAL_RANGE = (0.05, 20.0)  # image widths; a fisheye's is 0.2, that of a view of 5 degrees 11
MOST_STRETCHED = 2.0  # fx over fy
UNSEEN_SHARE = 0.05  # of the corners, that a lens may not be able to see


def find_scene(rig: Rig, bodies: Bodies, recordings: Sequence[Measurements]) -> TargetScene:
    """How the bodies stand to each other, from the images of all recordings, whose streams hold corners of these bodies
    only. Raises EstimationError where images do not tell; `UnconnectedBodiesError` where they do not of some."""
    if not bodies.several:
        return TargetScene(bodies)
    streams = [CornerStream.joined([r.cameras[i] for r in recordings]) for i in range(len(rig.cameras))]
    params = {c.name: scene_intrinsics(rig.target, c, s) for c, s in zip(rig.cameras, streams, strict=True)}
    if rig.cameras_alone and len(tied_by_images(bodies, recordings)) > 1:
        return register_groups(rig, bodies, recordings, params)
    return place_bodies(bodies, streams, [camera_model(c.model) for c in rig.cameras], params)


def intrinsics_of(camera: Camera, stream: CornerStream, target: Target, scene: TargetScene) -> np.ndarray:
    """(P,) parameters: what the scene has, or else a camera by itself."""
    return scene.params[camera.name] if camera.name in scene.params else camera_params(camera, stream, target)


def scene_intrinsics(target: Target, camera: Camera, stream: CornerStream) -> np.ndarray:
    """(P,) what the rig gives, else the lens that fits all bodies together best, among those that growing a scene from
    several starts leads to. A camera that shows one body only is judged by that.

    Raises EstimationError where no lens explains the bodies together.
    """
    if camera.intrinsics.value is not None and camera.distortion.value is not None:
        return camera_params(camera, stream, target)
    alone = Measurements.of_streams(stream)
    bodies = choose_bodies(target, [alone], bent=False)
    if not bodies.several:
        return camera_params(camera, stream, target)
    seen = restrict(bodies, alone).cameras[0]
    rms, params = _best(bodies, camera, seen, _starts(target, camera, seen))
    if not rms < LARGEST_RMS_PX:
        error = f"best median error {rms:.1f} px" if np.isfinite(rms) else "the best fit is not a valid lens"
        raise EstimationError(
            f"{camera.name}: no lens of model {camera.model} explains the bodies of the target together ({error}); "
            "check the model, resolution and sizes in the rig file and that no tag is there twice, or give intrinsics."
        )
    return params


def _best(
    bodies: Bodies, camera: Camera, seen: CornerStream, starts: Iterator[CameraIntrinsics]
) -> tuple[float, np.ndarray]:
    """The median error [px] and the lens (P,) of the scene that fits best, or fits well; each start is followed anew
    from where it led, as long as that fits better: where bodies stand wrongly, a nearly right lens places them right.
    Infinite where no scene fits a lens that can be."""
    best, median, params = np.inf, np.inf, np.empty(0)
    for start in starts:
        before = np.inf
        for _ in range(REGROWN):
            grown = reconstruct_scene(bodies, [seen], [start])
            lens, rms = grown.state.lenses[0], grown.rms_of(JUDGED_SHARE)
            if not is_plausible_lens(lens.model, lens.params, camera.resolution, seen.uv):
                break
            if rms < best:
                best, median, params = rms, grown.rms_of(0.5), lens.params
            if best < GOOD_RMS_PX:
                return median, params
            if not rms < WORTH_GROWING * before:
                break
            before, start = rms, replace(start, params=lens.params)
    return median, params


def is_plausible_lens(model: CameraModel, params: np.ndarray, resolution: tuple[int, int], uv: np.ndarray) -> bool:
    """Whether parameters (P,) are those of a lens: sane focal lengths, a principal point in or near the image, and rays
    for nearly all corners uv (N, 2), so that the distortion is monotone where it is used."""
    if not np.isfinite(params).all():
        return False
    middle = 0.5 * (np.array(resolution) - 1.0)
    _, _, j_point, _ = model.project_with_jacobians(params, np.array([[0.0, 0.0, 1.0]]))
    focal = np.array([j_point[0, 0, 0], j_point[0, 1, 1]])  # pixels per radian in the middle: not fx in every model
    near = np.abs(params[2:4] - middle) < (0.5 + OFF_CENTRE) * np.array(resolution)
    in_range = (focal > FOCAL_RANGE[0] * resolution[0]) & (focal < FOCAL_RANGE[1] * resolution[0])
    if not (near.all() and in_range.all() and 1.0 / MOST_STRETCHED < focal[0] / focal[1] < MOST_STRETCHED):
        return False
    _, valid = model.unproject(params, uv)
    return bool((~valid).mean() < UNSEEN_SHARE)


def _starts(target: Target, camera: Camera, stream: CornerStream) -> Iterator[CameraIntrinsics]:
    """What each body by itself says, with what the rig gives, if that can be; then each kind of lens of the model at
    several focal lengths, whatever the guess."""
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
        _, _, j_point, _ = model.project_with_jacobians(params, np.array([[0.0, 0.0, 1.0]]))
        for widths in TRIAL_WIDTHS if free[0] else TRIAL_WIDTHS[:1]:
            start = np.array([*np.full(2, widths * width / j_point[0, 0, 0]), *middle, *distortion])
            for part, parameter in zip((slice(0, 4), slice(4, None)), given, strict=True):
                if parameter.value is not None and parameter.mode != "free":
                    start[part] = parameter.value
            yield lens(start)
