"""Writes a simulated recording as a folder of tables with its truth; the format is described in docs/simulation.md."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from icalib.base.files import below, staged, write_text
from icalib.data.measurements import CornerStream, ImuStream, TrackStream
from icalib.errors import RecordingError
from icalib.tools.simulation.output import write_table
from icalib.tools.simulation.rigs import rig_text
from icalib.tools.simulation.scenario.scenario import Scenario
from icalib.tools.simulation.sensors.simulate import Simulation, Truth

_TRUTH_HEADER = """\
# Truth of a simulated recording, in SI units: p_imu = T_imu_sensor p_sensor, t_imu = t_sensor + time_offset.
# Planes: [nx, ny, nz, d] in the world, n . p = d. The trajectory and the points of the tracks are in truth.npz.
"""


def check_absent(path: Path) -> None:
    """Raises RecordingError if `path` exists, as recordings are never overwritten."""
    if path.exists():
        raise RecordingError(f"{path} exists already; remove it, or choose another path.")


@contextmanager
def atomic_output(path: Path) -> Iterator[Path]:
    """Context with a temporary path beside `path`. It is renamed to `path` at the end, and removed if anything fails.

    Raises RecordingError if `path` exists or cannot be written.
    """
    check_absent(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with staged(path.parent) as place:
            yield place / path.name
            check_absent(path)
            (place / path.name).rename(path)
    except OSError as error:
        raise RecordingError(f"{path} cannot be written ({error.strerror or error}); choose another folder.") from None


def write_tables(
    simulation: Simulation, seed: int, path: Path, progress: Callable[[float], None] = lambda done: None
) -> tuple[str, ...]:
    """Writes the measurements as tables, their truth, and their rig file, to the new folder `path`, atomically.

    Returns an empty tuple, as nothing is left out, see `write_sensors`. Raises RecordingError if `path` exists or
    cannot be written, CalibrationError if a sensor's name is no valid folder name.
    """
    measured = simulation.measurements
    assert measured.imu is not None  # of every scenario
    with atomic_output(path) as folder:
        steps: list[Callable[[], None]] = [partial(_write_imu, below(folder, measured.imu.name), measured.imu)]
        steps += [partial(_write_corners, below(folder, c.name), c, simulation.scenario) for c in measured.cameras]
        steps += [partial(_write_tracks, below(folder, t.name), t) for t in measured.tracks]
        for sensor in simulation.scenario.sensors:
            steps.append(partial(sensor.write_table, below(folder, sensor.name), measured.streams[sensor.name]))
        steps += [partial(write_truth, simulation, seed, folder)]
        for i, step in enumerate(steps):
            step()
            progress((i + 1) / len(steps))
    return ()


def write_truth(simulation: Simulation, seed: int, folder: Path, topics: Iterable[str] | None = None) -> None:
    """Writes truth.yaml, truth.npz and rig.yaml to the existing folder `folder`. topics: see `rig_text`."""
    write_text(folder / "rig.yaml", rig_text(simulation.scenario, topics))
    truth = simulation.truth
    text = yaml.safe_dump(_plain_truth(simulation.scenario, truth, seed), sort_keys=False, default_flow_style=None)
    (folder / "truth.yaml").write_text(_TRUTH_HEADER + text, encoding="utf-8")
    trajectory = {name: getattr(truth, name) for name in ("position", "velocity", "gyro_bias", "accel_bias", "points")}
    stamps_ns = truth.imu_clock_origin_ns + np.round(truth.seconds * 1e9).astype(np.int64)
    np.savez(folder / "truth.npz", stamps_ns=stamps_ns, rotation=truth.R_world_imu, **trajectory)


def _plain_truth(scenario: Scenario, truth: Truth, seed: int) -> dict[str, Any]:
    sensors: dict[str, Any] = {
        "imu0": {
            "type": "imu",
            "gyro_bias": truth.gyro_bias[0].tolist(),
            "accel_bias": truth.accel_bias[0].tolist(),
            "intrinsics": truth.imu_intrinsics.tolist(),
        }
    }
    for c in scenario.cameras:
        parameters = {"intrinsics": list(map(float, c.intrinsics)), "distortion": list(map(float, c.distortion))}
        sensors[c.name] = _mounted(truth, c.name, "camera") | {"model": c.model} | parameters
    for s in scenario.sensors:
        sensors[s.name] = _mounted(truth, s.name, s.sensor_type) | s.plain()
    plain: dict[str, Any] = {"seed": seed, "gravity": truth.gravity.tolist(), "sensors": sensors}
    if scenario.board:
        plain |= {"T_world_bodies": truth.T_world_bodies.tolist(), "target_size": truth.target_size}
    return plain | {"planes": truth.planes.tolist()}


def _mounted(truth: Truth, name: str, kind: str) -> dict[str, Any]:
    return {
        "type": kind,
        "T_imu_sensor": truth.T_imu_sensor[name].tolist(),
        "time_offset": float(truth.time_offset[name]),
    }


def _write_imu(folder: Path, imu: ImuStream) -> None:
    header = "t [ns],wx [rad/s],wy [rad/s],wz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"
    write_table(folder / "data.csv", header, imu.stamps_ns, imu.gyro, imu.accel)


def _write_corners(folder: Path, corners: CornerStream, scenario: Scenario) -> None:
    names = scenario.target.point_identity(corners.point)
    stamps = corners.stamps_ns[corners.image]
    write_table(folder / "corners.csv", "t [ns],tag id,corner,u [px],v [px]", stamps, *names, corners.uv)


def _write_tracks(folder: Path, tracks: TrackStream) -> None:
    stamps = tracks.stamps_ns[tracks.image]
    write_table(folder / "tracks.csv", "t [ns],feature,u [px],v [px]", stamps, tracks.feature, tracks.uv)
