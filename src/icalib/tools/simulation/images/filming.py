"""Simulates recordings with rendered images instead of corners; stamps and motion are those of `simulate`.

Images are rendered by threads on demand, a few ahead, so that a recording is never in memory as a whole.

People in front of a camera: upright boxes that follow it with a delay, and sway from side to side.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.errors import RigError
from icalib.geometry.targets import Markers, Scene, Tag, Target
from icalib.tools.simulation.images.interior import INSTANTS, Interior, RoomRenderer
from icalib.tools.simulation.images.rendering import Imaging, Picture, Renderer, Sheet, SheetTruth, exposure_poses
from icalib.tools.simulation.scenario.image_faults import faults_of
from icalib.tools.simulation.scenario.room import Obstacle
from icalib.tools.simulation.scenario.scenario import Scenario, SimCamera
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory
from icalib.tools.simulation.sensors.corners import image_stamps
from icalib.tools.simulation.sensors.imu import inside
from icalib.tools.simulation.sensors.simulate import Truth, simulate

_AHEAD = 2  # images per thread that are rendered or waiting


@dataclass(frozen=True, eq=False)
class Shot:
    """One image. camera: its name; stamp_ns: on the camera's clock; seconds: true instant on the IMU's clock since its
    origin; pixels (H, W) uint8; target: true image points of the target."""

    camera: str
    stamp_ns: int
    seconds: float
    pixels: np.ndarray
    target: SheetTruth


@dataclass(frozen=True, eq=False)
class Film:
    """A recording of IMU readings and images. exposure_s: exposure time [s], 0 for an instant. `truth.corners` belongs
    to the corners of `simulate`, not to these images."""

    scenario: Scenario
    seed: int
    imaging: Imaging
    exposure_s: float
    imu: ImuStream
    truth: Truth

    def shots(self, workers: int | None = None) -> Iterator[Shot]:
        """All images of all cameras in order of time. workers: number of threads; None: one per core."""
        take = self._taker()
        workers = workers or _cores()
        waiting: deque[Future[Shot]] = deque()
        with ThreadPoolExecutor(workers, thread_name_prefix="icalib-render") as pool:
            for frame in self._schedule():
                waiting.append(pool.submit(self._shot, take, frame))
                if len(waiting) > _AHEAD * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()

    def count(self) -> int:
        """Number of images of all cameras."""
        return len(self._schedule())

    def _schedule(self) -> list[_Frame]:
        """All images in order of time; stamps are those of `simulate`."""
        due: list[_Frame] = []
        for i, camera in enumerate(self.scenario.cameras):
            stamps, seconds = image_stamps(self.scenario, camera, np.random.default_rng([self.seed, 2 + i]))
            image = _image_numbers(seconds, self.scenario.image_faults.frozen)
            times = zip(seconds.tolist(), stamps.tolist(), image.tolist(), strict=True)
            due += [_Frame(s, i, stamp, int(k), float(seconds[k])) for s, stamp, k in times]
        return sorted(due)

    def _taker(self) -> _Taker:
        return _Sheets(self) if self.scenario.board else _Room(self)

    def _shot(self, take: _Taker, frame: _Frame) -> Shot:
        camera = self.scenario.cameras[frame.camera]
        count = take.instants if self.exposure_s > 0.0 else 1
        poses = exposure_poses(camera, self.truth.trajectory, frame.image_s, self.exposure_s, count)
        picture = take.picture(frame, poses, np.random.default_rng([self.seed, 2 + frame.camera, 1 + frame.image]))
        uv = np.concatenate([np.empty((0, 2)), *(sheet.uv for sheet in picture.sheets)])
        in_view = np.concatenate([np.empty(0, dtype=bool), *(sheet.seen for sheet in picture.sheets)])
        return Shot(camera.name, frame.stamp_ns, frame.seconds, picture.pixels, SheetTruth(uv, in_view))


class _Frame(NamedTuple):
    """One image. seconds: instant on the IMU's clock; camera: its number; stamp_ns: on its clock; image, image_s:
    number and instant of the image that is rendered, an earlier one while the camera is frozen."""

    seconds: float
    camera: int
    stamp_ns: int
    image: int
    image_s: float


class _Taker(Protocol):
    """Renders the images of a film."""

    @property
    def instants(self) -> int:
        """Number of poses over an exposure."""
        ...

    def picture(self, frame: _Frame, poses: np.ndarray, rng: np.random.Generator) -> Picture: ...


class _Sheets:
    """Renders images of printed targets."""

    instants = 5

    def __init__(self, film: Film) -> None:
        self._renderers = [Renderer(camera, film.imaging) for camera in film.scenario.cameras]
        if film.scenario.target_size != 1.0:
            raise RigError("images show targets of the stated size only; leave target_size out, or simulate tables.")
        self._sheets = sheets_of(film.scenario.target, film.scenario.body_poses)

    def picture(self, frame: _Frame, poses: np.ndarray, rng: np.random.Generator) -> Picture:
        return self._renderers[frame.camera].picture(self._sheets, poses, rng)


class _Room:
    """Renders images of a room without targets."""

    instants = INSTANTS

    def __init__(self, film: Film) -> None:
        scenario = film.scenario
        assert scenario.room is not None
        self._film, self._people = film, scenario.image_faults.people
        self._interior = Interior(scenario.room, standing(self._people))
        self._renderers = [
            RoomRenderer(camera, film.imaging, faults_of(scenario.image_faults, camera.resolution, i))
            for i, camera in enumerate(scenario.cameras)
        ]

    def picture(self, frame: _Frame, poses: np.ndarray, rng: np.random.Generator) -> Picture:
        scenario, trajectory = self._film.scenario, self._film.truth.trajectory
        people = walking(self._people, scenario.cameras[0], trajectory, frame.image_s)
        gain = scenario.image_faults.gain_at(frame.image_s)
        return Picture(self._renderers[frame.camera].grey(self._interior.view(people), poses, gain, rng), ())


def _image_numbers(seconds: np.ndarray, frozen: tuple[tuple[float, float], ...]) -> np.ndarray:
    """(M,) number of the image that each image shows: its own, or the last one before an interval in which the camera
    is frozen. seconds (M,): instants of the images."""
    fresh = ~inside(frozen, seconds)
    return np.maximum(np.maximum.accumulate(np.where(fresh, np.arange(len(seconds)), -1)), 0)


def sheets_of(target: Target, T_world_bodies: np.ndarray) -> list[Sheet]:
    """A sheet for each body of `target`, at the poses T_world_bodies (bodies, 4, 4). The points of all sheets, in
    order, are those of the target."""
    if isinstance(target, Scene):
        first = np.cumsum([0] + [len(t.bodies) for t in target.targets])
        groups = zip(target.targets, first[:-1], first[1:], strict=True)
        return [sheet for t, a, b in groups for sheet in sheets_of(t, T_world_bodies[a:b])]
    if isinstance(target, Markers):
        tags = [Tag(target.family, int(i), target.size) for i in target.known]
        pairs = zip(tags, T_world_bodies, strict=True)
        return [Sheet(tag, T, border_bits=target.border_bits) for tag, T in pairs]
    return [Sheet(target, T_world_bodies[0])]


def film(scenario: Scenario, seed: int, imaging: Imaging | None = None, exposure_s: float = 0.0) -> Film:
    """The scenario as a recording with images; motion, IMU readings and stamps are those of `simulate`.

    Images show the target, or without one the textured room from the inside. imaging: by default a lens blur of 0.8 px
    and a noise of 2 grey levels. exposure_s: exposure time, centred on the stamp and averaged over 5 poses, or 4 in a
    room; 0: an instant. The scenario's corner noise, bloom and outliers do not affect images. Raises RigError for a
    board that is not flat, and if there is neither target nor room.
    """
    if not scenario.board and scenario.room is None:
        raise RigError("there is nothing to film; give the scenario a target or a room.")
    if any(scenario.bow):
        raise RigError("boards are rendered flat; set the scenario's bow to zero.")
    simulation = simulate(scenario, seed)
    imu = simulation.measurements.imu
    assert imu is not None  # of every scenario
    imaging = Imaging(blur_px=0.8, noise=2.0) if imaging is None else imaging
    return Film(scenario, seed, imaging, exposure_s, imu, simulation.truth)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_SIZE_M = (0.5, 0.3, 1.75)
_AWAY_M, _NEARER_M = 1.8, 0.4  # mean distance from the camera, and amplitude of its change
_APART_RAD, _SWAY_RAD = 0.5, 0.35  # angle between neighbours, and amplitude of the sway
_LATE_S = 0.5  # delay with which people follow the camera
_HZ = 0.13  # frequency of the first person's sway; that of each further person is a tenth higher


def standing(count: int) -> tuple[Obstacle, ...]:
    """`count` people at the origin; `walking` gives their places."""
    return tuple(Obstacle((0.0, 0.0), _SIZE_M) for _ in range(count))


def walking(count: int, camera: SimCamera, trajectory: TrueTrajectory, seconds: float) -> tuple[Obstacle, ...]:
    """`count` people at an instant [s] on the IMU's clock, in front of `camera`."""
    if not count:
        return ()
    rotation, position, _ = trajectory.pose_at(np.array([seconds - _LATE_S]))
    eye = position[0] + rotation[0] @ camera.T_imu_sensor[:3, 3]
    ahead = rotation[0] @ camera.T_imu_sensor[:3, 2]
    people = []
    for i in range(count):
        phase = 2.0 * np.pi * _HZ * 1.1**i * seconds + 2.0 * i
        angle = np.arctan2(ahead[1], ahead[0]) + _APART_RAD * (i - 0.5 * (count - 1)) + _SWAY_RAD * np.sin(phase)
        away = _AWAY_M + _NEARER_M * np.sin(1.7 * phase)
        place = (float(eye[0] + away * np.cos(angle)), float(eye[1] + away * np.sin(angle)))
        people.append(Obstacle(place, _SIZE_M, float(angle + 0.5 * np.pi + 0.3 * np.sin(2.0 * phase))))
    return tuple(people)
