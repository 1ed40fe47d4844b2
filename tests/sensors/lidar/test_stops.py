"""Recordings that go on between stops: stops are found and used, and what never rests is calibrated in motion or
refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each
from tests.remarks import names
from tests.typed import not_none

from icalib.cli import main
from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.smooth_trajectory import common_stops, rests
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration, load_calibration
from icalib.sensors.lidar.initialize.boards import at_places, sees_the_same
from icalib.sensors.lidar.initialize.surroundings import at_stops
from icalib.tools.inspection import GivenTarget, draft_rig, inspect_recording
from icalib.tools.simulation.output import BagWriter
from icalib.tools.simulation.stops import (
    CORRIDOR,
    ONCE,
    STREET,
    Pauses,
    Stops,
    Surroundings,
    load_stops,
    simulate_stops,
    simulate_surroundings,
)

CARRIED = Path(__file__).parents[3] / "examples" / "stops" / "carried-board.yaml"
BOARD = Stops(6, azimuth_steps=900, pauses=Pauses(sway_m=0.002))
NEVER_STILL = replace(BOARD, pauses=Pauses(hold_s=1e-9))
ROOM = Surroundings(azimuth_steps=450, pauses=Pauses(carry_s=3.0))
ON_STREET = replace(ROOM, boxes=STREET, places=(6.0, 2.0), height_m=1.9)


def errors(result: Calibration, name: str, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (6,) of rotation [rad] and translation [m], and their covariance (6, 6)."""
    rotation, translation = result.group(name, "rotation"), result.group(name, "translation")
    turn = so3.log(np.ascontiguousarray(T[:3, :3].T @ rotation.value))
    columns = [*not_none(rotation.columns), *not_none(translation.columns)]
    return np.append(turn, translation.value - T[:3, 3]), result.covariance[np.ix_(columns, columns)]


def test_rests_are_the_runs_without_motion():
    """Still from 1 to 3 s, from 5 to 6.5 s at another place, there again after a nudge; from 9 to 9.5 s too short."""
    seconds = np.arange(0.0, 11.0, 0.1)
    still = [(1.0, 3.0, 0.0), (5.0, 6.5, 4.0), (7.1, 8.5, 4.0), (9.0, 9.5, 9.0)]
    place = 20.0 * seconds
    for first, last, where in still:
        place[(seconds > first - 0.01) & (seconds < last + 0.01)] = where
    found = seconds[rests(seconds, lambda a, b: np.abs(place[a] - place[b]), 0.1)]
    np.testing.assert_allclose(found, [[1.2, 2.8], [5.2, 6.3]], atol=0.11)


def image_stops(*cameras: CornerStream) -> np.ndarray:
    return common_stops([(c.stamps_ns, c.by_point()) for c in cameras])


def test_stops_of_images_are_where_the_board_is_held():
    measured, _ = simulate_stops(BOARD, 1)
    first, last = (1e-9 * image_stops(measured.cameras[0]) - 1.0).T
    held = 3.5 * np.arange(6)  # to 2 s later
    assert ((first > held - 0.3) & (last < held + 2.3) & (last - first > 1.2)).all()


def test_two_cameras_have_the_stops_that_either_sees():
    """cam1 is 50 ms late and sees the first half of the recording only; cam0 does not see the first place."""
    (cam0,) = simulate_stops(BOARD, 1)[0].cameras
    t = cam0.seconds
    other = replace(part(cam0, t < 10.0), name="cam1")
    other = replace(other, stamps_ns=other.stamps_ns + 50_000_000)
    assert len(image_stops(part(cam0, t > 3.0), other)) == 6


def part(stream: CornerStream, images: np.ndarray) -> CornerStream:
    return stream.of_rows(images[stream.image], stream.stamps_ns[images], np.diff(stream.start)[images])


def test_a_lidar_that_moves_is_told_from_one_that_stands():
    assert sees_the_same(simulate_stops(NEVER_STILL, 1)[0].lidars[0])
    moving = simulate_surroundings(ROOM, 1).lidars[0]
    assert not sees_the_same(moving)
    assert not sees_the_same(simulate_surroundings(replace(ROOM, pauses=Pauses(1e-9, 3.0)), 1).lidars[0])


def test_what_does_not_stop_is_left_as_it_is():
    """A rig that moves all the time, beside a target or alone; folders of stops; and sensors of other kinds."""
    driven = simulate_surroundings(replace(ROOM, pauses=Pauses(1e-9, 4.0)), 1)
    assert at_stops(ROOM.rig(), [driven]) == [driven]
    (camera,) = simulate_stops(BOARD, 1)[0].cameras
    beside = driven.without("lidar1").with_streams(camera)
    assert at_places(BOARD.rig(), [beside]) == [beside]
    folder = simulate_stops(replace(BOARD, pauses=ONCE), 1)[0]
    assert at_places(BOARD.rig(), [folder]) == [folder]


def late(m: Measurements) -> Measurements:
    """The clock of the LiDAR has another origin."""
    lidar = m.lidars[0]
    return m.with_streams(replace(lidar, stamps_ns=lidar.stamps_ns + 3_600_000_000_000))


FEW = {
    "a board that is carried without stops": (
        NEVER_STILL,
        "target at rest in only 0 of the at least 3 places",
    ),
    "two stops": (replace(BOARD, n_stops=2), "in only 2 of the at least 3 .*; hold the board still for two"),
    "a board that stays": (replace(BOARD, n_stops=1, pauses=Pauses(20.0)), "in only 1 of the"),
}


@each("case", FEW)
def test_too_few_stops_are_refused(case):
    stops, sentence = FEW[case]
    with pytest.raises(EstimationError, match=sentence):
        calibrate_measurements(stops.rig(), simulate_stops(stops, 1)[0])


def test_clouds_of_another_time_are_refused():
    with pytest.raises(EstimationError, match="lidar0 has no image or cloud of the stops that cam0 shows"):
        calibrate_measurements(BOARD.rig(), late(simulate_stops(BOARD, 1)[0]))


@pytest.mark.slow
@each("case", ["a bag at 10 Hz"], full=["late by 100 ms"])
def test_a_carried_board_gives_what_its_stops_give(case):
    """Over three seeds errors are as the standard deviations say, which are those of a folder of the same places."""
    pauses = Pauses(sway_m=0.001, camera_hz=10.0, late_s=0.1 if "late" in case else 0.03)
    stops, T, chi2 = replace(BOARD, pauses=pauses), BOARD.T_cam_lidar, 0.0
    for seed in range(3):
        result = calibrate_measurements(stops.rig(), simulate_stops(stops, seed)[0])
        folder = calibrate_measurements(stops.rig(), simulate_stops(replace(stops, pauses=ONCE), seed)[0])
        error, covariance = errors(result, "lidar0", T)
        assert np.rad2deg(np.linalg.norm(error[:3])) < 0.3 and np.linalg.norm(error[3:]) < 0.0125
        chi2 += error @ np.linalg.solve(covariance, error)
        np.testing.assert_allclose(np.diag(covariance), np.diag(errors(folder, "lidar0", T)[1]), rtol=0.6)
        assert "stops_found" in names(result.notes) and "stops_found" not in names(folder.notes)
        assert str(next(n for n in result.notes if n.name == "stops_found")).startswith("stops found: 6.")
    assert 4.9 < chi2 < 42.3  # chi^2 of 18, 99.9 % both sides


@pytest.mark.slow
@each("scene", ["room", "street"])
def test_lidars_that_drive_and_stop(scene):
    """In motion the height of lidar1 would be unobservable in the room, and the street be refused."""
    setup, chi2 = {"room": ROOM, "street": ON_STREET}[scene], 0.0
    for seed in range(3):
        result = calibrate_measurements(setup.rig(), simulate_surroundings(setup, seed))
        error, covariance = errors(result, "lidar1", setup.T_lidar0["lidar1"])
        assert np.rad2deg(np.linalg.norm(error[:3])) < 0.1 and np.linalg.norm(error[3:]) < 5e-3
        chi2 += error @ np.linalg.solve(covariance, error)
        assert {"stops_found", "lidar_surfaces_shared"} <= set(names(result.notes))
    assert chi2 < 42.3  # standard deviations on the street are too large, see docs/lidars.md


@pytest.mark.slow
def test_lidars_that_stand_still_all_the_time():
    scene = replace(ON_STREET, n_stops=1, pauses=Pauses(5.0))
    result = calibrate_measurements(scene.rig(), simulate_surroundings(scene, 100))
    error, covariance = errors(result, "lidar1", scene.T_lidar0["lidar1"])
    assert error @ np.linalg.solve(covariance, error) < 22.5  # chi^2 of 6 at 99.9 %
    assert str(result.notes[0]).startswith("stops found: 1.")


@pytest.mark.slow
def test_stops_in_a_corridor_are_refused_by_name():
    scene = replace(ROOM, boxes=CORRIDOR, n_stops=2, places=(3.0, 0.2))
    with pytest.raises(EstimationError, match="two poses in view of lidar0 explain its clouds alike"):
        calibrate_measurements(scene.rig(), simulate_surroundings(scene, 4))


@pytest.mark.slow
def test_a_bag_is_inspected_drafted_and_calibrated(tmp_path, capsys):
    text = CARRIED.read_text().replace("count: 6", "count: 3").replace("hold: 2, carry: 1.5", "hold: 1.6, carry: 1")
    text = text.replace("noise_px: 0.1\n    rate: 10", "noise_px: 0.1\n    rate: 6")
    (tmp_path / "scenario.yaml").write_text(text)
    run, draft = tmp_path / "run", tmp_path / "draft.yaml"
    assert main(["simulate", str(tmp_path / "scenario.yaml"), "-o", str(run), "--level", "sensor", "-q"]) == 0
    assert main(["inspect", str(run), "--target", str(run / "rig.yaml"), "--rig", str(draft)]) in (0, 1)
    said = " ".join(capsys.readouterr().out.split())
    assert "lidar0 stands still, and the target is at rest in 3 places; each is taken as a stop." in said
    assert main(["calibrate", str(draft), str(run), "-o", str(tmp_path / "result"), "-q"]) == 0
    result, T = load_calibration(tmp_path / "result"), not_none(load_stops(CARRIED)).T_cam_lidar
    error, covariance = errors(result, "lidar0", T)
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.5 and np.linalg.norm(error[3:]) < 0.02
    assert error @ np.linalg.solve(covariance, error) < 22.5  # chi^2 of 6 at 99.9 %


@pytest.mark.slow
def test_a_bag_of_lidars_without_times_of_points(tmp_path):
    """Drivers that give no times: at stops none are needed, and the draft says so."""
    measured = simulate_surroundings(ON_STREET, 2)
    write_bag(tmp_path / "run", measured)
    inspection = inspect_recording(tmp_path / "run")
    assert "Stops found: 3;" in " ".join(f.sentence for f in inspection.findings)
    assert inspection.verdict == "yes"
    draft = draft_rig(inspection)
    assert draft.count("point_time: snapshot") == 2
    (tmp_path / "rig.yaml").write_text(draft)
    main(["calibrate", str(tmp_path / "rig.yaml"), str(tmp_path / "run"), "-o", str(tmp_path / "result"), "-q"])
    error, covariance = errors(load_calibration(tmp_path / "result"), "lidar1", ON_STREET.T_lidar0["lidar1"])
    assert error @ np.linalg.solve(covariance, error) < 22.5  # chi^2 of 6 at 99.9 %


def write_bag(path: Path, measured: Measurements) -> None:
    """The clouds as PointCloud2 with x, y, z alone."""
    kind, topics = "sensor_msgs/msg/PointCloud2", {f"/{s.name}/points": s for s in measured.lidars}
    with BagWriter("mcap", path, dict.fromkeys(topics, kind)) as bag:
        fields = [bag.make("sensor_msgs/msg/PointField", name, 4 * i, 7, 1) for i, name in enumerate("xyz")]
        for topic, stream in topics.items():
            for ns, xyz in zip(stream.stamps_ns.tolist(), np.split(stream.xyz, stream.start[1:-1]), strict=True):
                data = np.ascontiguousarray(xyz, "<f4").view(np.uint8).ravel()
                shape = 1, len(xyz), fields, False, 12, 12 * len(xyz)
                bag.write(topic, bag.make(kind, bag.header(ns, stream.name), *shape, data, True), ns)


def test_inspect_asks_for_stops(tmp_path):
    scenario = CARRIED.read_text().replace("count: 6", "count: 2").replace("rings: 32", "rings: 8")
    (tmp_path / "scenario.yaml").write_text(scenario)
    assert main(["simulate", str(tmp_path / "scenario.yaml"), "-o", str(tmp_path / "run"), "-q"]) == 0
    target = GivenTarget(not_none(load_stops(CARRIED)).target, "rig.yaml")
    inspection = inspect_recording(tmp_path / "run", target)
    assert inspection.verdict == "no"
    (sentence,) = [f.sentence for f in inspection.findings if f.severity == "problem"]
    assert sentence.endswith("in 2 places, too few; hold the board still for two seconds at each of ten places.")
