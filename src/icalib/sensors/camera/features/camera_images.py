"""Images of one camera in a range of keyframes: observations of tracks, poses, and projections of points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from icalib.motion.sensor_pose import SensorPose
from icalib.optim.robust_weights import Loss
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.kernels import TrackObservations, TrackProjection, camera_points
from icalib.sensors.camera.features.point_search import PointSearch, add_to_points, moving_points

OBSERVATIONS_PER_CHUNK = 4096  # observations that are projected at once; their arrays fit into the processor's cache


@dataclass(frozen=True)
class CameraImages:
    """The n images from number `first` on of one camera, whose index is `index`.

    params (P,): parameters of the camera model; observed: observations of tracks; poses: camera poses. columns
    (n, c + d): indices of calibration parameters, c of the pose, then d of the free lens parameters, -1 where fixed;
    pars (d,): indices of the free lens parameters."""

    camera: CornerFactor
    index: int
    first: int
    params: np.ndarray
    observed: TrackObservations
    poses: SensorPose
    columns: np.ndarray
    pars: np.ndarray

    def chunks(self) -> Iterator[tuple[CameraImages, slice]]:
        """Splits the images at about every `OBSERVATIONS_PER_CHUNK` observations: parts, and slices of their images."""
        start = self.observed.start
        cuts = np.searchsorted(start, np.arange(start[0], start[-1], OBSERVATIONS_PER_CHUNK), side="left")
        cuts = np.unique([0, *cuts, len(start) - 1])
        for a, b in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
            yield self._part(a, b), slice(a, b)

    def _part(self, a: int, b: int) -> CameraImages:
        """The images a..b of these, counted from the first."""
        observed, images = self.observed, slice(a, b)
        observed = observed._replace(start=observed.start[a : b + 1], keyframe=observed.keyframe[images])
        return replace(
            self, first=self.first + a, observed=observed, poses=self.poses.part(images), columns=self.columns[images]
        )

    def in_camera(self, points: np.ndarray, track: int) -> np.ndarray:
        """(n, 3) m: the point of each observation in the camera frame.

        points (T, 3) m: points of the tracks from number `track` on, in the world frame."""
        observed, at = self.observed, self.poses
        X = np.empty((int(observed.start[-1] - observed.start[0]), 3))
        camera_points(observed, track, at.R_sensor_world, at.p_world_sensor, points, X)
        return X

    def projection(self, X: np.ndarray) -> TrackProjection:
        """Projection, with Jacobians, of the points X (n, 3) m of all n observations, in the camera frame."""
        projection = self.camera.model.project_with_jacobians(self.params, X)
        return TrackProjection(int(self.observed.start[0]), *projection, self.pars)

    def add_to_points(self, track: int, loss: Loss, points: PointSearch) -> None:
        """Adds the observations of points that have not converged to their normal equations in `points`.

        points: search for the points of the tracks from number `track` on."""
        for part, _ in self.chunks():
            observed, at = part.observed, part.poses
            most = int(observed.start[-1] - observed.start[0])
            image, which, X = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64), np.empty((most, 3))
            m = moving_points(observed, track, at.R_sensor_world, at.p_world_sensor, points, image, which, X)
            if m:
                uv, valid, J_point, _ = self.camera.model.project_with_jacobians(self.params, X[:m])
                R = at.R_sensor_world
                add_to_points(observed, track, R, image[:m], which[:m], uv, valid, J_point, loss, points)
