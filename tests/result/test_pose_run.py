"""From the command line: an IMU and motion capture, simulated, calibrated, and what the folder holds afterwards."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from icalib.cli import main
from icalib.export.formats import export
from icalib.result import Calibration, load_calibration
from icalib.rig.file import rig_to_dict
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.comparison.reading import compare_files
from icalib.tools.simulation import Scenario, load_scenario, rig_for

SCENARIO = """\
duration: 10
seed: 3
motion: {kind: free}
room: {size: [8, 7, 3]}
sensors:
  imu0: {type: imu, rate: 200, noise: {gyro: 1.7e-4, gyro_walk: 2e-5, accel: 2e-3, accel_walk: 3e-3}}
  mocap0:
    type: pose
    rate: 50
    time_offset: 0.02
    rotation_noise: 0.002
    position_noise: 0.002
    T_imu_sensor: [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
"""


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scenario]:
    file = tmp_path_factory.mktemp("poses") / "scenario.yaml"
    file.write_text(SCENARIO)
    return file, load_scenario(file)


@pytest.fixture(scope="module")
def out(scenario: tuple[Path, Scenario]) -> Path:
    file, described = scenario
    folder = file.parent
    assert main(["simulate", str(file), "--output", str(folder / "recording"), "--quiet"]) == 0
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig_to_dict(rig_for(described))))
    rig, recording = str(folder / "rig.yaml"), str(folder / "recording")
    assert main(["calibrate", rig, recording, "-o", str(folder / "out"), "--quiet"]) == 0
    return folder / "out"


@pytest.fixture(scope="module")
def found(out: Path) -> Calibration:
    return load_calibration(out)


def test_it_is_what_was_simulated(found: Calibration, scenario: tuple[Path, Scenario]):
    (mocap,) = scenario[1].of(SimPoses)
    translation, offset = found.group("mocap0", "translation"), found.group("mocap0", "time_offset")
    assert (np.abs(translation.value - mocap.T_imu_sensor[:3, 3]) < 4.0 * translation.std).all()
    assert abs(offset.value[0] - 0.02) < 4.0 * offset.std[0]
    assert found.pose_sensors == ("mocap0",) and found.bodies == ()
    assert found.rates["mocap0"] == pytest.approx(50.0)


def test_residuals_are_kept(found: Calibration):
    (r,) = found.pose_residuals
    assert r.labels[0] == "rotation x" and r.units == ("rad",) * 3 + ("m",) * 3
    assert r.residual.shape == (len(r.seconds), 6) and len(r.seconds) > 480
    np.testing.assert_allclose(r.whitened, r.residual / 2e-3, rtol=1e-9)
    assert (np.diff(r.seconds) > 0).all() and r.whitened.std() == pytest.approx(1.0, abs=0.06)


def test_it_is_exported(found: Calibration):
    sensor = json.loads(export(found, "json").files["calibration.json"])["sensors"]["mocap0"]
    np.testing.assert_array_equal(sensor["T_imu_sensor"], found.T_imu_sensor("mocap0"))
    robot = ElementTree.fromstring(export(found, "urdf").files["sensors.urdf"])
    (origin,) = robot.findall("joint[@name='mocap0_joint']/origin")
    position = np.array(origin.attrib["xyz"].split(), dtype=np.float64)
    np.testing.assert_allclose(position, found.group("mocap0", "translation").value)
    (text,) = export(found, "ros2-static").files.values()
    assert "'mocap0': ('imu0', " in text


def test_it_is_compared_with_what_is_typed_into_a_rig_file(out: Path, found: Calibration, tmp_path: Path):
    rig = yaml.safe_load((out.parent / "rig.yaml").read_text())
    typed = {name: found.group("mocap0", name).value for name in ("rotation", "translation", "time_offset")}
    typed["translation"] = typed["translation"] + [0.0, 0.0, 0.05]
    rig["sensors"]["mocap0"] |= {name: {"guess": value.tolist()} for name, value in typed.items()}
    (tmp_path / "cad.yaml").write_text(yaml.safe_dump(rig))
    differences = compare_files(out, tmp_path / "cad.yaml").differences
    (moved,) = [d for d in differences if d.differs]
    assert (moved.sensor, moved.what) == ("mocap0", "translation")
    np.testing.assert_allclose(moved.vector, [0.0, 0.0, 50.0], atol=1e-6)
    same = {d.what for d in differences if d.sensor == "mocap0"} - {"translation"}
    assert same == {"rotation", "time offset"}
    assert not any(d.differs for d in compare_files(out, out).differences)


def test_the_files_speak_of_it_and_not_of_its_frame(found: Calibration, out: Path):
    plain = yaml.safe_load((out / "calibration.yaml").read_text())
    assert plain["sensors"]["mocap0"]["type"] == "pose" and plain["targets"] == {}
    assert {f["kind"] for f in plain["fits"] if f["sensor"] == "mocap0"} == {"rotation", "position"}
    assert not any("frame" in g.sensor for g in found.groups)
    page = (out / "report.html").read_text()
    assert 'id="poses-0"' in page and "Residuals of pose sensors" in page
