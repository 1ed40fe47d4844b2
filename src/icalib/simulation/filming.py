"""What the sensors themselves deliver: rendered images instead of corners, on the clocks of the data-level simulation.

Images are rendered on threads when they are asked for, a few ahead: a recording never lies in memory as a whole.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from icalib.errors import RigError
from icalib.geometry.targets import Markers, Scene, Tag, Target
from icalib.measurements import ImuStream
from icalib.simulation.corners import image_stamps
from icalib.simulation.rendering import Imaging, Renderer, Sheet, SheetTruth, exposure_poses
from icalib.simulation.scenario import Scenario
from icalib.simulation.simulate import Truth, simulate

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
        renderers = [Renderer(camera, self.imaging) for camera in self.scenario.cameras]
        sheets = sheets_of(self.scenario.target, self.scenario.body_poses)
        workers = workers or _cores()
        waiting: deque[Future[Shot]] = deque()
        with ThreadPoolExecutor(workers, thread_name_prefix="icalib-render") as pool:
            for seconds, camera, image, stamp_ns in self._schedule():
                waiting.append(pool.submit(self._shot, renderers[camera], sheets, (camera, image), stamp_ns, seconds))
                if len(waiting) > _AHEAD * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()

    def count(self) -> int:
        """How many images there are."""
        return len(self._schedule())

    def _schedule(self) -> list[tuple[float, int, int, int]]:
        """Instant, camera, number of the image and stamp of each image, in time; stamps are those of `simulate`."""
        due: list[tuple[float, int, int, int]] = []
        for i, camera in enumerate(self.scenario.cameras):
            stamps, seconds = image_stamps(self.scenario, camera, np.random.default_rng([self.seed, 2 + i]))
            due += [(s, i, k, t) for k, (s, t) in enumerate(zip(seconds.tolist(), stamps.tolist(), strict=True))]
        return sorted(due)

    def _shot(
        self, renderer: Renderer, sheets: list[Sheet], number: tuple[int, int], stamp_ns: int, seconds: float
    ) -> Shot:
        camera, image = number
        count = 5 if self.exposure_s > 0.0 else 1
        poses = exposure_poses(renderer.camera, self.truth.trajectory, seconds, self.exposure_s, count)
        rng = np.random.default_rng([self.seed, 2 + camera, 1 + image])
        picture = renderer.picture(sheets, poses, rng)
        uv, seen = (np.concatenate([getattr(sheet, name) for sheet in picture.sheets]) for name in ("uv", "seen"))
        return Shot(renderer.camera.name, stamp_ns, seconds, picture.pixels, SheetTruth(uv, seen))


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

    imaging: by default a lens blur of 0.8 px and a noise of 2 grey levels. exposure_s: about the stamp, 5 poses; 0: an
    instant. What the scenario says of corners (noise, bloom, outliers) has no part in images. Raises RigError for a
    board that is not flat.
    """
    if any(scenario.bow):
        raise RigError("boards are rendered flat; set the scenario's bow to zero.")
    simulation = simulate(scenario, seed)
    imu = simulation.measurements.imu
    assert imu is not None  # of every scenario
    imaging = Imaging(blur_px=0.8, noise=2.0) if imaging is None else imaging
    return Film(scenario, seed, imaging, exposure_s, imu, simulation.truth)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
