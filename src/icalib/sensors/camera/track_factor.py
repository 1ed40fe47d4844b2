"""Factor of feature tracks: scene points of unknown position that cameras observe ("Features", docs/estimator.md).

    residual = K(R_cam_world (P - p_world_cam)) - uv

K is the camera model, and P the point in the world frame. Points are not part of the state. Every linearisation first
moves each point to the minimum of its cost (variable projection; Golub and Pereyra 1973). Points are eliminated from
the normal equations together with the keyframes that observe them (`optim/front.py`). Points on planes of LiDARs have
an additional residual (`track_surfaces.py`).

Images of one camera in a range of keyframes: observations of tracks, poses, and projections of points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.motion.factor import FactorDefaults, FactorKey, FitKey, RawSize, ResidualRows, Squares, StateDifference
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import clock_numbers
from icalib.motion.sensor_pose import SensorPose
from icalib.optim.arrowhead import Piece
from icalib.optim.front import FeatureSums, PieceFeatures, plan
from icalib.optim.rows import LOSSES, Loss, median_variance
from icalib.optim.state import Layout, Planes, State
from icalib.sensors.camera.corner_factor import CornerFactor, RowPoses, row_jacobians
from icalib.sensors.camera.track_kernels import (
    PieceStart,
    TrackObservations,
    TrackProjection,
    accumulate,
    accumulate_clusters,
    camera_points,
    predicted_decrease,
)
from icalib.sensors.camera.track_surfaces import (
    NO_PLANES,
    NO_SUMS,
    OnPlanes,
    PlaneDistances,
    PointSearch,
    Surfaces,
    add_planes_to_points,
    add_points_on_planes,
    add_rays,
    add_to_points,
    moving_points,
    take_trials,
)
from icalib.sensors.camera.tracks import (
    NO_TRACKS,
    FeatureOutput,
    ObservationTable,
    TrackNoise,
    Tracks,
    dof_used_by_features,
    feature_rows,
    feature_sizes,
    feature_squares,
)

MAX_POINT_STEPS = 20  # of Levenberg-Marquardt for a point; most points converge in three
# Prior of 1 km on a point's distance [1/m^2] and of 1000 rad on its direction [1/rad^2] from its anchor camera: a point
# without observations stays invertible. A prior on its place in the world would tie the tilt of the world to a point
# whose distance is unobservable, and that may be 100 km away.
MIN_POINT_INFORMATION = 1e-6
MAX_TRACK_GAP_S = 1.0  # a feature that is unobserved for longer begins a new track
MAX_RELATIVE_SIGMA = 0.1  # standard deviation of a point over its distance, above which its track is left out
MAX_RESIDUAL_RATIO = 10.0  # to the RMS residual of the median track, above which a track is left out


@dataclass(frozen=True)
class FeatureFactor(FactorDefaults):
    """All feature tracks of all cameras.

    cameras: corner factors, which have the camera poses and models. For each camera: streams, with the same images as
    its corners; noise; keep (N,) bool: observations in use; outliers (N,) bool, an empty tuple if not yet tested. loss,
    loss_scale: robust loss and its threshold in sigma. seams: first keyframe of each recording but the first;
    surfaces: planes that points may lie on. `cut` gives the tracks, and `on`, the plane of each track. segments: see
    `by_segment`."""

    cameras: tuple[CornerFactor, ...]
    streams: tuple[TrackStream, ...]
    noise: tuple[TrackNoise, ...]
    keep: tuple[np.ndarray, ...]
    loss: str
    loss_scale: float
    layout: Layout
    seams: tuple[int, ...] = ()
    surfaces: Surfaces | None = None
    outliers: tuple[np.ndarray, ...] = ()
    tracks: Tracks = NO_TRACKS
    on: OnPlanes = NO_PLANES
    segments: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def name(self) -> str:
        """One name for all cameras, because several may observe one track."""
        return "cameras"

    @property
    def key(self) -> FactorKey:
        return self.name, "features"

    @cached_property
    def sigmas(self) -> tuple[np.ndarray, ...]:
        """For each camera (N,) px: standard deviation of each observation per axis."""
        return tuple(noise.of(stream) for noise, stream in zip(self.noise, self.streams, strict=True))

    @property
    def n_keyframes(self) -> int:
        return self.cameras[0].n_keyframes

    @property
    def n_used(self) -> int:
        """Number of observations that belong to a track."""
        return sum(int((t >= 0).sum()) for t in self.tracks.track)

    def cut(self, state: State, keyframes: tuple[int, ...]) -> FeatureFactor:
        """The same features, in tracks that end at `keyframes`, with points triangulated by the poses of `state`.

        A track is left out if its point does not project into all its images, its distance is uncertain, or its
        residuals are far larger than those of most tracks."""
        edges = np.unique([0, *keyframes, *self.seams, self.n_keyframes])
        table = self._table()
        label = table.in_order(table.labels(state.seconds, edges, MAX_TRACK_GAP_S))
        tracks = table.tracks(label, edges)
        factor = replace(self, tracks=tracks, on=OnPlanes.none(tracks.count))
        points, good, on = factor._triangulated(state)
        label = np.where(label >= 0, np.where(np.append(good, False)[label], label, -1), -1)
        number = np.append(np.where(good, np.cumsum(good) - 1, -1), -1)
        tracks = table.tracks(number[label], edges)
        return replace(factor, tracks=replace(tracks, start=points[good]), on=on)

    def _triangulated(self, state: State) -> tuple[np.ndarray, np.ndarray, OnPlanes]:
        """Triangulates all points with the poses of `state`.

        Returns points (T, 3) m in the frames of their anchor cameras, (T,) bool, whether each point is good enough to
        use, and the planes of the good points."""
        views, n = self._views(state, 0, self.n_keyframes), self.tracks.count
        A, b = np.tile(1e-9 * np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        for view in views:
            rays, valid = view.camera.model.unproject(view.params, view.observed.uv)
            observed, at = view.placed
            add_rays(observed, 0, at.R_sensor_world, at.p_world_sensor, rays, valid, A, b)
        search = self._descend(views, np.linalg.solve(A, b[:, :, None])[:, :, 0], slice(0, n), None)
        points = self._in_anchors(views, search.xyz, slice(0, n))
        distance = np.linalg.norm(points, axis=1)
        information = np.linalg.eigvalsh(search.A)[:, 0]
        n_used = sum(
            (np.bincount(t[(t >= 0) & k], minlength=n) for t, k in zip(self.tracks.track, self.keep, strict=True)),
            np.zeros(n, dtype=np.int64),
        )
        square = search.cost / np.maximum(n_used, 1)
        all_valid = search.n_valid == n_used
        typical = np.median(square[all_valid] if all_valid.any() else 0.0)
        fits = square <= MAX_RESIDUAL_RATIO**2 * typical + MAX_RESIDUAL_RATIO
        certain = information * (MAX_RELATIVE_SIGMA * distance) ** 2 > 1.0
        good = np.isfinite(points).all(axis=1) & all_valid & fits & certain
        if self.surfaces is None:
            return points, good, OnPlanes.none(int(good.sum()))
        recording = np.searchsorted(state.starts, self.tracks.stretch_of()[good], side="right") - 1
        return points, good, self.surfaces.under(search.xyz[good], search.A[good], recording)

    def coarse(self, state: State) -> FeatureFactor:
        """The same tracks with the noise of each camera raised to the median residual at `state`.

        In early passes with the stated noise, the few tracks that fit by chance would dominate and bias the lens."""
        views = self._views(state, 0, self.n_keyframes)
        points = self._from_anchors(views, slice(0, self.tracks.count), self.tracks.start)
        noise = list(self.noise)
        for view in views:
            uv, valid, *_ = view.camera.model.project_with_jacobians(view.params, view.in_camera(points, 0))
            used = valid & (view.observed.track >= 0) & view.observed.keep
            if used.any():
                variance = median_variance(((uv - view.observed.uv)[used] ** 2).sum(axis=1))
                if variance > noise[view.index].sigma ** 2:
                    noise[view.index] = TrackNoise(float(np.sqrt(variance)))
        return replace(self, noise=tuple(noise))

    def on_planes_of(self, camera: int) -> np.ndarray:
        """Indices of the tracks on planes that have camera number `camera` as their anchor."""
        return np.flatnonzero((self.on.plane >= 0) & (self.tracks.camera == camera))

    def output(self) -> FeatureOutput:
        """Arrays that `accumulate` fills."""
        sizes = [len(s.uv) for s in self.streams]
        points = self.tracks.count
        return FeatureOutput(
            tuple(np.zeros((n, 2)) for n in sizes), tuple(np.zeros(n) for n in sizes), np.zeros((points, 3)),
            PlaneDistances.zeros(points),
        )  # fmt: skip

    def by_segment(self, ends: np.ndarray, of_column: np.ndarray) -> FeatureFactor:
        """See `TrackFactor`."""
        return replace(self, segments=(ends, of_column))

    def with_imu(self, imu: ImuData, state: State) -> FeatureFactor:
        return replace(self, cameras=tuple(c.with_imu(imu, state) for c in self.cameras))

    def reusable_output(self, out: FeatureOutput) -> FeatureOutput:
        """See `Factor`: new arrays, because a cut changes the tracks."""
        return self.output()

    def warm_started(self, out: FeatureOutput) -> FeatureFactor:
        """See `Factor`. From a distant start, a point may end in another minimum, and the cost would jump."""
        return replace(self, tracks=replace(self.tracks, start=out.points.copy()))

    def squares(self, out: FeatureOutput) -> dict[FitKey, Squares]:
        """See `Factor`: for the tracks of each camera, and for their points on planes."""
        return feature_squares(self, out)

    def sizes(self, out: FeatureOutput) -> dict[FitKey, RawSize]:
        return feature_sizes(self, out)

    def rows(self, out: FeatureOutput, state: State) -> list[ResidualRows]:
        """See `Factor`: residuals of the tracks of each camera."""
        return feature_rows(self, out, state)

    def dof_used(self, out: FeatureOutput, along: StateDifference) -> dict[FitKey, float]:
        return dof_used_by_features(self, out, along)

    def attach(self, piece: Piece, keep: bool) -> Piece:
        """See `Factor`: adds workspace for the tracks that keyframes of the piece observe."""
        tracks, pairs = self._within(piece)
        images = self._images(piece.first, self._stop(piece))
        begins = np.cumsum([0] + [len(i) for i in images])[:-1] - np.array([i.start for i in images])
        image = self.tracks.pair_image[pairs] + begins[self.tracks.pair_camera[pairs]]
        keyframe = np.concatenate([c.keyframe[i.start : i.stop] for c, i in zip(self.cameras, images, strict=True)])
        by_next = any(c.scheme == "pose" and c.imu is not None for c in self.cameras)
        sums = FeatureSums.zeros(
            tracks.stop - tracks.start, self.tracks.pair_track[pairs] - tracks.start, image, keyframe - piece.first,
            piece.side.shape[1:], by_next, max(c.n_knots for c in self.cameras),
        )  # fmt: skip
        ends = self.tracks.edges - piece.first
        steps = plan(sums, len(piece.diagonal), piece.first == 0 or not keep, keep, ends)
        return replace(piece, features=PieceFeatures.of(sums, steps))

    def accumulate(
        self, state: State, piece: Piece, out: FeatureOutput, sums: bool = True, curved: bool = False
    ) -> float:
        """See `Factor`: adds the tracks that keyframes of `piece` observe, with points at their least cost."""
        tracks, pairs = self._within(piece)
        views, base = self._views(state, piece.first, self._stop(piece)), PieceStart(tracks.start, pairs.start)
        planes = self._planes(state)
        points = self._descend(views, self._from_anchors(views, tracks, self.tracks.start[tracks]), tracks, planes)
        out.points[tracks] = self._in_anchors(views, points.xyz, tracks)
        into = piece.sums(sums)
        features = NO_SUMS
        if sums and piece.features is not None:
            features = piece.features.sums
            ray = points.xyz - points.anchor
            square = np.maximum((ray**2).sum(axis=1), 1e-18)[:, None, None]
            along = ray[:, :, None] * ray[:, None, :] / square
            features.diagonal[:] += MIN_POINT_INFORMATION * (along + (np.eye(3) - along) / square)
        total, begin = 0.0, 0
        for view in views:
            i, loss = view.index, self._loss(curved)
            for part, images in view.chunks():
                rows = slice(begin + images.start, begin + images.stop)
                part_sums = features._replace(pose=features.pose[rows], next_pose=features.next_pose[rows])
                X = part.in_camera(points.xyz, tracks.start)
                total += accumulate(
                    X, part.observed, base, part.poses, part.columns, part.projection(X), loss, into, part_sums,
                    out.residual[i], out.root[i],
                )  # fmt: skip
            begin += len(view.observed.keyframe)
        if planes is not None:
            summed, loss = piece if sums else None, self._loss(curved)
            total += add_points_on_planes(self.on.of(tracks), planes, loss, points, summed, out.off.of(tracks))
        if sums and piece.features is not None:
            piece.calib[-1, -1] += predicted_decrease(features.diagonal, features.side[:, :, -1])
        return total

    def accumulate_clusters(
        self, state: State, piece: Piece, at: FeatureOutput, cluster: list[np.ndarray], n_clusters: int, column: int
    ) -> None:
        """Adds the gradient of each cluster of observations to the columns from `column` on of `piece`.

        at: has the points to use. cluster: for each camera (N,) cluster index of each observation, below n_clusters."""
        assert piece.features is not None
        tracks, pairs = self._within(piece)
        views, base = self._views(state, piece.first, self._stop(piece)), PieceStart(tracks.start, pairs.start)
        points, side = self._from_anchors(views, tracks, at.points[tracks]), piece.features.sums.side
        for view in views:
            loss, clusters = self._loss(False), cluster[view.index]
            for part, _ in view.chunks():
                X = part.in_camera(points, tracks.start)
                accumulate_clusters(
                    X, part.observed, base, part.poses, part.columns, part.projection(X), loss, clusters, n_clusters,
                    column, piece.sums(True), side,
                )  # fmt: skip

    def _planes(self, state: State) -> Planes | None:
        """The LiDAR planes with their values in `state`; None if no point lies on a plane."""
        if self.surfaces is None or not (self.on.plane >= 0).any():
            return None
        return Planes.of(self.surfaces.keys, state, self._of_planes)

    @cached_property
    def _of_planes(self) -> np.ndarray:
        """(P, 3) indices of calibration parameters of each plane, -1 where fixed."""
        keys = () if self.surfaces is None else self.surfaces.keys
        return np.array([self.layout.block(*key).columns for key in keys])

    def _loss(self, curved: bool) -> Loss:
        return Loss(LOSSES[self.loss], self.loss_scale, curved)

    def _within(self, piece: Piece) -> tuple[slice, slice]:
        return self.tracks.within(piece.first, self._stop(piece))

    def _stop(self, piece: Piece) -> int:
        """End (exclusive) of the range of keyframes of `piece`.

        Its last keyframe belongs to the next piece, except at the end of the chain."""
        return piece.last + 1 if piece.last == self.n_keyframes - 1 else piece.last

    def _images(self, first: int, stop: int) -> list[range]:
        """For each camera the range of its images at keyframes first..stop (exclusive)."""
        return [range(*(int(i) for i in np.searchsorted(c.keyframe, [first, stop]))) for c in self.cameras]

    def _table(self) -> ObservationTable:
        pairs = list(zip(self.streams, self.cameras, strict=True))
        return ObservationTable(
            np.concatenate([s.feature for s in self.streams]),
            np.concatenate([s.image for s in self.streams]),
            np.concatenate([c.keyframe[s.image] for s, c in pairs]),
            np.concatenate(self.keep),
            tuple(len(s.feature) for s in self.streams),
        )

    def _views(self, state: State, first: int, stop: int) -> list[CameraImages]:
        """For each camera its images at keyframes first..stop (exclusive)."""
        return [self._view(state, i, images, first) for i, images in enumerate(self._images(first, stop))]

    def _view(self, state: State, index: int, images: range, first: int) -> CameraImages:
        camera, stream, tracks = self.cameras[index], self.streams[index], self.tracks
        i0, i1 = images.start, images.stop
        keyframe = camera.keyframe[i0:i1]
        observed = TrackObservations(
            stream.start[i0 : i1 + 1], stream.uv, self.keep[index], tracks.track[index], tracks.pair[index],
            keyframe - first, self.sigmas[index],
        )  # fmt: skip
        lens = self.layout.columns(camera.name, "intrinsics", "distortion")
        pars = np.flatnonzero(lens >= 0)
        clocks = range(len(state.values[camera.name, "time_offset"]))
        direct = np.concatenate([lens[pars], camera.readout_columns])
        columns_of_clocks = np.array([np.concatenate([camera.kinematics.columns(k), direct]) for k in clocks])
        columns, rows = columns_of_clocks[clock_numbers(state, camera.name, keyframe)], None
        if self.segments is not None:
            ends, of_column = self.segments
            columns = of_column[np.searchsorted(ends[1:-1], keyframe, side="right")[:, None], columns]
        if camera.shutter is not None:
            seen, image = slice(*observed.start[[0, -1]].tolist()), np.repeat(images, np.diff(observed.start))
            rows = camera.rows_of(state, image, stream.uv[seen])
        poses = camera.knot_poses(state, i0, i1)
        return CameraImages(camera, index, i0, camera.lens(state), observed, poses, columns, pars, rows)

    def _descend(self, views: list[CameraImages], xyz: np.ndarray, tracks: slice, planes: Planes | None) -> PointSearch:
        """Searches the points of `tracks` that minimise the cost, from start values xyz (n, 3) m in the world frame.

        planes: LiDAR planes, whose residuals are part of the cost; None without."""
        n, anchors = len(xyz), self._from_anchors(views, tracks, np.zeros_like(xyz))
        points = PointSearch(
            anchors, xyz, xyz.copy(), np.zeros(n), np.zeros(n), np.zeros((n, 3, 3)), np.zeros((n, 3)),
            np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64),
            np.zeros(n), np.ones(n, dtype=bool),
        )  # fmt: skip
        for step in range(MAX_POINT_STEPS):
            for view in views:
                view.add_to_points(tracks.start, self._loss(False), points)
            if planes is not None:
                add_planes_to_points(self.on.of(tracks), planes, self._loss(False), points)
            if take_trials(points, step == 0) == 0:
                break
        return points

    def _from_anchors(self, views: list[CameraImages], tracks: slice, points: np.ndarray) -> np.ndarray:
        """(n, 3) m in the world frame, from `points` (n, 3) m of `tracks` in the frames of their anchor cameras."""
        out, camera, image = np.empty_like(points), self.tracks.camera[tracks], self.tracks.image
        for view in views:
            rows = np.flatnonzero(camera == view.index)
            i = view.middle(image[tracks][rows])
            turned = np.einsum("nji,nj->ni", view.poses.R_sensor_world[i], points[rows])
            out[rows] = turned + view.poses.position[i]
        return out

    def _in_anchors(self, views: list[CameraImages], points: np.ndarray, tracks: slice) -> np.ndarray:
        """(n, 3) m in the frames of the anchor cameras, from `points` (n, 3) m of `tracks` in the world frame."""
        out, camera, image = np.empty_like(points), self.tracks.camera[tracks], self.tracks.image
        for view in views:
            rows = np.flatnonzero(camera == view.index)
            i = view.middle(image[tracks][rows])
            out[rows] = np.einsum("nij,nj->ni", view.poses.R_sensor_world[i], points[rows] - view.poses.position[i])
        return out


OBSERVATIONS_PER_CHUNK = 4096  # observations that are projected at once; their arrays fit into the processor's cache


@dataclass(frozen=True)
class CameraImages:
    """The n images from number `first` on of one camera, whose index is `index`.

    params (P,): parameters of the camera model; observed: observations of tracks; poses: camera poses, see
    `CornerFactor.knot_poses`. columns (n, c + d): indices of calibration parameters, c of the pose, then d of the free
    lens parameters and of the readout time, -1 where fixed; pars: indices of the free lens parameters. rows: camera
    poses of the observations with a rolling shutter, see `CornerFactor.rows_of`."""

    camera: CornerFactor
    index: int
    first: int
    params: np.ndarray
    observed: TrackObservations
    poses: SensorPose
    columns: np.ndarray
    pars: np.ndarray
    rows: RowPoses | None

    @property
    def placed(self) -> tuple[TrackObservations, SensorPose]:
        """The observations in groups of one camera pose, which are images or single observations, and these poses."""
        if self.rows is None:
            return self.observed, self.poses
        start = self.observed.start
        return self.observed._replace(start=np.arange(start[0], start[-1] + 1)), self.rows.at

    def middle(self, image: np.ndarray) -> np.ndarray:
        """Indices (n,) of the poses at the middle row of images `image` (n,) of the camera."""
        knots = self.camera.n_knots
        return (image - self.first) * knots + knots // 2

    def chunks(self) -> Iterator[tuple[CameraImages, slice]]:
        """Splits the images at about every `OBSERVATIONS_PER_CHUNK` observations: parts, and slices of their images."""
        start = self.observed.start
        cuts = np.searchsorted(start, np.arange(start[0], start[-1], OBSERVATIONS_PER_CHUNK), side="left")
        cuts = np.unique([0, *cuts, len(start) - 1])
        for a, b in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
            yield self._part(a, b), slice(a, b)

    def _part(self, a: int, b: int) -> CameraImages:
        """The images a..b of these, counted from the first."""
        observed, images, knots = self.observed, slice(a, b), self.camera.n_knots
        rows = slice(*(observed.start[[a, b]] - observed.start[0]).tolist())
        observed = observed._replace(start=observed.start[a : b + 1], keyframe=observed.keyframe[images])
        return replace(
            self, first=self.first + a, observed=observed, poses=self.poses.part(slice(knots * a, knots * b)),
            columns=self.columns[images], rows=None if self.rows is None else self.rows.part(rows),
        )  # fmt: skip

    def in_camera(self, points: np.ndarray, track: int) -> np.ndarray:
        """(n, 3) m: the point of each observation in the camera frame.

        points (T, 3) m: points of the tracks from number `track` on, in the world frame."""
        observed, at = self.placed
        X = np.empty((int(observed.start[-1] - observed.start[0]), 3))
        camera_points(observed, track, at.R_sensor_world, at.p_world_sensor, points, X)
        return X

    def projection(self, X: np.ndarray) -> TrackProjection:
        """Projection, with Jacobians, of the points X (n, 3) m of all n observations, in the camera frame."""
        projection, first = self.camera.model.project_with_jacobians(self.params, X), int(self.observed.start[0])
        share, by_readout = row_jacobians(self.rows, X)
        return TrackProjection(first, *projection, self.pars, share, by_readout, self.placed[1].R_sensor_world)

    def add_to_points(self, track: int, loss: Loss, points: PointSearch) -> None:
        """Adds the observations of points that have not converged to their normal equations in `points`.

        points: search for the points of the tracks from number `track` on."""
        for part, _ in self.chunks():
            observed, at = part.placed
            most = int(observed.start[-1] - observed.start[0])
            image, which, X = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64), np.empty((most, 3))
            m = moving_points(observed, track, at.R_sensor_world, at.p_world_sensor, points, image, which, X)
            if m:
                uv, valid, J_point, _ = self.camera.model.project_with_jacobians(self.params, X[:m])
                R = at.R_sensor_world
                add_to_points(observed, track, R, image[:m], which[:m], uv, valid, J_point, loss, points)
