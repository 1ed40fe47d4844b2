"""Speed and yaw rate, or steered front wheels, on the ground: from a recording to all that is made of a result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from icalib.cli import main
from icalib.export.formats import FORMATS
from icalib.geometry.targets import AprilGrid
from icalib.result import load_calibration
from icalib.rig import Ground
from icalib.rig.file import rig_to_dict
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import Scenario, load_scenario, rig_for, simulate
from icalib.tools.simulation.writing import write_tables

PAPER = Path(__file__).parents[2] / "examples" / "paper"
ON_WALL = np.array([[0.0, 0.0, -1.0, 5.9], [-1.0, 0.0, 0.0, 3.9], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
PARAMETERS = {
    "twist": {"scale_speed": 1.03, "scale_yaw_rate": 0.97},
    "steering": {"radius": 0.1, "wheelbase": 0.6, "steering_offset": 0.02},
}


def scenario_of(reports: str) -> Scenario:
    """Twenty seconds on hills before a wall of tags."""
    scenario = load_scenario(PAPER / "table2-ramp.yaml")
    wheels = replace(
        scenario.of(SimWheels)[0],
        reports=reports,
        scales=(1.03, 0.97),
        steering_offset=0.02,
        noise=0.005,
        speed_noise=5e-4,
        yaw_noise=2e-3,
        steering_noise=5e-4,
    )
    return replace(
        scenario,
        duration_s=20.0,
        features=None,
        cameras=(replace(scenario.cameras[0], corner_noise_px=0.15),),
        sensors=(wheels,),
        board=True,
        T_world_board=ON_WALL,
        target=AprilGrid(4, 10, 0.6, 0.3),
    )


@pytest.fixture(scope="module", params=PARAMETERS)
def run(request, tmp_path_factory) -> tuple[str, Path]:
    """What the wheels report, and a folder with rig.yaml and the result `out`; hills are far from a level plane."""
    folder, scenario = tmp_path_factory.mktemp(request.param), scenario_of(request.param)
    rig = rig_for(scenario)
    ground = Ground("level", 0.3, 0.0, 1.0, 0.5)
    rig = rig.with_(wheels=(replace(rig.wheels[0], ground=ground),))
    write_tables(simulate(scenario, 0), 0, folder / "recording")
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig_to_dict(rig)))
    arguments = [str(folder / "rig.yaml"), str(folder / "recording"), "-o", str(folder / "out"), "--quiet"]
    assert main(["calibrate", *arguments]) == 0
    return request.param, folder


def test_parameters_are_named_and_right(run):
    reports, folder = run
    own = yaml.safe_load((folder / "out" / "calibration.yaml").read_text())["sensors"]["wheel0"]
    assert set(own["parameters"]) == {*PARAMETERS[reports], "ground_height"}
    for name, true in PARAMETERS[reports].items():
        assert abs(own["parameters"][name] - true) < 4.0 * own["std"]["parameters"][name], name
    found = load_calibration(folder / "out")
    rows = {"twist": ("speed", "yaw"), "steering": ("wheel", "steering")}[reports]
    assert found.wheel_residuals[0].labels == (*rows, "lateral", "vertical")
    kinds = [f.kind for f in found.fits if f.sensor == "wheel0"]
    assert kinds == [*rows, "lateral slip", "vertical slip", "ground tilt", "ground height"]


def test_the_report_is_drawn(run, assert_drawn: Callable[[str, set[str]], None]):
    reports, folder = run
    text = (folder / "out" / "report.html").read_text()
    assert_drawn(text, {"rig", "wheels-0"})
    words = {"twist": ("scale speed", "scale yaw rate"), "steering": ("wheelbase", "steering offset")}[reports]
    assert all(word in text for word in words)


OF_LIDARS = ("fast-lio", "fast-livo2", "lio-sam")


@pytest.mark.parametrize("to", [name for name in FORMATS if name not in OF_LIDARS])
def test_it_goes_to_other_programs(run, tmp_path, to: str):
    """MINS, which has a place for a left and a right wheel, has none for these."""
    _, folder = run
    assert main(["export", str(folder / "out"), "--to", to, "-o", str(tmp_path / "files"), "--quiet"]) == 0
    assert (tmp_path / "files").exists() and not (tmp_path / "files" / "config_wheel.yaml").exists()


def test_it_is_the_same_as_itself_and_not_as_what_was_guessed(run, tmp_path, capsys):
    reports, folder = run
    assert main(["compare", str(folder / "out"), str(folder / "out")]) == 0
    plain = yaml.safe_load((folder / "rig.yaml").read_text())
    group = {"twist": ("scales", [1.2, 1.0]), "steering": ("steering_offset", [0.1])}[reports]
    plain["sensors"]["wheel0"][group[0]] = {"guess": group[1]}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(plain))
    capsys.readouterr()
    assert main(["compare", str(folder / "out"), str(tmp_path / "rig.yaml")]) == 1
    words = {"twist": "the speed scale of wheel0 changed by +", "steering": "steering offset of wheel0 changed by +4."}
    assert words[reports] in capsys.readouterr().out
