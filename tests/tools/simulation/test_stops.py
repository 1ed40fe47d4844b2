"""Scenario files of a camera and a LiDAR at rest: what is written is what is simulated, and bad files are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.cases import each

from icalib.cli import main
from icalib.data.recordings import open_recording, read_measurements
from icalib.errors import RigError
from icalib.rig.file import load_rig
from icalib.tools.simulation.stops import ONCE, Pauses, load_stops, simulate_stops

EXAMPLE = Path(__file__).parents[3] / "examples" / "stops" / "camera-lidar.yaml"
CARRIED = EXAMPLE.with_name("carried-board.yaml")


def test_a_scenario_of_stops_is_written_and_read_back(tmp_path):
    scenario = EXAMPLE.read_text().replace("count: 10", "count: 2, range_offset: 0.03, room: 6")
    (tmp_path / "scenario.yaml").write_text(scenario)
    assert main(["simulate", str(tmp_path / "scenario.yaml"), "-o", str(tmp_path / "run"), "-q"]) == 0
    stops = load_stops(tmp_path / "scenario.yaml")
    assert stops is not None and (stops.n_stops, stops.room_m, stops.seed) == (2, 6.0, 1)
    measured, boards = simulate_stops(stops, 1)
    rig = load_rig(tmp_path / "run" / "rig.yaml")
    read = read_measurements(open_recording(tmp_path / "run"), rig)
    np.testing.assert_allclose(read.cameras[0].uv, measured.cameras[0].uv, rtol=1e-12)
    np.testing.assert_allclose(read.lidars[0].xyz, measured.lidars[0].xyz, rtol=1e-6, atol=1e-6)
    truth = yaml.safe_load((tmp_path / "run" / "truth.yaml").read_text())
    np.testing.assert_allclose(truth["T_cam0_board"], boards, rtol=0, atol=1e-12)
    # T_imu_sensor of the file: the LiDAR is 9 cm behind the camera, 3 cm to its right and 16 cm above
    T = np.array(truth["sensors"]["lidar0"]["T_cam0_lidar0"])
    np.testing.assert_allclose(T[:3, 3], [0.03, -0.16, -0.09], atol=1e-12)
    assert truth["sensors"]["lidar0"]["range_offset"] == 0.03


BAD = {
    "no number of stops": ("count: 10, ", "", "count"),
    "a word for a length": ("distance: [1.5, 3.5]", "distance: [near, 3.5]", "distance"),
    "no LiDAR": ("  lidar0:", "  lidar1:", "lidar1"),
    "free tags": ("{type: checkerboard, rows: 7, cols: 6, square_size: 0.095, sheet: [0.7, 0.85]}",
                  "{type: markers, family: tag36h11, size: 0.1, ids: [1, 2]}", "before one board; give one"),
}  # fmt: skip


@each("case", BAD)
def test_bad_scenarios_of_stops_are_refused(case, tmp_path):
    old, new, sentence = BAD[case]
    text = EXAMPLE.read_text()
    assert old in text
    (tmp_path / "scenario.yaml").write_text(text.replace(old, new))
    with pytest.raises(RigError, match=sentence):
        load_stops(tmp_path / "scenario.yaml")


def test_stops_alone_are_no_bag(tmp_path, capsys):
    assert main(["simulate", str(EXAMPLE), "-o", str(tmp_path / "run"), "--level", "sensor"]) == 1
    assert "a bag of stops needs `hold` in the section stops; give it, or leave --level out." in capsys.readouterr().err


def test_a_recording_rests_at_the_places_and_moves_between():
    places = np.tile(np.eye(4), (3, 1, 1))
    places[:, 0, 3] = 0.0, 1.0, 3.0
    places[1, :3, :3] = np.diag([-1.0, -1.0, 1.0])
    pauses = Pauses(hold_s=2.0, carry_s=1.0, camera_hz=10.0)
    seconds = pauses.instants(3, 10.0)
    poses = pauses.poses(places, seconds)
    assert len(seconds) == 80  # three holds and two ways
    rest = seconds % 3.0 < 2.0
    np.testing.assert_allclose(poses[rest], places[(seconds[rest] // 3.0).astype(int)], atol=1e-12)
    middle = pauses.poses(places, np.array([2.5, 5.5]))
    np.testing.assert_allclose(middle[:, 0, 3], [0.5, 2.0])
    assert np.trace(middle[0, :3, :3]) == pytest.approx(1.0)  # half of half a turn
    sway = replace(pauses, sway_m=0.01).poses(places, seconds)[:, :3, 3] - poses[:, :3, 3]
    np.testing.assert_allclose(np.abs(sway).max(axis=0), 0.01, rtol=0.05)


def test_scenarios_give_the_times_and_the_offset_of_clocks(tmp_path):
    stops = load_stops(CARRIED)
    assert stops is not None
    assert stops.pauses == Pauses(2.0, 1.5, camera_hz=10.0, lidar_hz=10.0, scan_s=0.1, late_s=0.03, sway_m=0.001)
    measured, _ = simulate_stops(replace(stops, n_stops=2, azimuth_steps=90), 1)
    lidar = measured.lidars[0]
    assert lidar.stamps_ns[0] - measured.cameras[0].stamps_ns[0] == 30_000_000
    assert 0.09 < lidar.offset_s.max() < 0.1
    assert load_stops(EXAMPLE).pauses == ONCE  # pyright: ignore[reportOptionalMemberAccess]
