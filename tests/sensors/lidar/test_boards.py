"""LiDARs beside a camera that sees a board, standing still: association from nothing, edges, the whole calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each
from tests.remarks import names
from tests.typed import not_none

from icalib.errors import EstimationError, RigError
from icalib.geometry import so3
from icalib.geometry.targets import Checkerboard
from icalib.pipeline import calibrate_measurements
from icalib.rig.file import rig_from_dict
from icalib.sensors.lidar.board_factor import Gate, edge_points, met_by_beams
from icalib.sensors.lidar.initialize.boards import Sheets, pose_by_sheets
from icalib.tools.simulation.stops import Stops, simulate_stops


def cut(stops: Stops, seed: int):
    """Sheets in the camera's frame as they truly are, and the cloud of each stop."""
    measured, boards = simulate_stops(stops, seed)
    low, high = stops.target.outlines[0]
    centre = boards[:, :3, :3] @ np.append(0.5 * (low + high), 0.0) + boards[:, :3, 3]
    cloud = measured.lidars[0]
    clouds = [cloud.xyz[a:b].astype(float) for a, b in zip(cloud.start[:-1], cloud.start[1:], strict=True)]
    return Sheets(boards[:, :3, :3], centre, high - low), clouds, boards


def turn_deg(R, truth) -> float:
    return float(np.rad2deg(np.linalg.norm(so3.log(np.ascontiguousarray(R.T @ truth)))))


def alike(number: int) -> np.ndarray:
    """T_cam_panel of flat objects as large as the sheet, that stay where they are."""
    panels = np.tile(np.eye(4), (number, 1, 1))
    panels[:, :3, :3] = np.diag([1.0, -1.0, -1.0])
    panels[:, :3, 3] = np.array([[-1.9, 0.3, 3.0], [1.2, 0.4, 3.5]])[:number]
    return panels


# T_board_panel of an object as large as the sheet, 1.2 m to its right
BESIDE = np.eye(4)[None] + np.array([[0.0, 0.0, 0.0, 1.2], *np.zeros((3, 4))])
CASES = {
    "16 rings": Stops(6),
    "64 rings": Stops(4, rings=64),
    "two objects alike that stay": Stops(6, panels=alike(2)),
    "a second board carried beside it": Stops(4, carried=BESIDE, elevation_deg=(-25.0, 15.0)),
    "a LiDAR mounted upside down": Stops(6, T_cam_lidar=Stops().T_cam_lidar @ np.diag([1.0, -1.0, -1.0, 1.0])),
    "ranges 5 cm too long": Stops(6, range_offset_m=0.05),
}


@each("case", CASES)
def test_the_board_is_found_from_nothing(case):
    stops = CASES[case]
    sheets, clouds, _ = cut(stops, 1)
    found = pose_by_sheets(sheets, clouds)
    assert found is not None
    pose, explained = found
    assert explained >= stops.n_stops - 1
    assert turn_deg(pose.R, stops.T_cam_lidar[:3, :3]) < 2.0
    assert np.linalg.norm(pose.p - stops.T_cam_lidar[:3, 3]) < 0.02 + 1.2 * stops.range_offset_m


SMALL = replace(Stops(4), target=Checkerboard(2, 2, 0.01, sheet=(0.02, 0.02)))
REFUSED = {
    "no board in the clouds": (SMALL, "the target was not found in its 4 clouds: no flat object of 0.70 x 0.85 m"),
    "two stops": (Stops(2), "clouds of 2 stops at which the cameras see the target are too few, at least 3 are needed"),
}


@each("case", REFUSED)
def test_clouds_that_do_not_show_one_board_are_refused(case):
    scanned, sentence = REFUSED[case]
    stops = Stops(scanned.n_stops)
    measured, _ = simulate_stops(stops, 2)
    clouds, _ = simulate_stops(scanned, 2)
    with pytest.raises(EstimationError, match=sentence):
        calibrate_measurements(stops.rig(), measured.with_streams(clouds.lidars[0]))


def test_rings_cross_the_edges_half_a_step_beyond_the_last_beam():
    stops = Stops(3, rings=32, range_noise_m=0.0)
    _, clouds, boards = cut(stops, 3)
    for cloud, T in zip(clouds, boards, strict=True):
        R, p = T[:3, :3].T @ stops.T_cam_lidar[:3, :3], T[:3, :3].T @ (stops.T_cam_lidar[:3, 3] - T[:3, 3])
        azimuth, gate = np.arctan2(cloud[:, 1], cloud[:, 0]), Gate(stops.target.outlines[0], 0.05)
        met = met_by_beams(cloud @ R.T + p, p[None])
        ends, edges = edge_points(np.column_stack([cloud, azimuth]), met, gate)
        points = ends[:, :3]
        np.testing.assert_allclose(ends[:, 3], np.arctan2(points[:, 1], points[:, 0]), atol=1e-6)  # as for time
        at = met_by_beams(points @ R.T + p, p[None]) * [1.0, 1.0, 0.0]
        off = (at * edges[:, :3]).sum(axis=1) - edges[:, 3]
        assert len(points) >= 8
        assert (np.abs(off) < 0.5 * edges[:, 4] + 1e-3).all() and np.abs(off).max() > 0.3 * edges[:, 4].max()


def test_white_noise_of_ranges_does_not_correlate_at_a_stop():
    """Points of oblique beams are moved along the sheet by their noise; this must not look like a tilt."""
    stops = Stops(8, rings=64)
    result = calibrate_measurements(stops.rig(), simulate_stops(stops, 4)[0])
    (fit,) = (f for f in result.fits if f.kind == "points on boards")
    assert 1.3**-2 < fit.chi2 / fit.dof < 1.1


def errors(stops: Stops, seed: int, sheet: tuple[float, float] = (0.7, 0.85)):
    """Errors (6,) of rotation [rad] and translation [m], and their covariance (6, 6). sheet: as the rig file has it."""
    measured, _ = simulate_stops(stops, seed)
    rig = stops.rig()
    result = calibrate_measurements(rig.with_(target=replace(rig.target, sheet=sheet)), measured)
    rotation, translation = result.group("lidar0", "rotation"), result.group("lidar0", "translation")
    turn = so3.log(np.ascontiguousarray(stops.T_cam_lidar[:3, :3].T @ rotation.value))
    columns = [*not_none(rotation.columns), *not_none(translation.columns)]
    error = np.append(turn, translation.value - stops.T_cam_lidar[:3, 3])
    return error, result.covariance[np.ix_(columns, columns)], result


@pytest.mark.slow
def test_ten_places_of_a_board():
    stops = Stops(10, range_offset_m=0.03)
    error, covariance, result = errors(stops, 4)
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.3
    assert np.linalg.norm(error[3:]) < 0.0125
    assert error @ np.linalg.solve(covariance, error) < 22.5  # chi^2 of 6 at 99.9 %
    offset = result.group("lidar0", "range_offset")
    assert abs(offset.value[0] - 0.03) < 4.0 * offset.std[0]
    assert {"lidar_points_on_target", "ranges_offset"} <= set(names(result.notes))


DISTURBED = {
    "a sheet 10 cm smaller than stated": (Stops(6), (0.8, 0.95), "mm farther in than `sheet`"),
    "edges that bleed": (Stops(6, bleed_m=0.03), (0.7, 0.85), "says, or bright edges bleed"),
    "boards cut by the field of view": (Stops(6, azimuth_deg=(-12.0, 12.0)), (0.7, 0.85), ""),
}


@pytest.mark.slow
@each("case", DISTURBED)
def test_disturbed_edges_are_named_and_do_no_harm(case):
    stops, sheet, sentence = DISTURBED[case]
    error, covariance, result = errors(stops, 1, sheet)
    assert error @ np.linalg.solve(covariance, error) < 22.5  # chi^2 of 6 at 99.9 %
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.3 and np.linalg.norm(error[3:]) < 0.02
    said = [w for w in result.warnings if w.name == "sheet_size_wrong"]
    assert [sentence in w for w in said] == [True] * bool(sentence)


@pytest.mark.slow
def test_boards_that_turn_about_one_axis_do_not_show_all():
    _, _, result = errors(Stops(4, board_angles_deg=(0.0, 40.0, 0.0)), 1)
    (sentence,) = result.unobservable
    assert sentence.startswith("lidar0 translation y: not determined by these places; show the target in more places")


BAD_SHEETS = {
    "smaller than its points": ([0.5, 0.5], "is smaller than the 0.475 x 0.57 m that its points span"),
    "not two numbers": ([0.7], "is .width, height. in metres"),
}


@each("case", BAD_SHEETS)
def test_sheets_that_cannot_be_are_refused(case):
    sheet, sentence = BAD_SHEETS[case]
    target = {"type": "checkerboard", "rows": 7, "cols": 6, "square_size": 0.095, "sheet": sheet}
    rig = {"target": target, "sensors": {"cam0": {"type": "camera", "model": "eucm", "resolution": [8, 6]}}}
    with pytest.raises(RigError, match=sentence):
        rig_from_dict(rig, "rig.yaml")
