"""Camera poses in a scene of bodies with known poses, image by image, without an initial guess.

The pose of each body in each image is found first. A small flat body far away has two possible poses with nearly the
same projection. The other bodies in the image resolve this ambiguity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree

from icalib.base.compiled import njit
from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry.cameras.base import CameraModel
from icalib.initialize.initializer import UnusableMeasurementsError
from icalib.model.bodies import Bodies
from icalib.optim.state import Key
from icalib.rig import Rig
from icalib.sensors.camera.corner_factor import Views
from icalib.sensors.camera.initialize.bundle_adjustment import (
    INVISIBLE_ERROR_PX,
    CameraIntrinsics,
    SceneState,
    SceneViews,
    bundle_adjust,
    reprojection_errors,
)
from icalib.sensors.camera.initialize.intrinsics import STRONGEST_PARAMS
from icalib.sensors.camera.initialize.target_poses import (
    MAX_POSE_CORNERS,
    MAX_POSE_RMS_PX,
    MIN_POSE_CORNERS,
    POSE_ITERATIONS,
    FlatPoints,
    TargetPoses,
    camera_in_target,
    check_front_side,
    flat_poses,
    refine_pose,
    select_corners,
    target_poses,
    usable_rays,
)
from icalib.sensors.camera.model import without_bodies

POSES_PER_VIEW = 2  # two-fold ambiguity of a flat body: depths relative to its centre may be mirrored
NO_POSE_RMS_PX = 1e9  # px, error that marks an image without a pose


@dataclass(frozen=True)
class TargetScene:
    """Poses of the bodies of a target.

    values: R_scene_body, p_scene_body as in a state, keyed by body and parameter; the scene frame is that of the first
    body in use. params: intrinsics and distortion (P,) by camera name, with which the poses were found; empty for one
    body.
    """

    bodies: Bodies
    values: dict[Key, np.ndarray] = field(default_factory=dict)
    params: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def points(self) -> np.ndarray:
        """(n_points, 3) [m] the target's points in the scene."""
        zeros = {(name, "shape"): np.zeros(self.bodies.basis.shape[1]) for name in self.bodies.bending}
        return self.bodies.points(self.values | zeros)

    @property
    def known(self) -> np.ndarray:
        """(n_points,) bool: points of bodies that have a pose."""
        names = self.bodies.target.bodies
        has_pose = [k == self.bodies.used[0] or (names[k], "rotation") in self.values for k in range(len(names))]
        return np.array(has_pose)[self.bodies.target.body]


def view_poses(
    stream: CornerStream, views: Views, bodies: Bodies, model: CameraModel, params: np.ndarray
) -> TargetPoses:
    """Both possible poses T_body_cam (V, 2, ...) for each of V views; a view is one body in one image."""
    size = np.bincount(bodies.target.body)
    fewest = np.minimum(size, MIN_POSE_CORNERS)[views.body]
    return flat_poses(stream, views.start, fewest, model, params, bodies.target.points, POSES_PER_VIEW)


def scene_poses(stream: CornerStream, model: CameraModel, params: np.ndarray, scene: TargetScene) -> TargetPoses:
    """Camera poses in the scene, one for each image; params: (P,) intrinsics and distortion.

    Raises EstimationError if the images are mirrored (checked for targets of one body).
    """
    if not scene.bodies.several:
        poses = target_poses(stream, model, params, FlatPoints(scene.bodies.target.points))
        check_front_side(stream.name, poses)
        return poses
    return multi_body_poses(stream, model, params, scene)


def multi_body_poses(stream: CornerStream, model: CameraModel, params: np.ndarray, scene: TargetScene) -> TargetPoses:
    """Camera poses in the scene, one for each image, from all bodies that have a pose in the scene.

    params: (P,) intrinsics and distortion."""
    views = Views.of(stream, scene.bodies.target.body)
    by_view = view_poses(stream, views, scene.bodies, model, params)
    R_sb, p_sb = scene.bodies.poses(scene.values)
    rays, density, good = usable_rays(stream.uv, model, params)
    n = len(stream.stamps_ns)
    rotation, position = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    rms, per_px = np.full(n, NO_POSE_RMS_PX), np.zeros(n)
    first_view = np.searchsorted(views.image, np.arange(n + 1))
    _best_poses(
        stream.start,
        stream.point,
        rays,
        density,
        good & scene.known[stream.point],
        scene.points,
        first_view,
        views.body,
        by_view.rotation,
        by_view.position,
        by_view.ok,
        R_sb,
        p_sb,
        rotation,
        position,
        rms,
        per_px,
    )
    return TargetPoses(rotation, position, rms < MAX_POSE_RMS_PX, rms, per_px)


@njit(cache=True, nogil=True)
def _compose(R_ab, p_ab, R_bc, p_bc, R_ac, p_ac):
    """Writes the pose T_a_c = T_a_b T_b_c into R_ac (3, 3) and p_ac (3,) m."""
    for a in range(3):
        p_ac[a] = p_ab[a]
        for b in range(3):
            p_ac[a] += R_ab[a, b] * p_bc[b]
            R_ac[a, b] = 0.0
            for c in range(3):
                R_ac[a, b] += R_ab[a, c] * R_bc[c, b]


@njit(cache=True, nogil=True, error_model="numpy")
def _best_poses(
    start, point, rays, density, good, scene_points, first, body, R_bc, p_bc, ok, R_sb, p_sb, rotation, position, rms,
    per_px,
):  # fmt: skip
    """Writes camera poses in the scene and errors of M images: rotation (M, 3, 3), position (M, 3) m, rms (M,) px,
    per_px (M,) m, see `TargetPoses`.

    Candidates are the poses T_body_cam of the views, R_bc, p_bc, ok (V, 2, ...), composed with T_scene_body, R_sb,
    p_sb. The candidate with the least error over all corners of the image is refined on all of them."""
    points, observed = np.empty((MAX_POSE_CORNERS, 3)), np.empty((MAX_POSE_CORNERS, 3))
    R, t, trial_R, trial_t = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    R_sc, p_sc = np.empty((3, 3)), np.empty(3)
    for i in range(len(start) - 1):
        count = select_corners(start[i], start[i + 1], point, rays, density, good, scene_points, points, observed)
        best = NO_POSE_RMS_PX
        for v in range(first[i], first[i + 1]):
            for side in range(R_bc.shape[1]):
                if count < 4 or not ok[v, side]:
                    continue
                _compose(R_sb[body[v]], p_sb[body[v]], R_bc[v, side], p_bc[v, side], R_sc, p_sc)
                camera_in_target(R_sc, p_sc, trial_R, trial_t)
                error = refine_pose(points[:count], observed[:count], trial_R.copy(), trial_t.copy(), 1)[0]
                if error < best:
                    best = error
                    R[:], t[:] = trial_R, trial_t
        if best < NO_POSE_RMS_PX:
            rms[i], per_px[i] = refine_pose(points[:count], observed[:count], R, t, POSE_ITERATIONS)
            if rms[i] < NO_POSE_RMS_PX:
                camera_in_target(R, t, rotation[i], position[i])
            else:
                rms[i] = NO_POSE_RMS_PX


# Incremental structure from motion: relative poses of the bodies of a target, and intrinsics of the cameras.
#
# As in COLMAP (Schoenberger and Frahm 2016): poses are found of the bodies in a first image, then of images that show
# these bodies, then of further bodies, and so on. A bundle adjustment follows each round. One small tag alone
# determines neither its tilt nor the intrinsics; many tags in many images do.
#
# Selects the images and corners from which a scene of several bodies is reconstructed.

MIN_PLACED_BODIES = 2  # in an image whose pose is found next, if possible; one flat body alone has two possible poses
MAX_TRIAL_VIEWS = 12  # views of a body in which candidates for its pose are compared
MAX_REPLACEMENT_RATIO = 0.7  # error of a new pose over that of the present pose, below which it replaces the latter
MIN_FITTING_SHARE = 0.25  # of the views of a body; if its pose explains fewer, the body is a misfit
MAX_MISFIT_SHARE = 0.25  # of the bodies; with more misfits the scene itself is likely wrong, so all are kept
MAX_ERROR_WITHOUT_MISFITS = 0.5  # median image error without misfits over that with them; above, misfits are kept
GROWTH_STEPS, FINAL_STEPS = 8, 40  # largest number of bundle adjustment steps, while the scene grows and at its end
REPLACEMENT_PASSES = 2  # searches for better poses at the end, because the first poses were found from few images
MIN_FOCAL_IMAGES = 5  # of a camera, to adjust focal lengths and first distortion; fewer images fit any focal length
MIN_DISTORTION_IMAGES = 20  # images of a camera that are needed to adjust all its parameters


@dataclass(frozen=True)
class ReconstructedScene:
    """Poses of bodies and images, and intrinsics of the cameras.

    placed: (B,) bool, bodies that have a pose; rms_px: (M,) RMS reprojection error of each image, NaN without a pose.
    """

    state: SceneState
    placed: np.ndarray
    rms_px: np.ndarray

    def rms_of(self, share: float) -> float:
        """The quantile `share` of the errors of images [px]; images without a pose have `INVISIBLE_ERROR_PX`."""
        return float(np.quantile(np.nan_to_num(self.rms_px, nan=INVISIBLE_ERROR_PX), share))

    def in_frame_of(self, reference: int, bodies: Bodies) -> dict[Key, np.ndarray]:
        """Poses of all placed bodies in the frame of the body number `reference`, keyed by body and parameter."""
        R0, p0 = self.state.R_body[reference], self.state.p_body[reference]
        values: dict[Key, np.ndarray] = {}
        for k in np.flatnonzero(self.placed):
            name = bodies.target.bodies[k]
            values[name, "rotation"] = R0.T @ self.state.R_body[k]
            values[name, "translation"] = R0.T @ (self.state.p_body[k] - p0)
        return values


class UnconnectedBodiesError(UnusableMeasurementsError):
    """The poses of the bodies `names` relative to the rest of the target are unobservable: no image connects them."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        super().__init__(
            f"no image shows {', '.join(names)} well enough to determine its pose relative to the rest of the "
            "target; show both closer, in the same image, or remove it from the target."
        )

    def usable(self, rig: Rig, recording: Measurements) -> Measurements:
        """The recording without corners of these bodies."""
        return without_bodies(rig.target, self.names, recording)


def place_bodies(
    bodies: Bodies, streams: Sequence[CornerStream], models: Sequence[CameraModel], params: dict[str, np.ndarray]
) -> TargetScene:
    """Relative poses of the bodies in use, from the images of all cameras.

    params: fixed intrinsics and distortion (P,) by camera name. Raises UnconnectedBodiesError naming bodies that no
    image connects with the others; EstimationError if these are more than half of the bodies.
    """
    lenses = [fixed_lens(model, params[s.name]) for s, model in zip(streams, models, strict=True)]
    grown = reconstruct_scene(bodies, streams, lenses)
    lost = tuple(bodies.target.bodies[k] for k in bodies.used if not grown.placed[k])
    if 2 * len(lost) > len(bodies.used):
        raise EstimationError(
            f"images determine the relative poses of only {len(bodies.used) - len(lost)} of the "
            f"{len(bodies.used)} bodies of the target; check the resolution and intrinsics of cameras and the "
            "sizes of the target."
        )
    if lost:
        raise UnconnectedBodiesError(lost)
    values = grown.in_frame_of(bodies.used[0], bodies)
    reference = bodies.target.bodies[bodies.used[0]]
    return TargetScene(bodies, {key: value for key, value in values.items() if key[0] != reference}, params)


def fixed_lens(model: CameraModel, params: np.ndarray) -> CameraIntrinsics:
    """Intrinsics and distortion, params (P,), that are not adjusted."""
    return CameraIntrinsics(model, params, params, np.ones(len(params)), np.zeros(len(params), dtype=bool))


def reconstruct_scene(
    bodies: Bodies, streams: Sequence[CornerStream], lenses: Sequence[CameraIntrinsics]
) -> ReconstructedScene:
    """The scene from the most informative images of all cameras.

    streams: corners of bodies in use only, sorted by image and body; lenses: start values for each camera.
    """
    streams = [informative_images(s, bodies.target.body) for s in streams]
    scene = _GrowingScene.begin(bodies, streams, lenses)
    if not scene.placed.any():
        return ReconstructedScene(scene.state, scene.placed, np.full(len(scene.posed), np.nan))
    while scene.extend():
        scene.adjust(GROWTH_STEPS)
    for _ in range(REPLACEMENT_PASSES):
        scene.adjust(GROWTH_STEPS)
        scene.extend()
    scene.adjust(GROWTH_STEPS)
    scene.adjust(FINAL_STEPS)
    scene.drop_misfits()
    return ReconstructedScene(scene.state, scene.placed, scene.image_rms())


@dataclass
class _GrowingScene:
    """A scene that is reconstructed image by image.

    begins: (C + 1,) number of the first image of each camera, then the number of all images. placed (B,), posed (M,):
    bool, bodies and images that have a pose. seed: number of the image whose camera frame is the scene frame.
    """

    bodies: Bodies
    streams: Sequence[CornerStream]
    views: SceneViews
    begins: np.ndarray
    state: SceneState
    placed: np.ndarray
    posed: np.ndarray
    seed: int

    @classmethod
    def begin(
        cls, bodies: Bodies, streams: Sequence[CornerStream], lenses: Sequence[CameraIntrinsics]
    ) -> _GrowingScene:
        """The scene of one image, the seed, which shows most bodies with a pose, and of these bodies."""
        begins = np.cumsum([0, *(len(s.stamps_ns) for s in streams)])
        views = scene_views(bodies, streams, begins)
        m, b = int(begins[-1]), len(bodies.target.bodies)
        eye = np.eye(3)
        state = SceneState(np.tile(eye, (m, 1, 1)), np.zeros((m, 3)), np.tile(eye, (b, 1, 1)), np.zeros((b, 3)), ())
        scene = cls(
            bodies,
            streams,
            views,
            begins,
            replace(state, lenses=tuple(lenses)),
            placed=np.zeros(b, dtype=bool),
            posed=np.zeros(m, dtype=bool),
            seed=0,
        )
        by_view = scene._poses_by_view()
        good = np.concatenate([q.ok[:, 0] for q in by_view])
        scene.seed = int(np.argmax(np.bincount(views.image, good, m)))
        scene.posed[scene.seed] = True
        scene._place_bodies(by_view)
        return scene

    def extend(self) -> bool:
        """Finds poses of further images, then of further bodies. Returns False if none were found."""
        before = self.placed.sum() + self.posed.sum()
        self._pose_images()
        self._place_bodies(self._poses_by_view())
        return bool(self.placed.sum() + self.posed.sum() > before)

    def adjust(self, max_steps: int) -> None:
        """Bundle adjustment of all poses, and of as many intrinsics as the number of images determines."""
        used = self.views.select(self.posed[self.views.image] & self.placed[self.views.body])
        images = np.unique(used.image)
        lenses = []
        for c, lens in enumerate(self.state.lenses):
            n, free = int((self.views.camera[images] == c).sum()), np.zeros(len(lens.params), dtype=bool)
            if n >= MIN_DISTORTION_IMAGES:
                free[:] = True
            elif n >= MIN_FOCAL_IMAGES:
                free[STRONGEST_PARAMS] = True
            lenses.append(replace(lens, free=free & lens.free))
        moved = bundle_adjust(used, replace(self.state, lenses=tuple(lenses)), self.seed, max_steps)
        restored = tuple(replace(new, free=old.free) for new, old in zip(moved.lenses, self.state.lenses, strict=True))
        self.state = replace(moved, lenses=restored)

    def drop_misfits(self) -> None:
        """Removes bodies whose pose explains few of their views, if the error of the scene then decreases clearly.

        Keeps all if many bodies are misfits, because the scene itself is then likely wrong.
        """
        used = self.views.select(self.posed[self.views.image] & self.placed[self.views.body])
        square = reprojection_errors(used, self.state) ** 2
        square = np.add.reduceat(square, used.start[:-1]) / (2 * np.diff(used.start))
        b = len(self.placed)
        fits, count = (np.bincount(used.body, x, b) for x in (square < MAX_POSE_RMS_PX**2, None))
        misfit = self.placed & (fits < MIN_FITTING_SHARE * count)
        if not misfit.any() or misfit.sum() > MAX_MISFIT_SHARE * self.placed.sum():
            return
        before = self.placed, self.state, float(np.nanmedian(self.image_rms()))
        self.placed = self.placed & ~misfit
        self.adjust(FINAL_STEPS)
        if not np.nanmedian(self.image_rms()) < MAX_ERROR_WITHOUT_MISFITS * before[2]:
            self.placed, self.state, _ = before

    def image_rms(self) -> np.ndarray:
        """(M,) [px] RMS reprojection error of each image, NaN without a pose."""
        used = self.views.select(self.posed[self.views.image] & self.placed[self.views.body])
        image = used.image[used.of_corner]
        m = len(self.posed)
        square, count = (np.bincount(image, x, m) for x in (reprojection_errors(used, self.state) ** 2, None))
        return np.sqrt(square / np.where(count > 0, 2 * count, np.nan))

    def _poses_by_view(self) -> list[TargetPoses]:
        """For each camera the two possible poses T_body_cam (V, 2, ...) of each view, found from that view alone."""
        body = self.bodies.target.body
        return [
            view_poses(s, Views.of(s, body), self.bodies, lens.model, lens.params)
            for s, lens in zip(self.streams, self.state.lenses, strict=True)
        ]

    def _pose_images(self) -> None:
        """Finds poses of the images that show most placed bodies; at most about doubles the posed images.

        Replaces poses of other images, except that of the seed, if new poses fit clearly better.
        """
        known = np.bincount(self.views.image, self.placed[self.views.body], len(self.posed))
        wanted = np.flatnonzero(
            ~self.posed & (known >= min(MIN_PLACED_BODIES, known[~self.posed].max(initial=0.0))) & (known > 0)
        )
        fresh = wanted[np.argsort(-known[wanted], kind="stable")][: int(self.posed.sum()) + MIN_FOCAL_IMAGES]
        rms, R, p = self._scene_poses()
        better = self.posed & (rms < MAX_REPLACEMENT_RATIO * np.nan_to_num(self.image_rms(), nan=np.inf))
        better[self.seed] = False
        better[fresh[rms[fresh] < NO_POSE_RMS_PX]] = True
        R_image, p_image = self.state.R_image.copy(), self.state.p_image.copy()
        R_image[better], p_image[better] = R[better], p[better]
        self.state = replace(self.state, R_image=R_image, p_image=p_image)
        self.posed = self.posed | better

    def _scene_poses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """RMS error (M,) [px], R_scene_cam (M, 3, 3), p_scene_cam (M, 3) [m] of all images, from the placed bodies."""
        placed = np.flatnonzero(self.placed)
        first = int(placed[0])
        R0, p0 = self.state.R_body[first], self.state.p_body[first]
        known = replace(self.bodies, used=tuple(placed.tolist()))
        reconstruction = ReconstructedScene(self.state, self.placed, np.empty(0))
        scene = TargetScene(known, reconstruction.in_frame_of(first, self.bodies), {})
        poses = [
            multi_body_poses(s, lens.model, lens.params, scene)
            for s, lens in zip(self.streams, self.state.lenses, strict=True)
        ]
        rms, R, p = (np.concatenate([getattr(q, name) for q in poses]) for name in ("rms_px", "rotation", "position"))
        return rms, R0 @ R, p @ R0.T + p0

    def _place_bodies(self, by_view: list[TargetPoses]) -> None:
        """Finds poses of the bodies in images with a pose. Replaces present poses if new ones fit clearly better.

        by_view: for each camera the poses T_body_cam (V, 2, ...) of its views.
        """
        rotation, position, ok = (
            np.concatenate([getattr(q, n) for q in by_view]) for n in ("rotation", "position", "ok")
        )
        R_body, p_body, placed = self.state.R_body.copy(), self.state.p_body.copy(), self.placed.copy()
        for k in self.bodies.used:
            views = np.flatnonzero((self.views.body == k) & self.posed[self.views.image] & ok[:, 0])
            if not len(views):
                continue
            views = views[np.unique(np.linspace(0, len(views) - 1, MAX_TRIAL_VIEWS).astype(int))]
            R, p = self._body_poses(views, rotation, position, ok)
            cost = self._costs(views, R, p)
            best = int(np.argmin(cost))
            if placed[k]:
                present = self._costs(views, R_body[k][None], p_body[k][None])[0]
                if not cost[best] < MAX_REPLACEMENT_RATIO**2 * present:
                    continue
            R_body[k], p_body[k], placed[k] = R[best], p[best], True
        self.state, self.placed = replace(self.state, R_body=R_body, p_body=p_body), placed

    def _body_poses(
        self, views: np.ndarray, rotation: np.ndarray, position: np.ndarray, ok: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Candidates R_scene_body (n, 3, 3), p_scene_body (n, 3) [m] for one body: up to two from each of `views`."""
        v, side = np.nonzero(ok[views])
        image = self.views.image[views[v]]
        R = self.state.R_image[image] @ rotation[views[v], side].swapaxes(1, 2)
        return R, self.state.p_image[image] - np.einsum("nij,nj->ni", R, position[views[v], side])

    def _costs(self, views: np.ndarray, R: np.ndarray, p: np.ndarray) -> np.ndarray:
        """(n,) mean squared error [px^2] in `views` of one body for each of its candidate poses R, p (n, ...)."""
        observed = self.views.select(np.isin(np.arange(len(self.views.image)), views))
        n, corners = len(R), len(observed.uv)
        image = np.tile(observed.image, n)
        lengths = np.tile(np.diff(observed.start), n)
        repeated = SceneViews(
            np.concatenate([[0], np.cumsum(lengths)]),
            image,
            np.repeat(np.arange(n), len(observed.image)),
            np.tile(observed.points, (n, 1)),
            np.tile(observed.uv, (n, 1)),
            observed.camera,
        )
        error = reprojection_errors(repeated, replace(self.state, R_body=R, p_body=p))
        return (error.reshape(n, corners) ** 2).mean(axis=1)


MAX_SCENE_IMAGES = 60  # of a camera, spread over the recording; the cost of bundle adjustment grows with the number
IMAGES_PER_PAIR = 4  # images of each pair of bodies in the spanning tree, so that one bad image does not separate them


def informative_images(stream: CornerStream, body: np.ndarray) -> CornerStream:
    """Images spread over the recording, and images that connect the bodies; body: (n_points,) the body of each point.

    In the graph of bodies, the weight of an edge is the number of images that show both bodies. For each edge of the
    maximum spanning forest, at least `IMAGES_PER_PAIR` images with both bodies are used, if there are so many.
    """
    n, m = len(stream.stamps_ns), int(body.max()) + 1
    shows = np.zeros((n, m), dtype=np.float32)
    shows[stream.image, body[stream.point]] = 1
    chosen = np.zeros(n, dtype=bool)
    chosen[np.linspace(0, n - 1, min(n, MAX_SCENE_IMAGES)).astype(int)] = True
    tree = minimum_spanning_tree(-np.triu(shows.T @ shows, 1)).tocoo()
    for a, b in zip(tree.row, tree.col, strict=True):
        both = np.flatnonzero(shows[:, a] * shows[:, b])
        lacking = min(IMAGES_PER_PAIR, len(both)) - int(chosen[both].sum())
        if lacking > 0:
            rest = both[~chosen[both]]
            chosen[rest[np.argsort(-np.diff(stream.start)[rest], kind="stable")[:lacking]]] = True
    rows = chosen[stream.image]
    return stream.of_rows(rows, stream.stamps_ns[chosen], np.diff(stream.start)[chosen])


def scene_views(bodies: Bodies, streams: Sequence[CornerStream], begins: np.ndarray) -> SceneViews:
    """All views of all cameras, with up to `MAX_POSE_CORNERS` corners each.

    begins: (C + 1,) number of the first image of each camera, then the number of all images.
    """
    columns = []
    for c, stream in enumerate(streams):
        views = Views.of(stream, bodies.target.body)
        keep = _spread_corners(views)
        count = np.add.reduceat(keep.astype(np.int64), views.start[:-1])
        points = bodies.target.points[stream.point[keep]]
        columns.append((count, views.image + begins[c], views.body, points, stream.uv[keep]))
    count, image, body, points, uv = (np.concatenate(column) for column in zip(*columns, strict=True))
    camera = np.repeat(np.arange(len(streams)), np.diff(begins))
    return SceneViews(np.concatenate([[0], np.cumsum(count)]), image, body, points, uv, camera)


def _spread_corners(views: Views) -> np.ndarray:
    """(N,) bool: selects at most `MAX_POSE_CORNERS` corners of each view, evenly spaced in its list of corners."""
    length = np.diff(views.start)
    place = np.arange(int(views.start[-1])) - np.repeat(views.start[:-1], length)
    length = np.repeat(length, length)
    most = np.minimum(length, MAX_POSE_CORNERS)
    return (place * most) // length != ((place - 1) * most) // length
