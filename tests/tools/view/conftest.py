"""A robot with a camera, a wall of tags and a LiDAR: simulated, calibrated, and with images beside its tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from icalib.base.extras import load_rerun
from icalib.cli import main
from icalib.geometry.targets import AprilGrid
from icalib.result import Calibration, load_calibration
from icalib.rig.file import rig_to_dict
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.simulation import Simulation, load_scenario, rig_for, simulate, write_tables

THREE_D = Path(__file__).parents[3] / "examples" / "paper" / "table2-3d.yaml"
ON_WALL = np.array([[0.0, 0.0, -1.0, 5.9], [-1.0, 0.0, 0.0, 3.9], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
SHAPE, EVERY = (480, 752), 4


@dataclass(frozen=True)
class Shown:
    """A result on disk, the recording that it is of, and what was simulated."""

    result: Path
    recording: Path
    simulation: Simulation

    @property
    def calibration(self) -> Calibration:
        return load_calibration(self.result)


@pytest.fixture(scope="session")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    folder, scenario = tmp_path_factory.mktemp("shown"), load_scenario(THREE_D)
    scenario = replace(
        scenario,
        duration_s=12.0,
        features=None,
        cameras=(replace(scenario.cameras[0], corner_noise_px=0.15),),
        sensors=tuple(replace(x, azimuth_steps=300) for x in scenario.of(SimLidar)),
        board=True,
        T_world_board=ON_WALL,
        target=AprilGrid(4, 10, 0.6, 0.3),
    )
    simulation = simulate(scenario, 3)
    write_tables(simulation, 3, folder / "drive")
    rig = folder / "rig.yaml"
    rig.write_text(yaml.safe_dump(rig_to_dict(rig_for(scenario))))
    assert main(["calibrate", str(rig), str(folder / "drive"), "-o", str(folder / "out"), "--quiet"]) == 0
    _add_images(folder / "drive" / "cam0", simulation.measurements.cameras[0].stamps_ns[::EVERY])
    return Shown(folder / "out", folder / "drive", simulation)


def _add_images(folder: Path, stamps_ns: np.ndarray) -> None:
    """As EuRoC has them; each of one grey, which is its number."""
    (folder / "data").mkdir()
    rows = ["#timestamp [ns],filename"]
    for k, stamp in enumerate(stamps_ns.tolist()):
        image = np.full(SHAPE, 20 + k, np.uint8)
        image[0, 0] = 255
        assert cv2.imwrite(str(folder / "data" / f"{stamp}.png"), image)
        rows.append(f"{stamp},{stamp}.png")
    (folder / "data.csv").write_text("\n".join(rows) + "\n")


@dataclass(frozen=True)
class Rows:
    """Of one entity: seconds (n,), NaN where they are still, and the values of each component, row by row."""

    seconds: np.ndarray
    values: dict[str, list[Any]]


Reader = Callable[[Path], dict[str, Rows]]


@pytest.fixture(scope="session")
def read() -> Reader:
    """A file as Rerun's own reader gives it, by entity. Fails where anything stands on another timeline."""
    return _read


def _read(path: Path) -> dict[str, Rows]:
    found: dict[str, Rows] = {}
    for chunk in load_rerun().chunk.RrdReader(path).stream().to_chunks():
        assert chunk.timeline_names == ([] if chunk.is_static else ["imu clock"]), chunk.entity_path
        batch = chunk.to_record_batch()
        columns = {name: batch.column(name) for name in batch.schema.names}
        del columns["rerun.controls.RowId"]
        times = columns.pop("imu clock", None)
        n = batch.num_rows
        seconds = np.full(n, np.nan) if times is None else 1e-9 * np.asarray(times.cast("int64"), np.float64)
        entity = found.setdefault(chunk.entity_path.lstrip("/"), Rows(np.empty(0), {}))
        values = {name: entity.values.get(name, []) + column.to_pylist() for name, column in columns.items()}
        found[chunk.entity_path.lstrip("/")] = Rows(np.concatenate([entity.seconds, seconds]), entity.values | values)
    return found
