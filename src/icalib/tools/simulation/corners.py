"""Simulated corners of the target in each image, with noise, blur, bloom and outliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import CornerStream, TrackStream
from icalib.geometry.targets import Target
from icalib.tools.simulation.motion import inside
from icalib.tools.simulation.projection import image_velocity, project, visible
from icalib.tools.simulation.room import Room, distances
from icalib.tools.simulation.scenario import Scenario, SimCamera
from icalib.tools.simulation.trajectory import Features, TrueTrajectory, by_clock, check_enough

_MIN_CORNERS = 6  # images with fewer are dropped
_LEAD_S = 0.05  # images start this long after the IMU, and end this long before it
_DIFFERENCE_S = 1e-4  # half a step of central differences for the image speed
_RIM = 64  # points on the rim of a circle
_ROW_STEPS = 12  # to the instant of a row; each leaves image speed times line delay of the error, 0.06 at most


@dataclass(frozen=True, eq=False)
class CornerTruth:
    """Truth of M images and N corners. seconds (M,): instants of the images on the IMU's clock since its origin. uv
    (N, 2): corners with bloom, before noise and outliers [px]; sigma (N,): of the white noise [px]; outlier (N,)
    bool."""

    seconds: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray
    outlier: np.ndarray


def board_surface(target: Target, bow: tuple[float, float, float], points: np.ndarray) -> np.ndarray:
    """points (n, 3), one for each point of the target, moved out of the planes of bodies that bend by
    z = a x^2 + b x y + c y^2. bow: (a, b, c) [m], see `Scenario`."""
    bent = points.copy()
    for body in np.flatnonzero(target.bends):
        of_body = target.body == body
        low, high = target.points[of_body, :2].min(axis=0), target.points[of_body, :2].max(axis=0)
        x, y = ((points[of_body, :2] - 0.5 * (low + high)) / (0.5 * (high - low))).T
        bent[of_body, 2] += bow[0] * x**2 + bow[1] * x * y + bow[2] * y**2
    return bent


def image_stamps(scenario: Scenario, camera: SimCamera, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (M,) int64 [ns] of the images on the camera's clock, and their true instants (M,) [s] on the IMU's clock
    since its origin."""
    span = scenario.duration_s - 2.0 * _LEAD_S - camera.phase_s
    taken = _LEAD_S + camera.phase_s + np.arange(int(span * camera.rate_hz) + 1) / camera.rate_hz
    taken += rng.uniform(-camera.jitter_s, camera.jitter_s, len(taken))
    stamps, seconds = by_clock(camera, taken, 0.5 * scenario.duration_s)
    kept = ~inside(camera.dropouts, seconds)
    return stamps[kept], seconds[kept]


def see_corners(
    scenario: Scenario, camera: SimCamera, trajectory: TrueTrajectory, rng: np.random.Generator
) -> tuple[CornerStream, CornerTruth]:
    """Measured corners of one camera, and their truth; images with fewer than 6 corners are dropped."""
    stamps, seconds = image_stamps(scenario, camera, rng)
    surface = board_surface(scenario.target, scenario.bow, scenario.target.points)
    points, instants = _at_rows(camera, seconds, lambda t: _in_camera(scenario, camera, trajectory, t, surface))
    uv = project(camera, points)
    in_view = visible(camera, points, uv) & _from_the_front(scenario, camera, trajectory, seconds)
    in_view &= _complete_tags(scenario.target, in_view)
    enough = in_view.sum(axis=1) >= _MIN_CORNERS
    stamps, seconds, points, uv, in_view = stamps[enough], seconds[enough], points[enough], uv[enough], in_view[enough]
    instants = instants[enough]

    uv = uv + camera.bloom_px * _towards_tag_center(scenario, camera, trajectory, instants, points)
    uv = uv + _to_ellipse_centres(scenario, camera, trajectory, instants, uv)
    sigma = _corner_sigma(scenario, camera, trajectory, instants, in_view)
    image, point = np.nonzero(in_view)
    true = uv[in_view]
    sigma = sigma[image]
    shift = scenario.shift_px * float(scenario.corner_noise_enabled) * rng.standard_normal((len(stamps), 2))
    measured = true + sigma[:, None] * rng.standard_normal(true.shape) + shift[image]
    outlier = rng.random(len(true)) < scenario.outlier_fraction
    measured[outlier] += rng.uniform(-scenario.outlier_px, scenario.outlier_px, (int(outlier.sum()), 2))
    start = np.concatenate([[0], np.cumsum(in_view.sum(axis=1))]).astype(np.int64)
    stream = CornerStream(camera.name, stamps, start, point.astype(np.int64), measured)
    return stream, CornerTruth(seconds, true, sigma, outlier)


def _at_rows(
    camera: SimCamera, seconds: np.ndarray, points_at: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, n, 3) m in the camera frame, each when its row is exposed, and these instants (M, n), by fixed-point
    iteration. points_at: gives the points at instants (M,) or (M, n). A global shutter exposes all at seconds (M,)."""
    points, instants, axis = points_at(seconds), seconds, ("columns", "rows").index(camera.rolling)
    for _ in range(_ROW_STEPS if camera.readout_s else 0):
        phase = (project(camera, points)[..., axis] + 0.5) / camera.resolution[axis] - 0.5
        instants = seconds[:, None] + camera.readout_s * np.clip(phase, -0.5, 0.5)
        points = points_at(instants)
    return points, instants


def _at_row_times(camera: SimCamera, trajectory: TrueTrajectory, seconds: float, world: np.ndarray) -> np.ndarray:
    """(n, 3) m: points `world` (n, 3) of the world, in one image, see `_at_rows`."""
    return _at_rows(camera, np.array([seconds]), lambda t: _to_camera(camera, trajectory, t, world))[0][0]


def _in_camera(
    scenario: Scenario, camera: SimCamera, trajectory: TrueTrajectory, seconds: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """(M, n, 3) m: points (n, 3), one for each point of the target in the stated size, in the camera frame at M
    instants, or at (M, n) of their own. The true size is applied here."""
    T_world_body = scenario.body_poses[scenario.target.body]
    world = np.einsum("nij,nj->ni", T_world_body[:, :3, :3], scenario.target_size * points) + T_world_body[:, :3, 3]
    return _to_camera(camera, trajectory, seconds, world)


def _to_camera(camera: SimCamera, trajectory: TrueTrajectory, seconds: np.ndarray, world: np.ndarray) -> np.ndarray:
    """(M, n, 3) m: points `world` (n, 3) of the world in the camera frame at M instants, or at (M, n) of their own."""
    rotation, position, _ = trajectory.pose_at(seconds.ravel())
    if seconds.ndim == 1:
        imu = (world - position[:, None, :]) @ rotation
    else:
        away = world - position.reshape(*seconds.shape, 3)
        imu = np.einsum("mni,mnij->mnj", away, rotation.reshape(*seconds.shape, 3, 3))
    return (imu - camera.T_imu_sensor[:3, 3]) @ camera.T_imu_sensor[:3, :3]


def _from_the_front(
    scenario: Scenario, camera: SimCamera, trajectory: TrueTrajectory, seconds: np.ndarray
) -> np.ndarray:
    """(M, n) bool: whether the camera is on the printed side of the body of each of n points at M instants. Bodies do
    not hide each other."""
    rotation, position, _ = trajectory.pose_at(seconds)
    lens = position + rotation @ camera.T_imu_sensor[:3, 3]
    origin, normal = scenario.body_poses[:, :3, 3], scenario.body_poses[:, :3, 2]
    return (np.sum((lens[:, None] - origin) * normal, axis=-1) > 0.0)[:, scenario.target.body]


def _complete_tags(target: Target, in_view: np.ndarray) -> np.ndarray:
    """(M, n) bool: False for points of a free tag that is not seen completely, as it then cannot be identified."""
    complete = np.ones_like(in_view)
    for body in np.flatnonzero(~target.bends):
        of_body = target.body == body
        complete[:, of_body] = in_view[:, of_body].all(axis=1, keepdims=True)
    return complete


def _towards_tag_center(
    scenario: Scenario, camera: SimCamera, trajectory: TrueTrajectory, seconds: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """(M, N, 2) unit vectors in the image from each corner towards the centre of its tag, which lies on the bent board.

    They are zero for targets without bloom.
    """
    if not scenario.target.blooms:
        return np.zeros((*points.shape[:2], 2))
    surface = board_surface(scenario.target, scenario.bow, scenario.target.tag_centers)
    direction = image_velocity(camera, points, _in_camera(scenario, camera, trajectory, seconds, surface) - points)
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def _to_ellipse_centres(
    scenario: Scenario, camera: SimCamera, trajectory: TrueTrajectory, seconds: np.ndarray, uv: np.ndarray
) -> np.ndarray:
    """(M, N, 2) px: offset from the projected centre uv (M, N, 2) of each circle to the centroid of its image; zero for
    targets without circles."""
    target = scenario.target
    if not target.radii.any():
        return np.zeros_like(uv)
    surface = board_surface(target, scenario.bow, target.points)

    def rim(k: int) -> np.ndarray:
        angle = 2.0 * np.pi * k / _RIM
        beside = target.radii[:, None] * np.array([np.cos(angle), np.sin(angle), 0.0])
        return project(camera, _in_camera(scenario, camera, trajectory, seconds, surface + beside)) - uv

    area, moment, a = np.zeros(uv.shape[:2]), np.zeros_like(uv), rim(0)
    for k in range(1, _RIM + 1):
        b = rim(k)
        cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        area += 0.5 * cross
        moment += (a + b) * cross[..., None] / 6.0
        a = b
    return np.where(target.radii[:, None] > 0.0, moment / np.where(area == 0.0, 1.0, area)[..., None], 0.0)


def _corner_sigma(
    scenario: Scenario, camera: SimCamera, trajectory: TrueTrajectory, seconds: np.ndarray, in_view: np.ndarray
) -> np.ndarray:
    """(M,) standard deviation of the corner noise in each image [px]; in_view (M, N) bool: visible corners."""
    if not scenario.corner_noise_enabled:
        return np.zeros(len(seconds))
    surface = board_surface(scenario.target, scenario.bow, scenario.target.points)
    before, after = (
        project(camera, _in_camera(scenario, camera, trajectory, seconds + dt, surface))
        for dt in (-_DIFFERENCE_S, _DIFFERENCE_S)
    )
    velocity = np.where(in_view[..., None], (after - before) / (2.0 * _DIFFERENCE_S), 0.0)
    mean_square_speed = np.sum(velocity**2, axis=(1, 2)) / in_view.sum(axis=1)
    return np.sqrt(camera.corner_noise_px**2 + scenario.blur_s**2 * mean_square_speed)


# Simulated feature tracks: points of the room that cameras track from image to image.

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
        if camera.readout_s:
            local = _at_row_times(camera, trajectory, seconds, points[visible_points])
            uv[visible_points] = project(camera, local)
            visible_points = visible_points[visible(camera, local, uv[visible_points])]
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
