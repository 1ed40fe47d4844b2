"""From the command line, without a camera: simulate, calibrate, and what the folder holds afterwards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.remarks import named, names

from icalib.cli import main
from icalib.result import Calibration, load_calibration
from icalib.rig.file import rig_to_dict
from icalib.sensors.lidar import assess
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import Scenario, load_scenario, rig_for

RAMP = Path(__file__).parents[2] / "examples" / "paper" / "table2-ramp.yaml"
MOST = 5000


@pytest.fixture(scope="module")
def scenario_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve seconds on hills, with a coarse LiDAR, wheels and no cameras."""
    plain = yaml.safe_load(RAMP.read_text())
    sensors = {n: s for n, s in plain["sensors"].items() if s["type"] != "camera"}
    sensors["lidar0"]["azimuth_steps"] = 200
    del plain["features"]
    file = tmp_path_factory.mktemp("robot") / "scenario.yaml"
    file.write_text(yaml.safe_dump(plain | {"duration": 12, "sensors": sensors}))
    return file


@pytest.fixture(scope="module")
def scenario(scenario_file: Path) -> Scenario:
    return load_scenario(scenario_file)


@pytest.fixture(scope="module")
def out(scenario_file: Path, scenario: Scenario) -> Path:
    folder = scenario_file.parent
    assert main(["simulate", str(scenario_file), "--output", str(folder / "recording"), "--quiet"]) == 0
    rig = folder / "rig.yaml"
    rig.write_text(yaml.safe_dump(rig_to_dict(rig_for(scenario))))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(assess, "MAX_KEPT_POINTS", MOST)
        assert main(["calibrate", str(rig), str(folder / "recording"), "-o", str(folder / "out"), "--quiet"]) == 0
    return folder / "out"


@pytest.fixture(scope="module")
def found(out: Path) -> Calibration:
    return load_calibration(out)


def test_it_is_the_robot_that_was_simulated(found: Calibration, scenario: Scenario):
    for name, T in (
        ("lidar0", scenario.of(SimLidar)[0].T_imu_sensor),
        ("wheel0", scenario.of(SimWheels)[0].T_imu_sensor),
    ):
        error = found.group(name, "translation").value - T[:3, 3]
        assert (np.abs(error) < 4.0 * found.group(name, "translation").std + 1e-9).all(), name
    radii = found.group("wheel0", "radii")
    assert (np.abs(radii.value - scenario.of(SimWheels)[0].radii) < 4.0 * radii.std).all()


def test_kept_points_are_thinned_and_redraw_their_residuals(found: Calibration):
    (r,) = found.lidar_residuals
    assert MOST / 2 < len(r.residual) <= MOST < r.points_used < r.points_read
    assert r.points_used == sum(p.count for p in found.planes)
    normal, point = (np.array([getattr(p, name) for p in found.planes])[r.plane] for name in ("normal", "point"))
    np.testing.assert_allclose(np.einsum("na,na->n", normal, r.world - point), r.residual, atol=1e-5)
    assert (r.residual / r.sigma).std() == pytest.approx(1.0, abs=0.08)
    assert r.seconds.min() > -0.1 and r.seconds.max() < 12.1 and (np.diff(r.seconds) > -0.2).all()
    assert 0.5 < r.distance.min() < r.distance.max() < 20.0


def test_points_of_the_first_guess_lie_near_planes_of_their_own(found: Calibration):
    (r,) = found.lidar_residuals
    assert 0.0 < np.linalg.norm(r.first_world - r.world, axis=1).mean() < 2.0
    own = r.plane == np.bincount(r.plane).argmax()
    points = r.first_world[own].astype(float)
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    expected = np.abs((points - points.mean(axis=0)) @ normal)
    np.testing.assert_allclose(np.abs(r.first_residual[own]), expected, atol=1e-4)


def test_planes_are_where_the_room_has_them(found: Calibration):
    """Walls: opposite ones are as far apart as the room is long and wide."""
    upright = [p for p in found.planes if abs(p.normal[2]) < 0.02 and p.count > 3000]
    gaps = [abs((p.point - q.point) @ p.normal) for p in upright for q in upright if abs(p.normal @ q.normal) > 0.9999]
    for size in (12.0, 10.0):
        assert np.abs(np.array(gaps) - size).min() < 0.02


def test_wheels_are_whitened_by_their_densities(found: Calibration):
    (r,) = found.wheel_residuals
    assert r.labels == ("left", "right", "lateral", "vertical") and r.units == ("rad", "rad", "m", "m")
    root_dt = np.sqrt(np.append(np.diff(r.seconds), np.nan))
    density = r.residual / r.whitened / root_dt[:, None]
    np.testing.assert_allclose(np.nanmedian(density, axis=0), [0.03, 0.03, 5e-3, 5e-3], rtol=1e-6)
    assert r.whitened[:, :2].std() == pytest.approx(1.0, abs=0.15)


def test_sentences_make_sense_of_a_lidar_alone(found: Calibration):
    assert "30.0 mm along the beam" in named("lidar_points_used", found.notes)
    assert "recording_too_short" in names(found.warnings)
    assert not any(word in s for s in (*found.warnings, *found.notes) for word in ("camera", "corner", "image"))


def test_the_report_is_drawn(out: Path, assert_drawn: Callable[[str, set[str]], None]):
    text = (out / "report.html").read_text()
    assert_drawn(text, {"rig", "histogram", "points-0", "distance-0", "map-before", "map-after", "wheels-0"})
    assert not (out / "camchain-imucam.yaml").exists()
