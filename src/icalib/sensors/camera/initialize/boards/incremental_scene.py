"""How the bodies of a target stand to each other, and what lenses saw them, grown from one image (incremental
structure from motion, as in COLMAP; Schoenberger and Frahm 2016).

The first image places its bodies, these place further images, and so on; each time all is adjusted together. A single
small tag says little of how it leans or of the lens: many in many images do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree

from icalib.data.measurements import CornerStream
from icalib.errors import EstimationError
from icalib.geometry.cameras.base import CameraModel
from icalib.initialize.steps.target_poses import MAX_POSE_CORNERS, MAX_POSE_RMS_PX, TargetPoses
from icalib.model.bodies import Bodies
from icalib.optim.state import Key
from icalib.sensors.camera.corner_factor import Views
from icalib.sensors.camera.initialize.boards.bundle_adjustment import (
    UNSEEN_PX,
    CameraIntrinsics,
    SceneState,
    SceneViews,
    bundle_adjust,
    reprojection_errors,
)
from icalib.sensors.camera.initialize.boards.target_scene import TargetScene, multi_body_poses, view_poses

MOST_IMAGES = 60  # spread over the recording
OF_EACH_PAIR = 4  # images that tie two bodies
LEAST_KNOWN = 2  # bodies in an image, while there are images with so many
TRIAL_VIEWS = 12  # in which a place of a body is tried
SURER = 0.7  # another place is taken where it has so much of the error
LEAST_FITTING = 0.25  # of a body's views show it where it is placed, or it is not tied to the others
MOST_MISFITS = 0.25  # of the bodies
CLEARER = 0.5  # the error of the median image without misfits, over that with them, or they stay
ROUNDS = 8  # of the adjustment while the scene grows
LAST_ROUNDS = 40
AGAIN = 2  # times that all is placed anew where another place suits better
LENS_IMAGES = 5  # from so many on, the focal length and the strongest distortion are adjusted
WHOLE_LENS_IMAGES = 20  # from so many on, all of the lens is
STRONGEST = np.array([0, 1, 4])  # fx, fy and the strongest distortion


@dataclass(frozen=True)
class ReconstructedScene:
    """Where bodies stand in the scene, those that could be placed; the lenses; rms_px (M,) of each image, NaN where it
    could not be placed."""

    state: SceneState
    placed: np.ndarray
    rms_px: np.ndarray

    def rms_of(self, share: float) -> float:
        """px, which this share of the images is below; those that could not be placed count as bad."""
        return float(np.quantile(np.nan_to_num(self.rms_px, nan=UNSEEN_PX), share))

    def in_frame_of(self, reference: int, bodies: Bodies) -> dict[Key, np.ndarray]:
        """Poses in the frame of a body, as in a state."""
        R0, p0 = self.state.R_body[reference], self.state.p_body[reference]
        values: dict[Key, np.ndarray] = {}
        for k in np.flatnonzero(self.placed):
            name = bodies.target.bodies[k]
            values[name, "rotation"] = R0.T @ self.state.R_body[k]
            values[name, "translation"] = R0.T @ (self.state.p_body[k] - p0)
        return values


class UnconnectedBodiesError(EstimationError):
    """Images do not tell how some bodies, given by `names`, stand to the others."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        super().__init__(
            f"no image shows {', '.join(names)} well enough to determine its pose relative to the rest of the "
            "target; show both closer, in the same image, or remove it from the target."
        )


def place_bodies(
    bodies: Bodies, streams: Sequence[CornerStream], models: Sequence[CameraModel], params: dict[str, np.ndarray]
) -> TargetScene:
    """How the bodies stand to each other, as the images of all cameras show it; params (P,) by camera, which are held.

    Raises UnconnectedBodiesError naming those that no image ties to the others, EstimationError where these are most.
    """
    held = [fixed_lens(model, params[s.name]) for s, model in zip(streams, models, strict=True)]
    grown = reconstruct_scene(bodies, streams, held)
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
    """A lens with parameters (P,) that are not adjusted."""
    return CameraIntrinsics(model, params, params, np.ones(len(params)), np.zeros(len(params), dtype=bool))


def reconstruct_scene(
    bodies: Bodies, streams: Sequence[CornerStream], lenses: Sequence[CameraIntrinsics]
) -> ReconstructedScene:
    """The scene that images of all cameras show together, those that tell most. streams: corners of bodies in use only,
    body by body."""
    streams = [informative_images(s, bodies.target.body) for s in streams]
    growth = _Growth.begin(bodies, streams, lenses)
    if not growth.placed.any():
        return ReconstructedScene(growth.state, growth.placed, np.full(len(growth.posed), np.nan))
    while growth.extend():
        growth.adjust(ROUNDS)
    for _ in range(AGAIN):  # what was placed wrongly while little was known
        growth.adjust(ROUNDS)
        growth.extend()
    growth.adjust(ROUNDS)
    growth.adjust(LAST_ROUNDS)
    growth.drop_misfits()
    return ReconstructedScene(growth.state, growth.placed, growth.image_rms())


@dataclass
class _Growth:
    """begins (C + 1,): the first image of each camera, among those of all; placed (B,) bodies and posed (M,) images
    that have a pose; seed: the image whose frame is the scene's."""

    bodies: Bodies
    streams: Sequence[CornerStream]
    views: SceneViews
    begins: np.ndarray
    state: SceneState
    placed: np.ndarray
    posed: np.ndarray
    seed: int

    @classmethod
    def begin(cls, bodies: Bodies, streams: Sequence[CornerStream], lenses: Sequence[CameraIntrinsics]) -> _Growth:
        begins = np.cumsum([0, *(len(s.stamps_ns) for s in streams)])
        views = _views(bodies, streams, begins)
        m, b = int(begins[-1]), len(bodies.target.bodies)
        eye = np.eye(3)
        state = SceneState(np.tile(eye, (m, 1, 1)), np.zeros((m, 3)), np.tile(eye, (b, 1, 1)), np.zeros((b, 3)), ())
        found = cls(
            bodies,
            streams,
            views,
            begins,
            replace(state, lenses=tuple(lenses)),
            placed=np.zeros(b, dtype=bool),
            posed=np.zeros(m, dtype=bool),
            seed=0,
        )
        alone = found._seen_alone()
        good = np.concatenate([q.ok[:, 0] for q in alone])
        found.seed = int(np.argmax(np.bincount(views.image, good, m)))
        found.posed[found.seed] = True
        found._place_bodies(alone)
        return found

    def extend(self) -> bool:
        """Poses further images and places further bodies; False where there are none."""
        before = self.placed.sum() + self.posed.sum()
        self._pose_images()
        self._place_bodies(self._seen_alone())
        return bool(self.placed.sum() + self.posed.sum() > before)

    def adjust(self, rounds: int) -> None:
        """Everything that has a pose, and of lenses as much as so many images show."""
        used = self.views.some(self.posed[self.views.image] & self.placed[self.views.body])
        images = np.unique(used.image)
        lenses = []
        for c, lens in enumerate(self.state.lenses):
            n, free = int((self.views.camera[images] == c).sum()), np.zeros(len(lens.params), dtype=bool)
            if n >= WHOLE_LENS_IMAGES:
                free[:] = True
            elif n >= LENS_IMAGES:
                free[STRONGEST] = True
            lenses.append(replace(lens, free=free & lens.free))
        moved = bundle_adjust(used, replace(self.state, lenses=tuple(lenses)), self.seed, rounds)
        back = tuple(replace(new, free=old.free) for new, old in zip(moved.lenses, self.state.lenses, strict=True))
        self.state = replace(moved, lenses=back)

    def drop_misfits(self) -> None:
        """Takes back bodies that few of their views show where they are, if the rest then fits much better; not where
        these are many: then it is the scene that is wrong."""
        used = self.views.some(self.posed[self.views.image] & self.placed[self.views.body])
        square = reprojection_errors(used, self.state) ** 2
        square = np.add.reduceat(square, used.start[:-1]) / (2 * np.diff(used.start))
        b = len(self.placed)
        fits, count = (np.bincount(used.body, x, b) for x in (square < MAX_POSE_RMS_PX**2, None))
        misfit = self.placed & (fits < LEAST_FITTING * count)
        if not misfit.any() or misfit.sum() > MOST_MISFITS * self.placed.sum():
            return
        before = self.placed, self.state, float(np.nanmedian(self.image_rms()))
        self.placed = self.placed & ~misfit
        self.adjust(LAST_ROUNDS)
        if not np.nanmedian(self.image_rms()) < CLEARER * before[2]:
            self.placed, self.state, _ = before

    def image_rms(self) -> np.ndarray:
        """(M,) px, NaN where an image has no pose."""
        used = self.views.some(self.posed[self.views.image] & self.placed[self.views.body])
        image = used.image[used.of_corner]
        m = len(self.posed)
        square, count = (np.bincount(image, x, m) for x in (reprojection_errors(used, self.state) ** 2, None))
        return np.sqrt(square / np.where(count > 0, 2 * count, np.nan))

    def _seen_alone(self) -> list[TargetPoses]:
        """Of each camera, both poses of each view by itself."""
        own = self.bodies.target.body
        return [
            view_poses(s, Views.of(s, own), self.bodies, lens.model, lens.params)
            for s, lens in zip(self.streams, self.state.lenses, strict=True)
        ]

    def _pose_images(self) -> None:
        """Poses the images that show most bodies that are placed, as many again as have a pose; and once more those
        that another pose suits better."""
        known = np.bincount(self.views.image, self.placed[self.views.body], len(self.posed))
        wanted = np.flatnonzero(
            ~self.posed & (known >= min(LEAST_KNOWN, known[~self.posed].max(initial=0.0))) & (known > 0)
        )
        fresh = wanted[np.argsort(-known[wanted], kind="stable")][: int(self.posed.sum()) + LENS_IMAGES]
        rms, R, p = self._scene_poses()
        better = self.posed & (rms < SURER * np.nan_to_num(self.image_rms(), nan=np.inf))
        better[self.seed] = False
        better[fresh[rms[fresh] < 1e9]] = True
        R_image, p_image = self.state.R_image.copy(), self.state.p_image.copy()
        R_image[better], p_image[better] = R[better], p[better]
        self.state = replace(self.state, R_image=R_image, p_image=p_image)
        self.posed = self.posed | better

    def _scene_poses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """rms (M,), R_scene_cam, p_scene_cam of all images by the bodies that are placed."""
        placed = np.flatnonzero(self.placed)
        first = int(placed[0])
        R0, p0 = self.state.R_body[first], self.state.p_body[first]
        known = replace(self.bodies, used=tuple(placed.tolist()))
        found = ReconstructedScene(self.state, self.placed, np.empty(0))
        scene = TargetScene(known, found.in_frame_of(first, self.bodies), {})
        poses = [
            multi_body_poses(s, lens.model, lens.params, scene)
            for s, lens in zip(self.streams, self.state.lenses, strict=True)
        ]
        rms, R, p = (np.concatenate([getattr(q, name) for q in poses]) for name in ("rms_px", "rotation", "position"))
        return rms, R0 @ R, p @ R0.T + p0

    def _place_bodies(self, alone: list[TargetPoses]) -> None:
        """Places bodies that images with a pose show, and once more those that another place suits better."""
        rotation, position, ok = (
            np.concatenate([getattr(q, n) for q in alone]) for n in ("rotation", "position", "ok")
        )
        R_body, p_body, placed = self.state.R_body.copy(), self.state.p_body.copy(), self.placed.copy()
        for k in self.bodies.used:
            views = np.flatnonzero((self.views.body == k) & self.posed[self.views.image] & ok[:, 0])
            if not len(views):
                continue
            views = views[np.unique(np.linspace(0, len(views) - 1, TRIAL_VIEWS).astype(int))]
            tried = self._places(views, rotation, position, ok)
            cost = self._costs(views, *tried)
            best = int(np.argmin(cost))
            if placed[k]:
                now = self._costs(views, R_body[k][None], p_body[k][None])[0]
                if not cost[best] < SURER**2 * now:
                    continue
            R_body[k], p_body[k], placed[k] = tried[0][best], tried[1][best], True
        self.state, self.placed = replace(self.state, R_body=R_body, p_body=p_body), placed

    def _places(
        self, views: np.ndarray, rotation: np.ndarray, position: np.ndarray, ok: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """T_scene_body (n, ...) as each view by itself says, from either side."""
        v, side = np.nonzero(ok[views])
        image = self.views.image[views[v]]
        R = self.state.R_image[image] @ rotation[views[v], side].swapaxes(1, 2)
        return R, self.state.p_image[image] - np.einsum("nij,nj->ni", R, position[views[v], side])

    def _costs(self, views: np.ndarray, R: np.ndarray, p: np.ndarray) -> np.ndarray:
        """(n,) mean squared error, bounded, of places R, p of the body of `views` in these."""
        chosen = np.isin(np.arange(len(self.views.image)), views)
        seen = self.views.some(chosen)
        n, corners = len(R), len(seen.uv)
        image = np.tile(seen.image, n)
        lengths = np.tile(np.diff(seen.start), n)
        many = SceneViews(
            np.concatenate([[0], np.cumsum(lengths)]),
            image,
            np.repeat(np.arange(n), len(seen.image)),
            np.tile(seen.points, (n, 1)),
            np.tile(seen.uv, (n, 1)),
            seen.camera,
        )
        size = reprojection_errors(many, replace(self.state, R_body=R, p_body=p))
        return (size.reshape(n, corners) ** 2).mean(axis=1)


def informative_images(stream: CornerStream, body: np.ndarray) -> CornerStream:
    """Images spread over the recording, and `OF_EACH_PAIR` that show both bodies of each pair along which images tie
    bodies best (a maximum spanning forest); body (n_points,)."""
    n, m = len(stream.stamps_ns), int(body.max()) + 1
    seen = np.zeros((n, m), dtype=np.float32)
    seen[stream.image, body[stream.point]] = 1
    chosen = np.zeros(n, dtype=bool)
    chosen[np.linspace(0, n - 1, min(n, MOST_IMAGES)).astype(int)] = True
    tree = minimum_spanning_tree(-np.triu(seen.T @ seen, 1)).tocoo()
    for a, b in zip(tree.row, tree.col, strict=True):
        both = np.flatnonzero(seen[:, a] * seen[:, b])
        lacking = min(OF_EACH_PAIR, len(both)) - int(chosen[both].sum())
        if lacking > 0:
            rest = both[~chosen[both]]
            chosen[rest[np.argsort(-np.diff(stream.start)[rest], kind="stable")[:lacking]]] = True
    rows = chosen[stream.image]
    return stream.of_rows(rows, stream.stamps_ns[chosen], np.diff(stream.start)[chosen])


def _views(bodies: Bodies, streams: Sequence[CornerStream], begins: np.ndarray) -> SceneViews:
    """All views of all cameras, with up to `MAX_POSE_CORNERS` corners each."""
    own, columns = bodies.target.body, []
    for c, stream in enumerate(streams):
        views = Views.of(stream, own)
        keep = _spread_corners(views)
        count = np.add.reduceat(keep.astype(np.int64), views.start[:-1])
        points = bodies.target.points[stream.point[keep]]
        columns.append((count, views.image + begins[c], views.body, points, stream.uv[keep]))
    count, image, body, points, uv = (np.concatenate(column) for column in zip(*columns, strict=True))
    camera = np.repeat(np.arange(len(streams)), np.diff(begins))
    return SceneViews(np.concatenate([[0], np.cumsum(count)]), image, body, points, uv, camera)


def _spread_corners(views: Views) -> np.ndarray:
    """(N,) bool: at most `MAX_POSE_CORNERS` corners of each view, spread over it."""
    length = np.diff(views.start)
    place = np.arange(int(views.start[-1])) - np.repeat(views.start[:-1], length)
    length = np.repeat(length, length)
    most = np.minimum(length, MAX_POSE_CORNERS)
    return (place * most) // length != ((place - 1) * most) // length
