"""How far tracks are from where the points of the surfaces that they began on truly are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from icalib.detection.tracking.streams import find_tracks
from icalib.measurements import TrackStream
from icalib.recordings import open_recording
from icalib.rig import Rig
from icalib.simulation import SimCamera, Simulation
from icalib.simulation.lenses import unproject
from icalib.simulation.projection import project, visible
from icalib.simulation.room import distances

OUTLIER_PX = 1.0
AGES = (1, 2, 3, 5, 8, 12, 18, 30)


@dataclass(frozen=True, eq=False)
class TrackErrors:
    """Rows by track and time, those of first views left out. track, age (N,): views before; error (N, 2) px: what was
    observed, less where the point of the surface is that the first view shows; uv (N, 2) px; rays (N, 3)."""

    track: np.ndarray
    age: np.ndarray
    error: np.ndarray
    uv: np.ndarray


def track_errors(simulation: Simulation, stream: TrackStream) -> TrackErrors:
    """By the simulator's own rays, room and projection. The place in the first view is exact by definition: it says
    which point is tracked."""
    scenario = simulation.scenario
    camera = next(c for c in scenario.cameras if c.name == stream.name)
    assert scenario.room is not None
    seconds = (stream.stamps_ns - camera.clock_origin_ns) * 1e-9 + camera.time_offset_s
    rotation, position, _ = simulation.truth.pose_at(seconds)
    R, C = rotation @ camera.T_imu_cam[:3, :3], position + rotation @ camera.T_imu_cam[:3, 3]
    image = np.repeat(np.arange(len(stream.stamps_ns)), np.diff(stream.start))
    order = np.lexsort((image, stream.feature))
    track, image, uv = stream.feature[order], image[order], stream.uv[order]
    begins = np.flatnonzero(np.diff(track, prepend=-1))
    length = np.diff(np.append(begins, len(track)))
    first = np.repeat(begins, length)
    rays = np.einsum("nij,nj->ni", R[image[begins]], unproject(camera, uv[begins]))
    far = np.empty(len(begins))
    distances(scenario.room.surfaces, np.ascontiguousarray(C[image[begins]]), rays, far)
    points = np.repeat(C[image[begins]] + far[:, None] * rays, length, axis=0)
    error = uv - _projected(camera, R[image], C[image], points)
    age = np.arange(len(track)) - first
    later = age > 0
    return TrackErrors(track[later], age[later], error[later], uv[later])


def _projected(camera: SimCamera, R: np.ndarray, C: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) px, NaN out of the image."""
    local = np.einsum("nji,nj->ni", R, points - C)
    uv = project(camera, local)
    return np.where(visible(camera, local, uv)[:, None], uv, np.nan)


def print_track_errors(simulation: Simulation, rig: Rig, path: Path) -> None:
    """Of every camera of a recording: how many tracks, and the figures of `_figures`."""
    recording = open_recording(path)
    for camera in rig.cameras:
        stream, notes = find_tracks(recording, camera, keep=False)
        print(f"{path.name} {camera.name}:", *notes)
        found = track_errors(simulation, stream)
        views = np.unique(stream.feature, return_counts=True)[1]
        print(
            f"  {len(stream.stamps_ns)} images, {len(views)} tracks of {np.mean(views):.1f} views in the mean, "
            f"{len(stream.uv) / len(stream.stamps_ns):.0f} points an image"
        )
        _figures(found)


def _figures(e: TrackErrors) -> None:
    wrong = ~(np.linalg.norm(e.error, axis=1) < OUTLIER_PX)
    bad = len(np.unique(e.track[wrong])) / len(np.unique(e.track))
    print(f"  beyond {OUTLIER_PX:g} px: {wrong.mean():.2%} of observations, in {bad:.2%} of tracks; of the others:")
    error, age, track = e.error[~wrong], e.age[~wrong], e.track[~wrong]
    print(f"  mean {error[:, 0].mean():+.4f} {error[:, 1].mean():+.4f} px, RMS of a coordinate {_rms(error):.4f} px")
    print("  views before, RMS [px]: " + ", ".join(_by_age(error, age)))
    follows = (np.diff(track) == 0) & (np.diff(age) == 1)
    before, after = error[:-1][follows], error[1:][follows]
    correlation = (before * after).mean() / np.sqrt((before**2).mean() * (after**2).mean())
    inner = _rms(after - before) / np.sqrt(2.0)
    print(f"  correlation with the view before {correlation:.2f}; RMS of differences / sqrt 2 {inner:.4f} px")
    number = np.unique(track, return_inverse=True)[1]
    count = np.bincount(number)
    mean = np.stack([np.bincount(number, error[:, i]) for i in range(2)], axis=1) / count[:, None]
    within = _rms((error - mean[number])[count[number] > 2])
    print(f"  RMS of the means of tracks {_rms(mean[count > 2]):.4f} px, within tracks {within:.4f} px")


def _by_age(error: np.ndarray, age: np.ndarray) -> list[str]:
    """RMS of a coordinate, by intervals of the age."""
    bounds = (*AGES, age.max() + 1)
    parts = [(a, error[(age >= a) & (age < b)]) for a, b in zip(bounds[:-1], bounds[1:], strict=True) if b > a]
    return [f"{a}: {_rms(part):.3f}" for a, part in parts if len(part)]


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(error))))
