"""Intrinsics of cameras, and relative poses of bodies, from a target of several bodies.

One small tag alone determines neither well. A reconstruction of the scene from all bodies together determines both.

Relative poses of bodies that no image shows together, but that two cameras of a rig see at the same instants.

Cameras a and b of a rig see the bodies A and B, which do not move. At each instant i

    T_A_a(i) T_a_b = T_A_B T_B_b(i),

which is the equation AX = YB of robot-world/hand-eye calibration (Zhuang, Roth, Sudhakar 1994; Shah 2013).

Detects bodies of a target that were moved relative to each other between recordings.

The reprojection error of each recording in the common scene is compared with the errors in scenes that are
reconstructed from single recordings. Errors of lens and target increase all of them. Moved bodies increase only the
error in the common scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.targets.base import Target
from icalib.initialize.hand_eye import MAX_UNEXPLAINED_MOTION, PosePairs, hand_eye, unexplained_motion
from icalib.model.bodies import Bodies
from icalib.motion.factor import Extrinsics, Frame
from icalib.optim.state import Key
from icalib.rig import Camera, Rig
from icalib.sensors.camera.corner_noise import MIN_CORNER_NOISE_PX
from icalib.sensors.camera.initialize.bundle_adjustment import CameraIntrinsics
from icalib.sensors.camera.initialize.intrinsics import camera_params
from icalib.sensors.camera.initialize.target_poses import TargetPoses
from icalib.sensors.camera.initialize.target_scene import (
    TargetScene,
    UnconnectedBodiesError,
    fixed_lens,
    multi_body_poses,
    place_bodies,
    reconstruct_scene,
    scene_poses,
)
from icalib.sensors.camera.model import (
    MIN_SHARED_IMAGES,
    camera_times,
    choose_bodies,
    restrict,
    taken_at_once,
    tied_by_images,
)

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


def register_groups(
    rig: Rig, bodies: Bodies, recordings: Sequence[Measurements], params: dict[str, np.ndarray]
) -> TargetScene:
    """Poses of all bodies: within groups that images connect, then between groups by simultaneous images.

    params: fixed intrinsics and distortion (P,) by camera name. Raises UnconnectedBodiesError naming bodies that are
    not connected to the first group; EstimationError if images are mirrored, or cameras are not rigidly connected.
    """
    used = tied_by_images(bodies, recordings)
    groups = [_Group.of(rig, replace(bodies, used=indices), recordings, params) for indices in used]
    values, frames = dict(groups[0].scene.values), {0: Frame(np.eye(3), np.zeros(3))}
    while len(frames) < len(groups):
        tied = [(g, h, _tied(groups[g], groups[h])) for g in frames for h in range(len(groups)) if h not in frames]
        g, h, best = max(tied, key=lambda item: len(item[2].pairs.p_body))
        if len(best.pairs.p_body) < MIN_SHARED_IMAGES:
            lost = [x.scene.bodies.names for k, x in enumerate(groups) if k not in frames]
            raise UnconnectedBodiesError(tuple(name for names in lost for name in names))
        T_g_h = _solved(best, rig.cameras)
        frames[h] = Frame(frames[g].R @ T_g_h.R, frames[g].p + frames[g].R @ T_g_h.p)
        values |= groups[h].values_at(frames[h])
    return TargetScene(bodies, values, params)


@dataclass(frozen=True)
class _Group:
    """Bodies that images connect, in the frame of the first one.

    times, poses: for each recording and camera, instants (M,) [s] of the images that show these bodies, and the poses
    of the camera in the frame of the group.
    """

    scene: TargetScene
    times: list[list[np.ndarray]]
    poses: list[list[TargetPoses]]

    @classmethod
    def of(cls, rig: Rig, bodies: Bodies, recordings: Sequence[Measurements], params: dict[str, np.ndarray]) -> _Group:
        """The group of `bodies`, with camera poses in all `recordings`.

        params: (P,) intrinsics and distortion by camera name."""
        restricted = [restrict(bodies, r) for r in recordings]
        models = [camera_model(c.model) for c in rig.cameras]
        scene = TargetScene(bodies)
        if bodies.several:
            seeing = [i for i in range(len(models)) if any(len(r.cameras[i].point) for r in restricted)]
            streams = [CornerStream.joined([r.cameras[i] for r in restricted]) for i in seeing]
            scene = place_bodies(bodies, streams, [models[i] for i in seeing], params)
        times = [camera_times(rig, r, recording.origin_ns) for r, recording in zip(restricted, recordings, strict=True)]
        poses = [
            [scene_poses(s, m, params[s.name], scene) for s, m in zip(r.cameras, models, strict=True)]
            for r in restricted
        ]
        return cls(scene, times, poses)

    def values_at(self, frame: Frame) -> dict[Key, np.ndarray]:
        """Poses T_scene_body of the bodies as in a state, for the pose `frame` of the group in the scene."""
        R, p = self.scene.bodies.poses(self.scene.values)
        values: dict[Key, np.ndarray] = {}
        for k, name in zip(self.scene.bodies.used, self.scene.bodies.names, strict=True):
            values[name, "rotation"], values[name, "translation"] = frame.R @ R[k], frame.R @ p[k] + frame.p
        return values


@dataclass(frozen=True)
class _Tied:
    """Poses of camera number `a` in one group, and of camera number `b` in another, at the same instants."""

    a: int
    b: int
    pairs: PosePairs


def _tied(g: _Group, h: _Group) -> _Tied:
    """The poses of the pair of cameras that has most simultaneous images of the groups `g` and `h`."""
    cameras = permutations(range(len(g.poses[0])), 2)
    return max((_Tied(a, b, _pairs(g, h, a, b)) for a, b in cameras), key=lambda t: len(t.pairs.p_body))


def _pairs(g: _Group, h: _Group, a: int, b: int) -> PosePairs:
    """Simultaneous poses of camera `a` in group `g` and of camera `b` in group `h`, from all recordings."""
    poses = []
    for times_g, poses_g, times_h, poses_h in zip(g.times, g.poses, h.times, h.poses, strict=True):
        i, j = taken_at_once(times_g[a], times_h[b])
        good = poses_g[a].ok[i] & poses_h[b].ok[j]
        i, j = i[good], j[good]
        poses.append((poses_g[a].rotation[i], poses_g[a].position[i], poses_h[b].rotation[j], poses_h[b].position[j]))
    return PosePairs(*(np.concatenate(x) for x in zip(*poses, strict=True)))


def _solved(tied: _Tied, cameras: Sequence[Camera]) -> Frame:
    """Pose of the second group in the first, by hand-eye calibration.

    Raises EstimationError if the cameras are not rigidly connected."""
    a, b = cameras[tied.a], cameras[tied.b]
    solution = hand_eye(tied.pairs, _given(a, b, tied.a == 0, tied.b == 0), (False, False))
    if (left := unexplained_motion(tied.pairs, solution)) > MAX_UNEXPLAINED_MOTION:
        raise EstimationError(
            f"{a.name} and {b.name} see different bodies of the target and do not move alike: {left:.0%} of "
            "the motion is unexplained; check that the bodies stand still, and that one clock stamps both "
            "cameras."
        )
    return solution.frame


def _given(a: Camera, b: Camera, a_is_body: bool, b_is_body: bool) -> Extrinsics | None:
    """T_a_b if the rig file has the extrinsics of both cameras, else None. Those of the reference are the identity."""
    mounts = []
    for camera, is_body in ((a, a_is_body), (b, b_is_body)):
        R, p = camera.rotation.value, camera.translation.value
        if is_body:
            R, p = np.eye(3), np.zeros(3)
        if R is None or p is None:
            return None
        mounts.append(Extrinsics(R, p))
    one, other = mounts
    return Extrinsics(one.R.T @ other.R, one.R.T @ (other.p - one.p))


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
