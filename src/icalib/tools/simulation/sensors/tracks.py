"""Simulated feature tracks: points of the room that cameras track from image to image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.tools.simulation.scenario.instants import check_enough
from icalib.tools.simulation.scenario.projection import project, visible
from icalib.tools.simulation.scenario.robot import Features
from icalib.tools.simulation.scenario.room import Room, distances
from icalib.tools.simulation.scenario.scenario import Scenario, SimCamera
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory
from icalib.tools.simulation.sensors.corners import image_stamps

_NEAREST_M = 0.3
_LOST_PERIODS = 1.5


@dataclass(frozen=True, eq=False)
class TrackTruth:
    """Truth of M images and N tracked points. seconds (M,): instants of the images on the IMU's clock since its origin;
    uv (N, 2): image points without noise [px]."""

    seconds: np.ndarray
    uv: np.ndarray


@dataclass(frozen=True, eq=False)
class SimulatedTracks:
    """Feature tracks of all cameras, and their truth. points (F, 3): position of each feature in the world [m]."""

    streams: tuple[TrackStream, ...]
    truths: tuple[TrackTruth, ...]
    points: np.ndarray


def follow(
    scenario: Scenario, room: Room, features: Features, trajectory: TrueTrajectory, seed: int
) -> SimulatedTracks:
    """Feature tracks of all cameras. The stamps of images are those of the corners; the noise of a camera is its
    `corner_noise_px`."""
    rng = np.random.default_rng(features.seed)
    surface, normal = room.points(features.count, rng)
    points = surface + features.relief_m * rng.standard_normal((len(surface), 1)) * normal
    front_end = _FrontEnd(features, min(c.rate_hz for c in scenario.cameras), np.random.default_rng([seed, 2, 0, 1]))
    images = [image_stamps(scenario, c, np.random.default_rng([seed, 2 + i])) for i, c in enumerate(scenario.cameras)]
    for camera, (stamps, _) in zip(scenario.cameras, images, strict=True):
        check_enough(camera.name, stamps)
    due = sorted((s, i, k) for i, (_, seconds) in enumerate(images) for k, s in enumerate(seconds.tolist()))
    tracked: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in scenario.cameras]
    poses = [trajectory.pose_at(seconds)[:2] for _, seconds in images]
    for seconds, i, k in due:
        camera, (rotation, position) = scenario.cameras[i], poses[i]
        visible_points, uv = _view(camera, room, features, points, surface, (rotation[k], position[k]))
        chosen, number = front_end.choose(i, seconds, visible_points)
        tracked[i].append((number, uv[chosen]))
    noise = float(scenario.robot_noise_enabled)
    streams, truths = zip(
        *(
            _stream(c, images[i], tracked[i], noise, np.random.default_rng([seed, 2 + i, 0, 2]))
            for i, c in enumerate(scenario.cameras)
        ),
        strict=True,
    )
    return SimulatedTracks(streams, truths, points[front_end.point_of()])


def _view(
    camera: SimCamera,
    room: Room,
    features: Features,
    points: np.ndarray,
    surface: np.ndarray,
    pose: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the visible points, and image points (N, 2) [px] of all points. A point is visible if it is in range,
    in the image and not occluded. surface (N, 3): points without relief, for which occlusion is tested. pose:
    R_world_imu, p_world_imu [m]."""
    rotation, position = pose
    eye = position + rotation @ camera.T_imu_sensor[:3, 3]
    rays = points - eye
    local = rays @ (rotation @ camera.T_imu_sensor[:3, :3])
    far = np.linalg.norm(rays, axis=1)
    near = (far > _NEAREST_M) & (far < features.range_m) & (local[:, 2] > 0.0)
    uv = np.full((len(points), 2), np.nan)
    uv[near] = project(camera, local[near])
    visible_points = np.flatnonzero(near)
    visible_points = visible_points[visible(camera, local[visible_points], uv[visible_points])]
    hit, rays = np.empty(len(visible_points)), surface[visible_points] - eye
    far = np.linalg.norm(rays, axis=1)
    distances(room.surfaces, np.broadcast_to(eye, (len(visible_points), 3)), rays, hit)
    return visible_points[hit * far > far - 1e-4], uv


class _FrontEnd:
    """A tracking front end: chooses the points that each camera tracks, and their feature numbers."""

    def __init__(self, features: Features, slowest_hz: float, rng: np.random.Generator) -> None:
        self._features, self._rng = features, rng
        self._lost_after = _LOST_PERIODS / slowest_hz
        self._number = np.full(features.count, -1)
        self._number[: features.persistent] = np.arange(features.persistent)
        self._born = np.full(features.count, -np.inf)
        self._last = np.full(features.count, -np.inf)
        self._points = list(range(features.persistent))
        self._tracked: dict[int, np.ndarray] = {}

    def choose(self, camera: int, seconds: float, visible_points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points among `visible_points` that the camera tracks at an instant, and their feature numbers.

        Points that the camera tracked in its last image go first, then those that another camera tracks, then others.
        """
        alive = self._alive(seconds, visible_points)
        before = np.isin(visible_points, self._tracked.get(camera, np.empty(0, dtype=np.int64)))
        order = np.lexsort((self._rng.random(len(visible_points)), ~alive, ~before))[: self._features.per_image]
        chosen = np.sort(visible_points[order])
        new = chosen[~self._alive(seconds, chosen)]
        self._number[new] = len(self._points) + np.arange(len(new))
        self._points += new.tolist()
        self._born[new] = seconds
        self._last[chosen] = seconds
        self._tracked[camera] = chosen
        return chosen, self._number[chosen].copy()

    def _alive(self, seconds: float, points: np.ndarray) -> np.ndarray:
        """(n,) bool: whether the feature numbers of `points` (n,) are still valid."""
        recent = seconds - self._last[points] <= self._lost_after
        young = seconds - self._born[points] <= self._features.longest_track_s
        return (points < self._features.persistent) | (recent & young)

    def point_of(self) -> np.ndarray:
        """(F,) number of the point of each feature."""
        return np.array(self._points, dtype=np.int64)


def _stream(
    camera: SimCamera,
    images: tuple[np.ndarray, np.ndarray],
    tracked: list[tuple[np.ndarray, np.ndarray]],
    noise: float,
    rng: np.random.Generator,
) -> tuple[TrackStream, TrackTruth]:
    number = np.concatenate([n for n, _ in tracked])
    true = np.concatenate([uv for _, uv in tracked])
    start = np.concatenate([[0], np.cumsum([len(n) for n, _ in tracked])]).astype(np.int64)
    measured = true + noise * camera.corner_noise_px * rng.standard_normal(true.shape)
    return TrackStream(camera.name, images[0], start, number, measured), TrackTruth(images[1], true)
