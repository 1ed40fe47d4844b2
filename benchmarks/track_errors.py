"""How far tracks are from where the points of the surfaces that they began on truly are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.data.recordings import open_recording
from icalib.rig import Rig
from icalib.sensors.camera.read.image_tracks import find_tracks
from icalib.tools.simulation import SimCamera, Simulation
from icalib.tools.simulation.projection import image_velocity, project, visible
from icalib.tools.simulation.rendering import unproject
from icalib.tools.simulation.room import Room, distances

OUTLIER_PX = 1.0
_FITS = 5
AGES = (0, 1, 2, 3, 5, 8, 12, 18, 30)


@dataclass(frozen=True, eq=False)
class Views:
    """Observations by track and time. track (N,): from 0 on; age (N,): views before; uv (N, 2) px; R (N, 3, 3) and C
    (N, 3): where the camera truly was."""

    camera: SimCamera
    track: np.ndarray
    age: np.ndarray
    uv: np.ndarray
    R: np.ndarray
    C: np.ndarray

    def projected(self, points: np.ndarray) -> np.ndarray:
        """(N, 2) px of points (N, 3) in world, NaN out of the image."""
        local = self._local(points)
        uv = project(self.camera, local)
        return np.where(visible(self.camera, local, uv)[:, None], uv, np.nan)

    def slopes(self, points: np.ndarray) -> np.ndarray:
        """(N, 2, 3) px/m: derivatives of `projected` by the points."""
        local = self._local(points)
        return np.stack([image_velocity(self.camera, local, self.R[:, i]) for i in range(3)], axis=2)

    def _local(self, points: np.ndarray) -> np.ndarray:
        return np.einsum("nji,nj->ni", self.R, points - self.C)

    def some(self, kept: np.ndarray) -> Views:
        track = np.unique(self.track[kept], return_inverse=True)[1]
        return Views(self.camera, track, self.age[kept], self.uv[kept], self.R[kept], self.C[kept])


def views_of(simulation: Simulation, stream: TrackStream) -> Views:
    camera = next(c for c in simulation.scenario.cameras if c.name == stream.name)
    seconds = (stream.stamps_ns - camera.clock_origin_ns) * 1e-9 + camera.time_offset_s
    rotation, position, _ = simulation.truth.pose_at(seconds)
    R, C = rotation @ camera.T_imu_sensor[:3, :3], position + rotation @ camera.T_imu_sensor[:3, 3]
    image = np.repeat(np.arange(len(stream.stamps_ns)), np.diff(stream.start))
    order = np.lexsort((image, stream.feature))
    track, image = np.unique(stream.feature[order], return_inverse=True)[1], image[order]
    age = np.arange(len(track)) - np.searchsorted(track, track)
    return Views(camera, track, age, stream.uv[order], R[image], C[image])


def begun_on(room: Room, views: Views) -> np.ndarray:
    """(F, 3) points of the surfaces that the first view of each track shows, by the simulator's own rays and room."""
    first = views.age == 0
    rays = np.einsum("nij,nj->ni", views.R[first], unproject(views.camera, views.uv[first]))
    far = np.empty(len(rays))
    distances(room.surfaces, views.C[first], rays, far)
    return views.C[first] + far[:, None] * rays


def fitted(views: Views, points: np.ndarray) -> np.ndarray:
    """(F, 3) points that fit all views of each track in least squares, by Gauss and Newton from `points` on."""
    for _ in range(_FITS):
        J = views.slopes(points[views.track])
        error = views.uv - views.projected(points[views.track])
        known = np.isfinite(error[:, 0])
        normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        np.add.at(normal, views.track[known], np.einsum("nki,nkj->nij", J[known], J[known]))
        np.add.at(right, views.track[known], np.einsum("nki,nk->ni", J[known], error[known]))
        points = points + np.linalg.solve(normal + 1e-3 * np.eye(3), right[..., None])[..., 0]
    return points


def print_track_errors(simulation: Simulation, rig: Rig, path: Path) -> None:
    """Of every camera of a recording: how many tracks, and the figures of `_figures`."""
    recording = open_recording(path)
    for camera in rig.cameras:
        stream, notes = find_tracks(recording, camera, keep=False)
        print(f"{path.name} {camera.name}:", *notes)
        views = views_of(simulation, stream)
        length = np.bincount(views.track)
        print(
            f"  {len(stream.stamps_ns)} images, {len(length)} tracks of {length.mean():.1f} views in the mean, "
            f"{len(stream.uv) / len(stream.stamps_ns):.0f} points an image"
        )
        _figures(simulation, views)


def _figures(simulation: Simulation, views: Views) -> None:
    assert simulation.scenario.room is not None
    points = begun_on(simulation.scenario.room, views)
    error = views.uv - views.projected(points[views.track])
    wrong = ~(np.linalg.norm(error, axis=1) < OUTLIER_PX)
    bad = np.unique(views.track[wrong])
    print(f"  beyond {OUTLIER_PX:g} px: {wrong.mean():.2%} of observations, in {len(bad) / len(points):.2%} of tracks")
    good = ~np.isin(views.track, bad)
    points, kept, error = np.delete(points, bad, axis=0), views.some(good), error[good]
    later = kept.age > 0
    print("  other tracks, from the point of the surface that the first view shows:")
    _describe(error[later], kept.track[later], kept.age[later])
    print("  from the point that fits all views best, with the true lens and motion:")
    _describe(kept.uv - kept.projected(fitted(kept, points)[kept.track]), kept.track, kept.age)


def _describe(error: np.ndarray, track: np.ndarray, age: np.ndarray) -> None:
    print(f"    mean {error[:, 0].mean():+.4f} {error[:, 1].mean():+.4f} px, RMS of a coordinate {_rms(error):.4f} px")
    print("    by views before: " + ", ".join(_by_age(error, age)))
    apart = [(np.flatnonzero((np.diff(track) == 0) & (np.diff(age) == 1)), 1)]
    apart.append((np.flatnonzero(track[4:] == track[:-4]), 4))
    mean_square = np.mean(error**2)
    shares = [f"{np.mean(error[k] * error[k + n]) / mean_square:.2f} {n} views later" for k, n in apart]
    print("    correlation along tracks: " + ", ".join(shares))


def _by_age(error: np.ndarray, age: np.ndarray) -> list[str]:
    """RMS of a coordinate, by intervals of the age."""
    bounds = (*AGES, age.max() + 1)
    parts = [(a, error[(age >= a) & (age < b)]) for a, b in zip(bounds[:-1], bounds[1:], strict=True) if b > a]
    return [f"{a}: {_rms(part):.3f}" for a, part in parts if len(part)]


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(error))))
