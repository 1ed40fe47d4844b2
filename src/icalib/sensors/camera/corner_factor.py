"""Corners of a known target in the images of one camera ("Corners" in docs/estimator.md).

    residual = K(X) + bloom * direction - uv
    X = R_cam_world (R_world_scene (R_scene_body P + p_scene_body) - p_world_cam)

K is the camera model, and P a point of the target, displaced by the shape of its body. A view is one body in one image,
so that all its corners share one camera pose. The Gram matrix of a view, over this pose and the parameters of camera
and body, is summed first. The Jacobians of the pose by the state are then applied once per view.

With a rolling shutter each corner has the camera pose at the time of its row, t + readout (row / height - 1/2). Its
Jacobian by the state is interpolated between poses at three rows, the knots. Its error is of third order in the motion
during the readout: 5e-6 at 30 ms and 1 rad/s, over all columns together. Residuals are not interpolated.

Corners of a view may share an error, the sum of `field` times coefficients ~ N(0, tau^2): a shift, and a delay times
the image velocity. These coefficients are marginalised view by view.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.targets.base import BOARD
from icalib.model.bodies import Bodies
from icalib.motion.factor import FactorDefaults, FactorKey, FitKey, RawSize, ResidualRows, Squares, StateDifference
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import Poses, offset_at
from icalib.motion.sensor_pose import Kinematics, SensorPose, with_slopes
from icalib.optim import memory
from icalib.optim.arrowhead import Piece, in_parallel
from icalib.optim.rows import LOSSES
from icalib.optim.state import Layout, State, in_recording
from icalib.rig import Scheme
from icalib.sensors.camera.corner_kernels import (
    CornerProjection,
    CornerResidualArrays,
    DirectParameters,
    Noise,
    ViewCorners,
    ViewPoses,
    accumulate,
    accumulate_clusters,
    camera_points,
)
from icalib.sensors.camera.spec import Shutter

IMAGES_PER_BLOCK = 256  # images whose statistics are computed at once; bounds the memory
VIEWS_PER_BLOCK = 1024  # views whose poses and Jacobians are computed at once; bounds the memory
VIEWS_PER_CHUNK = 64  # views that are projected at once; their arrays fit into the processor's cache
KNOTS = 0.5 * np.cos(np.pi * np.array([5.0, 3.0, 1.0]) / 6.0)  # Chebyshev points: least error of an interpolation


@dataclass(frozen=True)
class CornerNoise:
    """Noise of the N corners of one camera.

    sigma (N,) px per axis. tau (m,): standard deviations of the coefficients of the error that all corners of a view
    share; field (N, 2, m): change of each corner per unit of each coefficient. The coefficients are
    none, or a shift (2) [px], or these and a delay [s], or a delay. loss: robust loss, with the threshold `loss_scale`
    in sigma."""

    sigma: np.ndarray
    tau: np.ndarray
    field: np.ndarray
    loss: str = "none"
    loss_scale: float = 2.5


@dataclass(frozen=True)
class CornerOutput:
    """Residuals of N corners in V views.

    residual (N, 2) px: predicted - measured, without the common error. root (N,) 1/px: square root of the robust
    weight, over sigma; 0 if not in use. Both are in single precision, to save memory. shared (V, m): coefficients of
    each view's common error, which adds to the prediction."""

    residual: np.ndarray
    root: np.ndarray
    shared: np.ndarray

    @classmethod
    def empty(cls, n: int, n_views: int, m: int, dtype: type = np.float32) -> CornerOutput:
        """Arrays for n corners in `n_views` views, with m coefficients of the common error."""
        return cls(memory.mmap_zeros((n, 2), dtype), memory.mmap_zeros((n,), dtype), np.zeros((n_views, m)))


@dataclass(frozen=True)
class RowPoses:
    """Camera poses `at` of n image points, without Jacobians, at the times of their rows; their `Shutter.phase` phase
    (n,), and shares (n, 3) of the `KNOTS`, see `CornerProjection`."""

    at: SensorPose
    phase: np.ndarray
    share: np.ndarray

    def part(self, points: slice) -> RowPoses:
        return RowPoses(self.at.part(points), self.phase[points], self.share[points])


def row_jacobians(rows: RowPoses | None, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`share` and `by_readout` of `CornerProjection` for points X (n, 3) m in the camera frame; rows: None for a global
    shutter."""
    if rows is None:
        return np.ones((len(X), 1)), np.empty((0, 3))
    return rows.share, rows.at.velocity_of(X) * rows.phase[:, None]


@dataclass(frozen=True)
class CornerFactor(FactorDefaults):
    """All corners of one camera, in M images.

    imu: readings between keyframes, None if all images are at keyframes; gravity [m/s^2]; scheme: interpolation of
    poses between keyframes. times (M,) s: stamps on the camera's clock since its first stamp, without time offset.
    keyframe (M,), increasing: index of the keyframe from which the pose of each image follows. keep (N,) bool: corners
    in use. direction (N, 2): unit image direction of the bloom, (0, 2) without bloom. seams: first image of each
    recording but the first; every recording has its own attitude of the scene. shutter: None for a global shutter;
    slopes (K, 6): see `rate_slopes`, of an assumed motion with a rolling shutter; those of the start of a pass."""

    stream: CornerStream
    model: CameraModel
    imu: ImuData | None
    gravity: float
    scheme: Scheme
    times: np.ndarray
    keyframe: np.ndarray
    keep: np.ndarray
    noise: CornerNoise
    direction: np.ndarray
    bodies: Bodies
    layout: Layout
    n_keyframes: int
    seams: tuple[int, ...] = ()
    shutter: Shutter | None = None
    slopes: np.ndarray | None = None

    @property
    def key(self) -> FactorKey:
        return self.name, "corners"

    @property
    def name(self) -> str:
        return self.stream.name

    @property
    def sees_target(self) -> bool:
        """Whether the camera has any corner of the target."""
        return len(self.stream.uv) > 0

    @cached_property
    def views(self) -> Views:
        return Views.of(self.stream, self.bodies.target.body)

    def parts(self, v0: int, v1: int) -> Iterator[tuple[int, int, int]]:
        """Splits the range of views v0..v1 at recordings: first view, end and index of the recording of each part."""
        seams = np.searchsorted(self.views.image, (0, *self.seams, len(self.keyframe)))
        for k, (first, end) in enumerate(pairwise(seams)):
            a, b = max(v0, int(first)), min(v1, int(end))
            if a < b:
                yield a, b, k

    def world_points(self, state: State, recording: int) -> np.ndarray:
        """(n_points, 3) m: points of the target, with shapes and size, in the world frame of one recording."""
        return self.bodies.points(state.values) @ _scene(state, recording).T

    @cached_property
    def kinematics(self) -> Kinematics:
        return Kinematics(self.name, self.layout, self.imu, self.gravity, self.scheme)

    def imu_poses(self, state: State, i0: int, i1: int) -> Poses:
        """IMU poses in the world, with Jacobians, at the instants of images i0..i1."""
        return self.kinematics.imu_poses(self.times[i0:i1], self.keyframe[i0:i1], state)

    def poses(self, state: State, i0: int = 0, i1: int | None = None) -> SensorPose:
        """Camera poses in the world, with Jacobians, at the instants of images i0..i1."""
        return SensorPose.at(self.kinematics, self.times[i0:i1], self.keyframe[i0:i1], state)

    @property
    def n_knots(self) -> int:
        """Number of camera poses of an image."""
        return 1 if self.shutter is None else len(KNOTS)

    @property
    def readout_columns(self) -> np.ndarray:
        """(1,) calibration column of the readout time, -1 if fixed; (0,) with a global shutter."""
        return np.arange(0) if self.shutter is None else self.layout.columns(self.name, "readout")

    def knot_poses(self, state: State, i0: int, i1: int) -> SensorPose:
        """Camera poses, with Jacobians, of images i0..i1 at all `KNOTS` of a rolling shutter; else as `poses`."""
        if self.shutter is None:
            return self.poses(state, i0, i1)
        images = np.repeat(np.arange(i0, i1), len(KNOTS))
        return self.row_poses(state, images, np.tile(KNOTS, i1 - i0), jacobians=True)

    def row_poses(self, state: State, image: np.ndarray, phase: np.ndarray, jacobians: bool = False) -> SensorPose:
        """Camera poses (n,) in images image (n,), increasing, at the times of rows with `Shutter.phase` phase (n,)."""
        readout, keyframe = float(state.values[self.name, "readout"][0]), self.keyframe[image]
        seconds = self.times[image] + readout * phase
        if readout == 0.0:  # as where it is tested: rows of an image share a pose
            images, of_row = np.unique(image, return_inverse=True)
            at = SensorPose.at(self.kinematics, self.times[images], self.keyframe[images], state, jacobians).part(
                of_row
            )
        else:
            at = SensorPose.at(self.kinematics, seconds, keyframe, state, jacobians)
        if self.slopes is None or jacobians:
            return at
        instant = seconds + offset_at(state, self.name, keyframe, seconds)
        return with_slopes(at, self.slopes[keyframe], instant - state.seconds[keyframe])

    def rows_of(self, state: State, image: np.ndarray, uv: np.ndarray) -> RowPoses:
        """Camera poses of image points uv (n, 2) px in images image (n,), increasing, at the times of their rows."""
        assert self.shutter is not None
        phase = self.shutter.phase(uv)
        others = [[c for c in KNOTS if c != knot] for knot in KNOTS]
        share = [np.prod([(phase - c) / (k - c) for c in left], axis=0) for k, left in zip(KNOTS, others, strict=True)]
        return RowPoses(self.row_poses(state, image, phase), phase, np.stack(share, axis=1))

    def blocks(self) -> Iterator[tuple[int, int]]:
        """Ranges of views v0..v1 that cover all images, in blocks of `IMAGES_PER_BLOCK` whole images."""
        image, n = self.views.image, len(self.keyframe)
        for first in range(0, n, IMAGES_PER_BLOCK):
            v0, v1 = np.searchsorted(image, [first, min(first + IMAGES_PER_BLOCK, n)])
            if v0 < v1:
                yield int(v0), int(v1)

    def corners_of(self, v0: int, v1: int) -> slice:
        """The rows of the stream that are corners of views v0..v1."""
        return slice(int(self.views.start[v0]), int(self.views.start[v1]))

    def points_in_camera(self, state: State, v0: int, v1: int) -> tuple[np.ndarray, np.ndarray]:
        """X (n, 3) m: points of the corners of views v0..v1 in the camera frame; R_cam_body (v1 - v0, 3, 3) by view, at
        the time of the middle row."""
        image, body, start = self.views.image[v0:v1], self.views.body[v0:v1], self.views.start[v0 : v1 + 1]
        i0 = int(image[0])
        camera, R_sb = self.poses(state, i0, int(image[-1]) + 1), self.bodies.poses(state.values)[0]
        R_cw, p_wc = camera.R_sensor_world[image - i0], camera.p_world_sensor[image - i0]
        X, R_cb = np.empty((start[-1] - start[0], 3)), np.empty_like(R_cw)
        for first, end, recording in self.parts(v0, v1):
            a, b = first - v0, end - v0
            world, part = self.world_points(state, recording), X[start[a] - start[0] : start[b] - start[0]]
            if self.shutter is None:
                camera_points(a, b, start, self.stream.point, R_cw, p_wc, world, part)
            else:
                self._points_of_rows(state, self.corners_of(first, end), world, part)
            R_cb[a:b] = R_cw[a:b] @ _scene(state, recording) @ R_sb[body[a:b]]
        return X, R_cb

    def _points_of_rows(self, state: State, corners: slice, world: np.ndarray, X: np.ndarray) -> RowPoses:
        """Writes the points of `corners`, each at the time of its row, in the camera frame into X (n, 3) m. world
        (n_points, 3) m: points of the target."""
        rows, each = self.rows_of(state, self._image[corners], self.stream.uv[corners]), np.arange(len(X) + 1)
        R_cw, p_wc = rows.at.R_sensor_world, rows.at.p_world_sensor
        camera_points(0, len(X), each, self.stream.point[corners], R_cw, p_wc, world, X)
        return rows

    @cached_property
    def _image(self) -> np.ndarray:
        """(N,) index of the image of each corner."""
        return self.stream.image

    def in_camera(self, state: State) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """For each block: slice of its corners, points X (n, 3) m in the camera frame, and R_cam_body (n, 3, 3)."""
        for v0, v1 in self.blocks():
            X, R_cam_body = self.points_in_camera(state, v0, v1)
            yield self.corners_of(v0, v1), X, R_cam_body[self.views.of_corners(v0, v1) - v0]

    def instants(self, state: State) -> np.ndarray:
        """(M,) instants of the images, s on the body's clock since its first stamp."""
        return self.times + offset_at(state, self.name, self.keyframe, self.times)

    def lens(self, state: State) -> np.ndarray:
        """(P,) parameters of the camera model: intrinsics, then distortion."""
        return np.concatenate([state.values[self.name, "intrinsics"], state.values[self.name, "distortion"]])

    def residual(self, state: State, v0: int, v1: int) -> np.ndarray:
        """(n, 2) px: predicted - measured for the corners of views v0..v1, without the common error."""
        rows, (X, _) = self.corners_of(v0, v1), self.points_in_camera(state, v0, v1)
        params = self.lens(state)
        uv = self.model.project(params, X)[0] - self.stream.uv[rows]
        return uv + state.values[self.name, "bloom"] * self.direction[rows] if len(self.direction) else uv

    def output(self, dtype: type = np.float32) -> CornerOutput:
        """Arrays that `accumulate` fills, residuals and weights in `dtype`. Its sums do not depend on `dtype`."""
        return CornerOutput.empty(len(self.stream.uv), len(self.views.image), len(self.noise.tau), dtype)

    def errors(self, out: CornerOutput) -> np.ndarray:
        """(N, 2) px: predicted - measured, with the common error of each view in the prediction."""
        error = np.empty((len(out.root), 2), np.float32)
        for v0, v1 in self.blocks():
            rows = self.corners_of(v0, v1)
            shared = out.shared[self.views.of_corners(v0, v1)]
            error[rows] = out.residual[rows] + np.einsum("nik,nk->ni", self.noise.field[rows], shared)
        return error

    def chi2(self, out: CornerOutput) -> float:
        """chi^2 of the corners with positive weight.

        Others are excluded first: corners of images without a pose may project to 1e20 px."""
        used = out.root > 0.0
        return float(((self.errors(out)[used] * out.root[used, None]) ** 2).sum(dtype=np.float64))

    def discarded_output(self) -> None:
        """None, so that `accumulate` allocates arrays for each block only: arrays for all corners would be large."""

    def squares(self, out: CornerOutput) -> dict[FitKey, Squares]:
        """See `Factor`: number and chi^2 of the corners, and of the coefficients of each common error."""
        return corner_squares(self, out) if len(self.stream.uv) else {}

    def sizes(self, out: CornerOutput) -> dict[FitKey, RawSize]:
        """See `Factor`: RMS of the corners, which is reported for common errors, too."""
        size = RawSize(rms_px(out.residual, out.root), "px", int((out.root == 0.0).sum()))
        return dict.fromkeys(self.squares(out), size)

    def rows(self, out: CornerOutput, state: State) -> list[ResidualRows]:
        """See `Factor`: the residuals of the corners, if there are any."""
        seconds = self.instants(state)[self.stream.image]
        rows = image_rows(self.name, CORNERS, seconds, out.residual, self.noise.sigma, out.root)
        return [rows] if len(seconds) else []

    def dof_used(self, out: CornerOutput, along: StateDifference) -> dict[FitKey, float]:
        return dof_used_by_corners(self, out, along)

    def with_direction(self, direction: np.ndarray) -> CornerFactor:
        """The same factor with the bloom directions `direction` (N, 2), unit vectors in the image."""
        return replace(self, direction=direction)

    def _columns(self, recording: int, body: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Calibration columns (n, c + d) of views of the bodies `body` (n,), as in `ViewPoses`.

        Also returns the indices of the free lens parameters."""
        pose, shape = (columns[body] for columns in self.bodies.columns(self.layout))
        tilt = self.layout.columns(in_recording(BOARD, recording), "tilt")
        chained = np.concatenate([self.kinematics.columns(recording), tilt])
        model = self.layout.columns(self.name, "intrinsics", "distortion")
        pars = np.flatnonzero(model >= 0)
        bloom = self.layout.columns(self.name, "bloom") if len(self.direction) else model[:0]
        direct = np.concatenate([model[pars], bloom, self.readout_columns])
        chained_of_all, direct_of_all = (np.tile(part, (len(body), 1)) for part in (chained, direct))
        return np.concatenate([chained_of_all, pose, direct_of_all, shape], axis=1), pars

    def accumulate(
        self, state: State, piece: Piece, out: CornerOutput | None, sums: bool = True, curved: bool = False
    ) -> float:
        """See `Factor`: adds the images whose keyframe is in `piece`. Residuals are not kept if `out` is None."""
        into, total = piece.sums(sums), 0.0
        for v0, v1, recording in self._blocks_of(piece):
            images, noise, direct, motion = self._arguments(state, v0, v1, recording, curved)
            if out is None:
                first, end = int(images.start[0]), int(images.start[-1])
                block = CornerOutput.empty(end - first, v1 - v0, len(self.noise.tau))
                kept = CornerResidualArrays(first, block.residual, block.root, block.shared)
            else:
                kept = CornerResidualArrays(0, out.residual, out.root, out.shared[v0:v1])
            for a, b, projection in self._chunks(state, images, motion, recording, sums):
                total += accumulate(a, b, images, noise, direct, motion, projection, into, kept)
        return total

    def accumulate_clusters(
        self, state: State, piece: Piece, at: CornerOutput, cluster: np.ndarray, n_clusters: int, column: int
    ) -> None:
        """Adds the gradient of each cluster of corners to the columns from `column` on of `piece`.

        at: residuals and weights to use. cluster (N,): index of each corner's cluster, from 0 to n_clusters - 1."""
        into = piece.sums(True)
        for v0, v1, recording in self._blocks_of(piece):
            images, noise, direct, motion = self._arguments(state, v0, v1, recording, False)
            kept = CornerResidualArrays(0, at.residual, at.root, at.shared[v0:v1])
            for a, b, projection in self._chunks(state, images, motion, recording, True):
                accumulate_clusters(
                    a, b, cluster, n_clusters, column, images, noise, direct, motion, projection, into, kept
                )  # fmt: skip

    def _arguments(
        self, state: State, v0: int, v1: int, recording: int, curved: bool
    ) -> tuple[ViewCorners, Noise, DirectParameters, ViewPoses]:
        """Arguments of the kernels for views v0..v1 of one recording. curved: use the true curvature of the loss."""
        image, body = self.views.image[v0:v1], self.views.body[v0:v1]
        columns, pars = self._columns(recording, body)
        s, n = self.stream, self.noise
        images = ViewCorners(self.views.start[v0 : v1 + 1], s.uv, s.point, self.keep, self.keyframe[image])
        noise = Noise(n.sigma, LOSSES[n.loss], n.loss_scale, curved, n.field, 1.0 / n.tau**2)
        bloom = float(state.values[self.name, "bloom"][0])
        R_ws, R_sb = _scene(state, recording), self.bodies.poses(state.values)[0]
        basis = np.ascontiguousarray(
            self.bodies.deformation @ (R_ws @ R_sb)[self.bodies.target.body].transpose(0, 2, 1)
        )
        motion = self._motion(state, image, body, R_ws, columns)
        return images, noise, DirectParameters(pars, bloom, self.direction, basis), motion

    def _motion(
        self, state: State, image: np.ndarray, body: np.ndarray, R_ws: np.ndarray, columns: np.ndarray
    ) -> ViewPoses:
        """Camera and body poses of n views. image, body (n,): indices, sorted by image; columns: see `ViewPoses`."""
        i0 = int(image[0])
        camera, knots = self.knot_poses(state, i0, int(image[-1]) + 1), self.n_knots
        if not np.array_equal(image, np.arange(i0, i0 + len(camera.R_sensor_world) // knots)):
            camera = camera.part(((image - i0)[:, None] * knots + np.arange(knots)).ravel())
        R_sb, p_sb = (x[body if self.bodies.several else body[:0]] for x in self.bodies.poses(state.values))
        return ViewPoses(camera, knots, np.ascontiguousarray(R_ws), R_ws @ R_sb, p_sb @ R_ws.T, columns)

    def _chunks(
        self, state: State, images: ViewCorners, motion: ViewPoses, recording: int, jacobians: bool
    ) -> Iterator[tuple[int, int, CornerProjection]]:
        """Ranges a..b of at most `VIEWS_PER_CHUNK` views, and their projections, with Jacobians if wanted."""
        params = self.lens(state)
        world, start, camera = self.world_points(state, recording), images.start, motion.camera
        for a in range(0, len(images.keyframe), VIEWS_PER_CHUNK):
            b = min(a + VIEWS_PER_CHUNK, len(images.keyframe))
            X, rows = np.empty((start[b] - start[a], 3)), None
            if self.shutter is None:
                camera_points(a, b, start, images.point, camera.R_sensor_world, camera.p_world_sensor, world, X)
            else:
                rows = self._points_of_rows(state, slice(int(start[a]), int(start[b])), world, X)
            by_rows = row_jacobians(rows, X)
            if jacobians:
                yield a, b, CornerProjection(int(start[a]), X, *self.model.project_with_jacobians(params, X), *by_rows)
            else:
                uv, valid, none = *self.model.project(params, X), (np.zeros((0, 2, 3)), np.zeros((0, 2, 0)))
                yield a, b, CornerProjection(int(start[a]), X, uv, valid, *none, *by_rows)

    def _blocks_of(self, piece: Piece) -> Iterator[tuple[int, int, int]]:
        """Ranges of views whose keyframe is in `piece`, and the recording of each.

        The last keyframe of a piece belongs to the next piece, except at the end of the chain."""
        stop = piece.last + 1 if piece.last == self.n_keyframes - 1 else piece.last
        images = np.searchsorted(self.keyframe, [piece.first, stop])
        v0, v1 = (int(v) for v in np.searchsorted(self.views.image, images))
        for first in range(v0, v1, VIEWS_PER_BLOCK):
            yield from self.parts(first, min(first + VIEWS_PER_BLOCK, v1))


def _scene(state: State, recording: int) -> np.ndarray:
    """R_world_scene (3, 3) of a recording; both frames have the same origin."""
    return state.values[in_recording(BOARD, recording), "tilt"]


# Residual statistics of the corners of one camera, and the degrees of freedom that the fit takes from them.

CORNERS, SHIFT, DELAY = "corners", "common error", "stamp jitter"  # kinds of residuals


def corner_squares(camera: CornerFactor, out: CornerOutput) -> dict[FitKey, Squares]:
    """Number and chi^2 of the corners, and of the coefficients of each common error."""
    squares = {(camera.name, CORNERS): Squares(2 * int(np.count_nonzero(out.root)), camera.chi2(out))}
    for kind, coefficients in _shared_kinds(camera).items():
        rows = out.shared[:, coefficients] / camera.noise.tau[coefficients]
        squares[camera.name, kind] = Squares(rows.size, float((rows**2).sum()))
    return squares


def _shared_kinds(camera: CornerFactor) -> dict[str, slice]:
    """Coefficients of each kind of common error that is modelled: a shift has two, a delay one."""
    m = len(camera.noise.tau)
    shifts = m - m % 2
    kinds = {SHIFT: slice(0, shifts), DELAY: slice(shifts, m)}
    return {kind: part for kind, part in kinds.items() if part.start < part.stop}


def image_rows(
    sensor: str, kind: str, seconds: np.ndarray, residual: np.ndarray, sigma: np.ndarray, root: np.ndarray
) -> ResidualRows:
    """Residuals (n, 2) px of one sensor as `ResidualRows`.

    seconds (n,) s; sigma (n,) px per axis; root (n,) 1/px: square root of the robust weight, over sigma."""
    two = residual.shape
    sigma, root = np.broadcast_to(sigma[:, None], two), np.broadcast_to((root * sigma)[:, None], two)
    return ResidualRows(sensor, kind, "px", seconds, residual, sigma, residual / sigma, root)


def rms_px(residual: np.ndarray, root: np.ndarray) -> float | None:
    """RMS per axis of the residuals (N, 2) px with root (N,) > 0, the square root of the weight; None without any."""
    used = residual[root > 0.0]
    return float(np.sqrt(np.mean(used**2, dtype=np.float64))) if len(used) else None


def dof_used_by_corners(camera: CornerFactor, out: CornerOutput, along: StateDifference) -> dict[FitKey, float]:
    """See `Factor.dof_used`."""
    dof = in_parallel(partial(_dof_used_by_views, camera, out, along), camera.blocks())
    return {(camera.name, kind): sum(block[kind] for block in dof) for kind in (dof[0] if dof else ())}


def _dof_used_by_views(
    camera: CornerFactor, at: CornerOutput, step: StateDifference, views: tuple[int, int]
) -> dict[str, float]:
    """|J x|^2 of the range `views` by kind of residual, for the step x; the mean over common errors given x."""
    rows, n, m = camera.corners_of(*views), views[1] - views[0], len(camera.noise.tau)
    up, down = (camera.residual(state, *views) for state in (step.end, step.start))
    root, view = at.root[rows], camera.views.of_corners(*views) - views[0]
    along = (up - down) / step.share * root[:, None]
    if m == 0:
        return {CORNERS: float((along**2).sum())}
    # The common error c minimises |along + f c|^2 + |c / tau|^2; its covariance about the minimum is M^-1.
    f = camera.noise.field[rows] * root[:, None, None]
    M, rhs = np.zeros((n, m, m)), np.zeros((n, m))
    np.add.at(M, view, np.einsum("iak,ial->ikl", f, f))
    np.add.at(rhs, view, -np.einsum("iak,ia->ik", f, along))
    M += np.diag(1.0 / camera.noise.tau**2)
    inverse = np.linalg.inv(M)
    shared = np.einsum("vkl,vl->vk", inverse, rhs)
    total = float(((along + np.einsum("iak,ik->ia", f, shared[view])) ** 2).sum())
    total += float(np.einsum("iak,ikl,ial->", f, inverse[view], f))
    spent = (shared**2 + np.diagonal(inverse, axis1=1, axis2=2)).sum(axis=0) / camera.noise.tau**2
    return {CORNERS: total} | {kind: float(spent[part].sum()) for kind, part in _shared_kinds(camera).items()}


# Corners of one camera, grouped by image and body of the target.


@dataclass(frozen=True)
class Views:
    """V views; a view is one body of the target in one image.

    start (V + 1,): corners of view j are start[j]:start[j + 1]; image, body (V,): indices of its image and body."""

    start: np.ndarray
    image: np.ndarray
    body: np.ndarray

    @classmethod
    def of(cls, stream: CornerStream, body: np.ndarray) -> Views:
        """Views of a stream whose corners are sorted by body in each image.

        body (n_points,): index of the body of each target point."""
        if not body.any():
            images = np.flatnonzero(np.diff(stream.start))
            start = np.append(stream.start[images], stream.start[-1])
            return cls(start, images, np.zeros(len(images), dtype=np.int64))
        body_of_corner, image = body[stream.point], stream.image
        fresh = np.ones(len(body_of_corner), dtype=bool)
        fresh[1:] = (np.diff(image) != 0) | (np.diff(body_of_corner) != 0)
        first = np.flatnonzero(fresh)
        return cls(np.append(first, len(body_of_corner)).astype(np.int64), image[first], body_of_corner[first])

    def of_corners(self, v0: int, v1: int) -> np.ndarray:
        """(n,) index of the view of each corner of views v0..v1."""
        return np.repeat(np.arange(v0, v1), np.diff(self.start[v0 : v1 + 1]))
