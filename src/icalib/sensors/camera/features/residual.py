"""Points of the scene, of unknown position, as the cameras follow them (paper (20)-(22)).

residual = K(R_cam_world (P - p_world_cam)) - uv

Points are no part of the state: at every linearisation each is moved to where the poses and the calibration want it
(variable projection), so that the cost is the least over all points. Their columns are eliminated with the keyframes
that saw them (`front.py`). Those that lie on planes of the LiDARs have a row for that, too (`surfaces.py`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.motion.factor import FactorDefaults, FactorKey, FitKey, RawSize, ResidualRows, Squares, StateDifference
from icalib.motion.imu_data import ImuData
from icalib.motion.time_offsets import clock_numbers
from icalib.optim.arrowhead import Piece
from icalib.optim.front import PieceFeatures
from icalib.optim.front_plan import FeatureSums, plan
from icalib.optim.medians import median_variance
from icalib.optim.planes import Planes
from icalib.optim.robust_weights import LOSSES, Loss
from icalib.optim.state import Layout, State
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.camera_images import View
from icalib.sensors.camera.features.cluster_kernels import accumulate_clusters
from icalib.sensors.camera.features.kernels import (
    Points,
    Range,
    Seen,
    accumulate,
    add_rays,
    held_back,
    take_trials,
)
from icalib.sensors.camera.features.statistics import (
    FeatureOutput,
    feature_rows,
    feature_sizes,
    feature_squares,
    spent_by_features,
)
from icalib.sensors.camera.features.surfaces import (
    NOWHERE,
    Distances,
    OnPlanes,
    Surfaces,
    add_planes_to_points,
    add_points_on_planes,
)
from icalib.sensors.camera.features.tracks import NO_TRACKS, Sightings, TrackNoise, Tracks

MOST_STEPS = 20  # of a point; most settle in three
WEAK = 1e-6  # information [1/m^2]: keeps a point defined that no image shows any more; steers nothing else
LONGEST_GAP_S = 1.0  # a feature that was out of sight for longer is a new track
MOST_UNCERTAIN = 0.1  # of its distance: a point that is less certain is left out
MOST_UNLIKE = 10.0  # times the residuals of most points: a point that fits worse is left out


@dataclass(frozen=True)
class FeatureFactor(FactorDefaults):
    """All features of all cameras. cameras: their poses and models; streams: one per camera, on its images; noise: of
    each camera's observations; keep: (N,) by camera, observations in use; seams: keyframes at which further recordings
    begin; surfaces: planes that points may lie on, and which tracks are on them."""

    cameras: tuple[CornerFactor, ...]
    streams: tuple[TrackStream, ...]
    noise: tuple[TrackNoise, ...]
    keep: tuple[np.ndarray, ...]
    loss: str
    loss_scale: float
    tracks: Tracks
    layout: Layout
    seams: tuple[int, ...] = ()
    surfaces: Surfaces | None = None
    on: OnPlanes = NOWHERE
    outliers: tuple[np.ndarray, ...] = ()  # (N,) bool by camera; () before any were judged

    @classmethod
    def build(
        cls,
        cameras: tuple[CornerFactor, ...],
        streams: tuple[TrackStream, ...],
        noise: tuple[TrackNoise, ...],
        keep: tuple[np.ndarray, ...],
        loss: tuple[str, float],
        state: State,
        cuts: tuple[int, ...],
        seams: tuple[int, ...] = (),
        surfaces: Surfaces | None = None,
    ) -> FeatureFactor:
        """Tracks chosen, and points first looked for, with the poses of `state`; the chain is cut at keyframes
        `cuts`."""
        factor = cls(cameras, streams, noise, keep, loss[0], loss[1], NO_TRACKS, cameras[0].layout, seams, surfaces)
        return factor.cut(state, cuts)

    ties_distant_keyframes: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Of all cameras: a track is one feature that several may see."""
        return "cameras"

    @property
    def key(self) -> FactorKey:
        return self.name, "features"

    @cached_property
    def sigmas(self) -> tuple[np.ndarray, ...]:
        """(N,) px, by camera: of each observation, per axis."""
        return tuple(noise.of(stream) for noise, stream in zip(self.noise, self.streams, strict=True))

    @property
    def n_keyframes(self) -> int:
        return self.cameras[0].n_keyframes

    @property
    def followed(self) -> int:
        """How many observations take part."""
        return sum(int((t >= 0).sum()) for t in self.tracks.track)

    def cut(self, state: State, keyframes: tuple[int, ...]) -> FeatureFactor:
        """The same features as tracks that end at `keyframes`. A track is left out whose point the poses of `state` do
        not find where all its images can show it, whose distance they leave uncertain, or that fits far worse than
        most."""
        edges = np.unique([0, *keyframes, *self.seams, self.n_keyframes])
        sightings = self._sightings()
        label = sightings.in_order(sightings.labels(state.seconds, edges, LONGEST_GAP_S))
        tracks = sightings.tracks(label, edges)
        factor = replace(self, tracks=tracks, on=OnPlanes.none(tracks.count))
        points, good, on = factor._triangulated(state)
        label = np.where(label >= 0, np.where(np.append(good, False)[label], label, -1), -1)
        number = np.append(np.where(good, np.cumsum(good) - 1, -1), -1)
        tracks = sightings.tracks(number[label], edges)
        return replace(factor, tracks=replace(tracks, start=points[good]), on=on)

    def _triangulated(self, state: State) -> tuple[np.ndarray, np.ndarray, OnPlanes]:
        """Points (T, 3) in the frames of the cameras that they move with, from the rays with the poses of `state`;
        whether each is certain enough; and of those that are, the planes that they lie on."""
        views, n = self._views(state, 0, self.n_keyframes), self.tracks.count
        A, b = np.tile(1e-9 * np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        for view in views:
            rays, valid = view.camera.model.unproject(view.params, view.seen.uv)
            at = view.poses
            add_rays(view.seen, 0, at.R_sensor_world, at.p_world_sensor, rays, valid, A, b)
        found = self._descend(views, np.linalg.solve(A, b[:, :, None])[:, :, 0], slice(0, n), None)
        points = self._in_anchors(views, found.xyz, slice(0, n))
        distance = np.linalg.norm(points, axis=1)
        information = np.linalg.eigvalsh(found.A)[:, 0]
        seen = sum(
            (np.bincount(t[(t >= 0) & k], minlength=n) for t, k in zip(self.tracks.track, self.keep, strict=True)),
            np.zeros(n, dtype=np.int64),
        )
        square = found.cost / np.maximum(seen, 1)
        whole = found.shown == seen
        fits = square <= MOST_UNLIKE**2 * np.median(square[whole] if whole.any() else 0.0) + MOST_UNLIKE
        certain = information * (MOST_UNCERTAIN * distance) ** 2 > 1.0
        good = np.isfinite(points).all(axis=1) & whole & fits & certain
        if self.surfaces is None:
            return points, good, OnPlanes.none(int(good.sum()))
        recording = np.searchsorted(state.starts, self.tracks.stretch_of()[good], side="right") - 1
        return points, good, self.surfaces.under(found.xyz[good], found.A[good], recording)

    def coarse(self, state: State) -> FeatureFactor:
        """The same features, their noise as large as most errors with the poses of `state` and a guessed lens. Taken as
        exact, what fits by chance would draw the lens far from its guess, where other tracks are lost."""
        views = self._views(state, 0, self.n_keyframes)
        points = self._from_anchors(views, slice(0, self.tracks.count), self.tracks.start)
        noise = list(self.noise)
        for view in views:
            uv, valid, *_ = view.camera.model.project_with_jacobians(view.params, view.in_camera(points, 0))
            used = valid & (view.seen.track >= 0) & view.seen.keep
            if used.any():
                variance = median_variance(((uv - view.seen.uv)[used] ** 2).sum(axis=1))
                if variance > noise[view.index].sigma ** 2:
                    noise[view.index] = TrackNoise(float(np.sqrt(variance)))
        return replace(self, noise=tuple(noise))

    def on_planes_of(self, camera: int) -> np.ndarray:
        """Those tracks on planes whose points move with camera number `camera`."""
        return np.flatnonzero((self.on.plane >= 0) & (self.tracks.camera == camera))

    def output(self) -> FeatureOutput:
        """Empty arrays for `accumulate` to fill."""
        sizes = [len(s.uv) for s in self.streams]
        points = self.tracks.count
        return FeatureOutput(
            tuple(np.zeros((n, 2)) for n in sizes), tuple(np.zeros(n) for n in sizes), np.zeros((points, 3)),
            Distances.zeros(points),
        )  # fmt: skip

    def with_imu(self, imu: ImuData) -> FeatureFactor:
        """See `Factor`."""
        return replace(self, cameras=tuple(c.with_imu(imu) for c in self.cameras))

    def reusable_output(self, out: FeatureOutput) -> FeatureOutput:
        """See `Factor`: a cut has other tracks."""
        del out
        return self.output()

    def warm_started(self, out: FeatureOutput) -> FeatureFactor:
        """See `Factor`: from far off a point may stop short, or end elsewhere, and the cost would jump from one step to
        the next."""
        return replace(self, tracks=replace(self.tracks, start=out.points.copy()))

    def squares(self, out: FeatureOutput) -> dict[FitKey, Squares]:
        """See `Factor`: of each camera's features, and of their points on planes."""
        return feature_squares(self, out)

    def sizes(self, out: FeatureOutput) -> dict[FitKey, RawSize]:
        """See `Factor`."""
        return feature_sizes(self, out)

    def rows(self, out: FeatureOutput, state: State) -> list[ResidualRows]:
        """See `Factor`: of each camera's features."""
        return feature_rows(self, out, state)

    def dof_used(self, out: FeatureOutput, along: StateDifference) -> dict[FitKey, float]:
        """See `Factor`."""
        return spent_by_features(self, out, along)

    def attach(self, piece: Piece, keep: bool) -> Piece:
        """The piece with room for the features that its keyframes saw; `keep`: its end is shared with another piece."""
        tracks, pairs = self._within(piece)
        images = self._images(piece.first, self._stop(piece))
        begins = np.cumsum([0] + [len(i) for i in images])[:-1] - np.array([i.start for i in images])
        image = self.tracks.pair_image[pairs] + begins[self.tracks.pair_camera[pairs]]
        keyframe = np.concatenate([c.keyframe[i.start : i.stop] for c, i in zip(self.cameras, images, strict=True)])
        by_next = any(c.scheme == "pose" and c.imu is not None for c in self.cameras)
        sums = FeatureSums.zeros(
            tracks.stop - tracks.start, self.tracks.pair_track[pairs] - tracks.start, image, keyframe - piece.first,
            piece.calib.shape[0] - 1, by_next,
        )  # fmt: skip
        ends = self.tracks.edges - piece.first
        steps = plan(sums, len(piece.diagonal), piece.first == 0 or not keep, keep, ends)
        return replace(piece, features=PieceFeatures.of(sums, steps))

    def accumulate(
        self, state: State, piece: Piece, out: FeatureOutput, sums: bool = True, curved: bool = False
    ) -> float:
        """See `Factor`: of the features that the keyframes of `piece` saw, the cost is the least over the points."""
        tracks, pairs = self._within(piece)
        views, base = self._views(state, piece.first, self._stop(piece)), Range(tracks.start, pairs.start)
        planes = self._planes(state)
        points = self._descend(views, self._from_anchors(views, tracks, self.tracks.start[tracks]), tracks, planes)
        out.points[tracks] = self._in_anchors(views, points.xyz, tracks)
        into = piece.sums(sums)
        features = NO_SUMS
        if sums and piece.features is not None:
            features = piece.features.sums
            features.own[:, range(3), range(3)] += WEAK
        total, begin = 0.0, 0
        for view in views:
            i, loss = view.index, self._loss(curved)
            for part, images in view.chunks():
                own = slice(begin + images.start, begin + images.stop)
                mine = features._replace(pose=features.pose[own], next_pose=features.next_pose[own])
                X = part.in_camera(points.xyz, tracks.start)
                total += accumulate(
                    X, part.seen, base, part.poses, part.columns, part.seeing(X), loss, into, mine, out.residual[i],
                    out.root[i],
                )  # fmt: skip
            begin += len(view.seen.keyframe)
        if planes is not None:
            loss, off = self._loss(curved), out.off.of(tracks)
            total += add_points_on_planes(self.on.of(tracks), planes, loss, points, features, piece, off)
        if sums and piece.features is not None:
            piece.calib[-1, -1] += held_back(features.own, features.side[:, :, -1])
        return total

    def accumulate_clusters(
        self, state: State, piece: Piece, at: FeatureOutput, cluster: list[np.ndarray], n_clusters: int, column: int
    ) -> None:
        """Adds the gradient of each cluster of observations, by camera (N,), to columns of `piece` from `column` on;
        points are those of `at`."""
        assert piece.features is not None
        tracks, pairs = self._within(piece)
        views, base = self._views(state, piece.first, self._stop(piece)), Range(tracks.start, pairs.start)
        points, side = self._from_anchors(views, tracks, at.points[tracks]), piece.features.sums.side
        for view in views:
            loss, own = self._loss(False), cluster[view.index]
            for part, _ in view.chunks():
                X = part.in_camera(points, tracks.start)
                accumulate_clusters(
                    X, part.seen, base, part.poses, part.columns, part.seeing(X), loss, own, n_clusters, column,
                    piece.sums(True), side,
                )  # fmt: skip

    def _planes(self, state: State) -> Planes | None:
        """As `state` has them; None where no point lies on any."""
        if self.surfaces is None or not (self.on.plane >= 0).any():
            return None
        return Planes.of(self.surfaces.keys, state, self._of_planes)

    @cached_property
    def _of_planes(self) -> np.ndarray:
        """(P, 3) calibration columns of each plane."""
        keys = () if self.surfaces is None else self.surfaces.keys
        return np.array([self.layout.block(*key).columns for key in keys])

    def _loss(self, curved: bool) -> Loss:
        return Loss(LOSSES[self.loss], self.loss_scale, curved)

    def _within(self, piece: Piece) -> tuple[slice, slice]:
        return self.tracks.within(piece.first, self._stop(piece))

    def _stop(self, piece: Piece) -> int:
        """The keyframe before which the images of `piece` hang: the last, or behind the chain's very last."""
        return piece.last + 1 if piece.last == self.n_keyframes - 1 else piece.last

    def _images(self, first: int, stop: int) -> list[range]:
        """By camera, the images that hang on keyframes first..stop."""
        return [range(*(int(i) for i in np.searchsorted(c.keyframe, [first, stop]))) for c in self.cameras]

    def _sightings(self) -> Sightings:
        pairs = list(zip(self.streams, self.cameras, strict=True))
        return Sightings(
            np.concatenate([s.feature for s in self.streams]),
            np.concatenate([s.image for s in self.streams]),
            np.concatenate([c.keyframe[s.image] for s, c in pairs]),
            np.concatenate(self.keep),
            tuple(len(s.feature) for s in self.streams),
        )

    def _views(self, state: State, first: int, stop: int) -> list[View]:
        """What hangs on keyframes first..stop."""
        return [self._view(state, i, images, first) for i, images in enumerate(self._images(first, stop))]

    def _view(self, state: State, index: int, images: range, first: int) -> View:
        camera, stream, tracks = self.cameras[index], self.streams[index], self.tracks
        i0, i1 = images.start, images.stop
        seen = Seen(
            stream.start[i0 : i1 + 1], stream.uv, self.keep[index], tracks.track[index], tracks.pair[index],
            camera.keyframe[i0:i1] - first, self.sigmas[index],
        )  # fmt: skip
        lens = self.layout.columns(camera.name, "intrinsics", "distortion")
        pars = np.flatnonzero(lens >= 0)
        clocks = range(len(state.values[camera.name, "time_offset"]))
        own = np.array([np.concatenate([camera.kinematics.columns(k), lens[pars]]) for k in clocks])
        columns = own[clock_numbers(state, camera.name, camera.keyframe[i0:i1])]
        return View(camera, index, i0, camera.lens(state), seen, camera.poses(state, i0, i1), columns, pars)

    def _descend(self, views: list[View], xyz: np.ndarray, tracks: slice, planes: Planes | None) -> Points:
        """The points of `tracks` where their cost is least, that of their `planes` with it, from `xyz` (n, 3) on."""
        n, eyes = len(xyz), self._from_anchors(views, tracks, np.zeros_like(xyz))
        points = Points(
            eyes, xyz, xyz.copy(), np.zeros(n), np.zeros(n), np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3, 3)),
            np.zeros((n, 3)), np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64), np.zeros(n),
            np.ones(n, dtype=bool),
        )  # fmt: skip
        for step in range(MOST_STEPS):
            for view in views:
                view.add_to_points(tracks.start, self._loss(False), points)
            if planes is not None:
                add_planes_to_points(self.on.of(tracks), planes, self._loss(False), points)
            if take_trials(points, step == 0) == 0:
                break
        return points

    def _from_anchors(self, views: list[View], tracks: slice, points: np.ndarray) -> np.ndarray:
        """(n, 3) in the world what is at `points` (n, 3) in the frames of the cameras that `tracks` move with."""
        out, camera, image = np.empty_like(points), self.tracks.camera[tracks], self.tracks.image
        for view in views:
            own = np.flatnonzero(camera == view.index)
            i = image[tracks][own] - view.first
            turned = np.einsum("nji,nj->ni", view.poses.R_sensor_world[i], points[own])
            out[own] = turned + view.poses.position[i]
        return out

    def _in_anchors(self, views: list[View], points: np.ndarray, tracks: slice) -> np.ndarray:
        """(n, 3) the points of `tracks`, in the world, in the frames of the cameras that they move with."""
        out, camera, image = np.empty_like(points), self.tracks.camera[tracks], self.tracks.image
        for view in views:
            own = np.flatnonzero(camera == view.index)
            i = image[tracks][own] - view.first
            out[own] = np.einsum("nij,nj->ni", view.poses.R_sensor_world[i], points[own] - view.poses.position[i])
        return out


NO_NUMBERS = np.zeros(0, dtype=np.int64)
NO_SUMS = FeatureSums.zeros(0, NO_NUMBERS, NO_NUMBERS, NO_NUMBERS, 0)
