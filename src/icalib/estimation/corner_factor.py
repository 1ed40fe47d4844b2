"""Corners of a known target in the images of one camera (paper (20)-(22)).

residual = K(X) + bloom * direction - uv,  X = R_cam_world (R_world_board P - p_world_cam),
P the target's point, moved by the board's shape. All corners of an image share one pose: their small Gram matrix over
(camera pose, what belongs to the camera or the board) is summed first, the pose's Jacobians are applied once an image.

An error that all corners of an image share, a field of functions of the corner with sizes N(0, tau^2), is marginalised
image by image.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from icalib.estimation.arrowhead import Piece
from icalib.estimation.board import board_in
from icalib.estimation.corner_kernels import (
    Direct,
    Found,
    Given,
    Images,
    Motion,
    Noise,
    Predicted,
    accumulate,
    accumulate_clusters,
    camera_points,
)
from icalib.estimation.imu_data import ImuData
from icalib.estimation.poses import Poses, poses_at, poses_of_nodes
from icalib.estimation.state import Layout, State
from icalib.geometry.cameras.base import CameraModel
from icalib.measurements import CornerStream
from icalib.rig import Scheme

CHUNK = 64  # images at a time: what a chunk needs stays in the cache
LOSSES = {"none": 0, "huber": 1, "cauchy": 2}


@dataclass(frozen=True)
class CornerNoise:
    """What is known of corner errors: sigma (M,) px per image; tau (m,) px, sizes of the error an image shares, along
    the functions `field` (N, m) of the corner; the robust loss and where it starts to bend, in sigma."""

    sigma: np.ndarray
    tau: np.ndarray
    field: np.ndarray
    loss: str = "none"
    loss_scale: float = 2.5


@dataclass(frozen=True)
class CornerOutput:
    """Per corner: residual (N, 2) px, predicted - measured, and root (N,), square root of its weight over sigma (0
    where
    left out); per image: shared (M, 2, m), the sizes of the common error."""

    residual: np.ndarray
    root: np.ndarray
    shared: np.ndarray

    @classmethod
    def empty(cls, stream: CornerStream, m: int) -> CornerOutput:
        n = len(stream.uv)
        return cls(np.zeros((n, 2)), np.zeros(n), np.zeros((len(stream.stamps_ns), 2, m)))


@dataclass(frozen=True)
class CornerFactor:
    """All images of one camera.

    times (M,): stamps on the imu clock at zero offset beyond `stream`'s origin; node (M,), increasing: the node each
    image hangs on; keep (N,): corners in use; direction (N, 2) image direction of the bloom, (0, 2) without it;
    basis (n_points, s, 3): how the target's points move with its shape; seams: the images that begin further
    recordings, in which the target stands elsewhere.
    """

    stream: CornerStream
    model: CameraModel
    imu: ImuData | None
    gravity: float
    scheme: Scheme
    times: np.ndarray
    node: np.ndarray
    keep: np.ndarray
    noise: CornerNoise
    direction: np.ndarray
    target: str
    points: np.ndarray
    basis: np.ndarray
    layout: Layout
    n_nodes: int
    seams: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        return self.stream.name

    def boards(self, i0: int, i1: int) -> Iterator[tuple[int, int, str]]:
        """Images i0..i1 recording by recording, each with the name of the target there."""
        for k, (first, end) in enumerate(pairwise((0, *self.seams, len(self.node)))):
            a, b = max(i0, first), min(i1, end)
            if a < b:
                yield a, b, board_in(self.target, k)

    def world_points(self, state: State, board: str) -> np.ndarray:
        """(n_points, 3) the target's points, shape included, in the world frame of `board`'s recording."""
        shape = state.values[self.target, "shape"]
        points = self.points + np.einsum("nsk,s->nk", self.basis, shape)
        return points @ state.values[board, "tilt"].T

    def camera_poses(self, state: State, i0: int = 0, i1: int | None = None) -> tuple[Poses, np.ndarray, np.ndarray]:
        """IMU poses, and R_cam_world (n, 3, 3), p_world_cam (n, 3) at the instants of images i0..i1."""
        if self.imu is None:
            poses = poses_of_nodes(self.node[i0:i1], state)
        else:
            times = self.times[i0:i1] + state.values[self.name, "time_offset"][0]
            imu_free = self.layout.block(self.imu.name, "intrinsics").start is not None
            poses = poses_at(self.scheme, times, self.node[i0:i1], state, self.imu, self.gravity, imu_free)
        R_ic, p_ic = state.values[self.name, "rotation"], state.values[self.name, "translation"]
        R_cw = np.ascontiguousarray((poses.rotation @ R_ic).transpose(0, 2, 1))
        return poses, R_cw, poses.position + poses.rotation @ p_ic

    def points_in_camera(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """X (N, 3), each corner's point in its camera's frame, and R_cam_board (M, 3, 3)."""
        _, R_cw, p_wc = self.camera_poses(state)
        X, R_cb, start = np.empty((len(self.stream.uv), 3)), np.empty_like(R_cw), self.stream.start
        for a, b, board in self.boards(0, len(self.node)):
            world = self.world_points(state, board)
            camera_points(a, b, start, self.stream.point, R_cw, p_wc, world, X[start[a] : start[b]])
            R_cb[a:b] = R_cw[a:b] @ state.values[board, "tilt"]
        return X, R_cb

    def with_direction(self, direction: np.ndarray) -> CornerFactor:
        """The same factor with bloom along `direction` (N, 2)."""
        return replace(self, direction=direction)

    def _columns(self, board: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Border columns of the chained and of the direct parameters, and which model parameters the latter hold."""
        nothing = np.zeros(0, dtype=np.int64)
        imu = nothing if self.imu is None else self.layout.columns(self.imu.name, "intrinsics")
        chained = [
            self.layout.columns(self.name, "rotation", "translation", "time_offset"),
            self.layout.columns(board, "tilt"),
            imu[imu >= 0],
        ]
        model = self.layout.columns(self.name, "intrinsics", "distortion")
        pars = np.flatnonzero(model >= 0)
        direct = [model[pars]]
        if len(self.direction):
            direct.append(self.layout.columns(self.name, "bloom"))
        direct.append(self.layout.columns(self.target, "shape"))
        return np.concatenate(chained), np.concatenate(direct), pars

    def accumulate(
        self,
        state: State,
        piece: Piece,
        out: CornerOutput,
        sums: bool = True,
        curved: bool = False,
        noise: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> float:
        """Fills `out` for the images whose node lies in `piece`, and adds them to its sums where `sums` are wanted.

        Returns half the robust chi^2. `curved`: J^T J has the true curvature of the robust loss, not its weights alone.
        With `noise` (corners (N, 2), common errors (M, 2, m), white) in place of the
        whitened residuals, returns the quadratic form of the common errors' rows instead.
        """
        white, white_shared = noise or (out.residual, out.shared)
        into, total = piece.sums(sums), 0.0
        for i0, i1, board in self.boards(*self._images(piece)):
            images, noise_model, direct, motion = self._arguments(state, i0, i1, board, curved)
            given = Given(noise is not None, white, white_shared[i0:i1])
            found = Found(out.residual, out.root, out.shared[i0:i1])
            for a, b, predicted in self._chunks(state, images, motion, board, sums):
                total += accumulate(a, b, images, noise_model, direct, motion, predicted, given, into, found)
        return total

    def accumulate_clusters(
        self, state: State, piece: Piece, at: CornerOutput, cluster: np.ndarray, n_clusters: int, column: int
    ) -> None:
        """Adds the gradient of each cluster of corners (N,), weights as in `at`, to columns of `piece` from
        `column` on."""
        into = piece.sums(True)
        for i0, i1, board in self.boards(*self._images(piece)):
            images, noise, direct, motion = self._arguments(state, i0, i1, board, False)
            found = Found(at.residual, at.root, at.shared[i0:i1])
            for a, b, predicted in self._chunks(state, images, motion, board, True):
                accumulate_clusters(
                    a, b, cluster, n_clusters, column, images, noise, direct, motion, predicted, into, found
                )  # fmt: skip

    def _arguments(
        self, state: State, i0: int, i1: int, board: str, curved: bool
    ) -> tuple[Images, Noise, Direct, Motion]:
        """What the kernels need to know of images i0..i1, of one recording."""
        chained, direct, pars = self._columns(board)
        poses, R_cw, p_wc = self.camera_poses(state, i0, i1)
        s, n = self.stream, self.noise
        images = Images(s.start[i0 : i1 + 1], s.uv, s.point, self.keep, self.node[i0:i1])
        noise = Noise(n.sigma[i0:i1], LOSSES[n.loss], n.loss_scale, curved, n.field, 1.0 / n.tau**2)
        bloom = float(state.values[self.name, "bloom"][0])
        basis = self.basis @ state.values[board, "tilt"].T
        R_ic, p_ic = state.values[self.name, "rotation"], state.values[self.name, "translation"]
        motion = Motion(
            np.ascontiguousarray(R_ic), p_ic, R_cw, p_wc, poses.rate, poses.velocity,
            poses.by_node, poses.by_next, poses.by_imu, chained,
        )  # fmt: skip
        return images, noise, Direct(pars, bloom, self.direction, basis, direct), motion

    def _chunks(
        self, state: State, images: Images, motion: Motion, board: str, jacobians: bool
    ) -> Iterator[tuple[int, int, Predicted]]:
        """Images a..b by the chunk, and what the model makes of them."""
        params = np.concatenate([state.values[self.name, "intrinsics"], state.values[self.name, "distortion"]])
        world, start = self.world_points(state, board), images.start
        for a in range(0, len(images.node), CHUNK):
            b = min(a + CHUNK, len(images.node))
            X = np.empty((start[b] - start[a], 3))
            camera_points(a, b, start, images.point, motion.R_cam_world, motion.p_world_cam, world, X)
            if jacobians:
                yield a, b, Predicted(int(start[a]), X, *self.model.project_with_jacobians(params, X))
            else:
                uv, valid = self.model.project(params, X)
                yield a, b, Predicted(int(start[a]), X, uv, valid, np.zeros((0, 2, 3)), np.zeros((0, 2, 0)))

    def _images(self, piece: Piece) -> tuple[int, int]:
        """The images that belong to `piece`: nodes from first to before last, the chain's very last node included."""
        stop = piece.last + 1 if piece.last == self.n_nodes - 1 else piece.last
        i0, i1 = np.searchsorted(self.node, [piece.first, stop])
        return int(i0), int(i1)
