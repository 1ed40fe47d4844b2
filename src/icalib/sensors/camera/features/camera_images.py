"""What a camera that follows points saw from a stretch of keyframes, and how it moved there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from icalib.motion.sensor_pose import SensorPose
from icalib.optim.robust_weights import Loss
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.kernels import (
    Points,
    Seeing,
    Seen,
    add_to_points,
    camera_points,
    moving_points,
)

CHUNK = 4096  # observations at a time: what a chunk needs stays in the cache, in memory that is used again


@dataclass(frozen=True)
class View:
    """Images of one camera, `first` and on, number `index` of all cameras: what it saw in them, and its poses. columns
    (n, c + d): calibration columns of its pose in each image, then of its free parameters `pars` (d,)."""

    camera: CornerFactor
    index: int
    first: int
    params: np.ndarray
    seen: Seen
    poses: SensorPose
    columns: np.ndarray
    pars: np.ndarray

    def chunks(self) -> Iterator[tuple[View, slice]]:
        """Parts of the view, and which of its images are theirs."""
        start = self.seen.start
        cuts = np.searchsorted(start, np.arange(start[0], start[-1], CHUNK), side="left")
        cuts = np.unique([0, *cuts, len(start) - 1])
        for a, b in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
            yield self._part(a, b), slice(a, b)

    def _part(self, a: int, b: int) -> View:
        """Its images a..b."""
        seen, own = self.seen, slice(a, b)
        seen = seen._replace(start=seen.start[a : b + 1], keyframe=seen.keyframe[own])
        return replace(self, first=self.first + a, seen=seen, poses=self.poses.part(own), columns=self.columns[own])

    def in_camera(self, points: np.ndarray, track: int) -> np.ndarray:
        """(n, 3) the points of tracks `track` and on, in the camera, for each observation."""
        seen, at = self.seen, self.poses
        X = np.empty((int(seen.start[-1] - seen.start[0]), 3))
        camera_points(seen, track, at.R_sensor_world, at.p_world_sensor, points, X)
        return X

    def seeing(self, X: np.ndarray) -> Seeing:
        """The observations of points at X (n, 3) in the camera."""
        found = self.camera.model.project_with_jacobians(self.params, X)
        return Seeing(int(self.seen.start[0]), *found, self.pars)

    def add_to_points(self, track: int, loss: Loss, points: Points) -> None:
        """Adds what the observations say of those points, of tracks `track` and on, that still move."""
        for part, _ in self.chunks():
            seen, at = part.seen, part.poses
            most = int(seen.start[-1] - seen.start[0])
            image, which, X = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64), np.empty((most, 3))
            m = moving_points(seen, track, at.R_sensor_world, at.p_world_sensor, points, image, which, X)
            if m:
                uv, valid, J_point, _ = self.camera.model.project_with_jacobians(self.params, X[:m])
                R = at.R_sensor_world
                add_to_points(seen, track, R, image[:m], which[:m], uv, valid, J_point, loss, points)
