"""What the sensors themselves deliver: rendered images instead of corners, on the clocks of the data-level simulation.

Images are rendered on threads when they are asked for, a few ahead: a recording never lies in memory as a whole.
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
from icalib.tools.simulation.images.people import standing, walking
from icalib.tools.simulation.images.rendering import Imaging, Picture, Renderer, Sheet, SheetTruth, exposure_poses
from icalib.tools.simulation.scenario.image_faults import faults_of
from icalib.tools.simulation.scenario.scenario import Scenario
from icalib.tools.simulation.sensors.corners import image_stamps
from icalib.tools.simulation.sensors.imu import inside
from icalib.tools.simulation.sensors.simulate import Truth, simulate

_AHEAD = 2  # images being rendered or waiting, for each thread


@dataclass(frozen=True, eq=False)
class Shot:
    """One image: the camera's name, its stamp on the camera's clock, the instant [s] on the IMU's since its origin,
    pixels (H, W) uint8, and where the target's points truly are."""

    camera: str
    stamp_ns: int
    seconds: float
    pixels: np.ndarray
    target: SheetTruth


@dataclass(frozen=True, eq=False)
class Film:
    """One recording of IMU readings and images. `truth.corners` is that of the data-level simulation, not of these
    images."""

    scenario: Scenario
    seed: int
    imaging: Imaging
    exposure_s: float
    imu: ImuStream
    truth: Truth

    def shots(self, workers: int | None = None) -> Iterator[Shot]:
        """All images of all cameras in the order in which they are taken. workers: threads; None: all cores."""
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
        """How many images there are."""
        return len(self._schedule())

    def _schedule(self) -> list[_Frame]:
        """All images in time; stamps are those of `simulate`."""
        due: list[_Frame] = []
        for i, camera in enumerate(self.scenario.cameras):
            stamps, seconds = image_stamps(self.scenario, camera, np.random.default_rng([self.seed, 2 + i]))
            shown = _shown(seconds, self.scenario.image_faults.frozen)
            times = zip(seconds.tolist(), stamps.tolist(), shown.tolist(), strict=True)
            due += [_Frame(s, i, stamp, int(k), float(seconds[k])) for s, stamp, k in times]
        return sorted(due)

    def _taker(self) -> _Taker:
        return _Sheets(self) if self.scenario.board else _Room(self)

    def _shot(self, take: _Taker, frame: _Frame) -> Shot:
        camera = self.scenario.cameras[frame.camera]
        count = take.instants if self.exposure_s > 0.0 else 1
        poses = exposure_poses(camera, self.truth.trajectory, frame.taken_s, self.exposure_s, count)
        picture = take.picture(frame, poses, np.random.default_rng([self.seed, 2 + frame.camera, 1 + frame.shown]))
        uv = np.concatenate([np.empty((0, 2)), *(sheet.uv for sheet in picture.sheets)])
        seen = np.concatenate([np.empty(0, dtype=bool), *(sheet.seen for sheet in picture.sheets)])
        return Shot(camera.name, frame.stamp_ns, frame.seconds, picture.pixels, SheetTruth(uv, seen))


class _Frame(NamedTuple):
    """One image: its instant, number of the camera and stamp; number and instant of the image that it shows, which is
    an earlier one where the camera is frozen."""

    seconds: float
    camera: int
    stamp_ns: int
    shown: int
    taken_s: float


class _Taker(Protocol):
    """Takes the pictures of a film."""

    @property
    def instants(self) -> int:
        """Poses of an exposure."""
        ...

    def picture(self, frame: _Frame, poses: np.ndarray, rng: np.random.Generator) -> Picture: ...


class _Sheets:
    """Of printed targets."""

    instants = 5

    def __init__(self, film: Film) -> None:
        self._renderers = [Renderer(camera, film.imaging) for camera in film.scenario.cameras]
        if film.scenario.target_size != 1.0:
            raise RigError("images show targets of the stated size only; leave target_size out, or simulate tables.")
        self._sheets = sheets_of(film.scenario.target, film.scenario.body_poses)

    def picture(self, frame: _Frame, poses: np.ndarray, rng: np.random.Generator) -> Picture:
        return self._renderers[frame.camera].picture(self._sheets, poses, rng)


class _Room:
    """Of a room without targets."""

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
        people = walking(self._people, scenario.cameras[0], trajectory, frame.taken_s)
        gain = scenario.image_faults.gain_at(frame.taken_s)
        return Picture(self._renderers[frame.camera].grey(self._interior.view(people), poses, gain, rng), ())


def _shown(seconds: np.ndarray, frozen: tuple[tuple[float, float], ...]) -> np.ndarray:
    """(M,) number of the image that each image (M,) shows: itself, or the last before a time in which it is frozen."""
    fresh = ~inside(frozen, seconds)
    return np.maximum(np.maximum.accumulate(np.where(fresh, np.arange(len(seconds)), -1)), 0)


def sheets_of(target: Target, T_world_bodies: np.ndarray) -> list[Sheet]:
    """Every body of `target` on paper of its own, at its pose (bodies, 4, 4); their points in turn are the target's."""
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
    """The scenario as its sensors record it: motion, IMU readings and stamps are those of `simulate`.

    A scenario with a room and no target is filmed as the room from the inside, its surfaces textured. imaging: by
    default a lens blur of 0.8 px and a noise of 2 grey levels. exposure_s: about the stamp, 5 poses, or 4 in a room; 0:
    an instant. What the scenario says of corners (noise, bloom, outliers) has no part in images. Raises RigError for a
    board that is not flat, and where there is neither target nor room.
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
