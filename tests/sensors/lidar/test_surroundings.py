"""Several LiDARs that stand still: from nothing by the surfaces that they share, with honest standard deviations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each
from tests.remarks import names
from tests.typed import not_none

from icalib.data.measurements import LidarStream, Measurements
from icalib.errors import EstimationError, RecordingError
from icalib.geometry import so3
from icalib.optim.state import State
from icalib.pipeline import calibrate, calibrate_measurements
from icalib.result import load_calibration
from icalib.rig.file import rig_from_dict
from icalib.sensors.lidar.initialize.registration import Surfels, register
from icalib.sensors.lidar.patch_factor import PatchPoints, PatchRows
from icalib.tools.inspection import draft_rig, inspect_recording
from icalib.tools.simulation.stops import CORRIDOR, STREET, Surroundings, pose, simulate_surroundings

pytestmark = pytest.mark.slow

SMALL = Surroundings(n_stops=2, azimuth_steps=450)
ON_STREET = replace(SMALL, boxes=STREET, places=(6.0, 2.0), height_m=1.9)


def errors(result, T: np.ndarray, name: str = "lidar1") -> tuple[np.ndarray, np.ndarray]:
    """Errors (6,) of rotation [rad] and translation [m], and their covariance (6, 6)."""
    rotation, translation = result.group(name, "rotation"), result.group(name, "translation")
    turn = so3.log(np.ascontiguousarray(T[:3, :3].T @ rotation.value))
    columns = [*not_none(rotation.columns), *not_none(translation.columns)]
    return np.append(turn, translation.value - T[:3, 3]), result.covariance[np.ix_(columns, columns)]


def poses_deg_m(T: np.ndarray, found) -> tuple[float, float]:
    turn = so3.log(np.ascontiguousarray(T[:3, :3].T @ found.R))
    return float(np.rad2deg(np.linalg.norm(turn))), float(np.linalg.norm(T[:3, 3] - found.p))


MOUNTS = {
    "upside down": pose((180.0, 0.0, 0.0), (0.2, 0.3, 0.4)),
    "on its side": pose((70.0, -60.0, 20.0), (-0.5, 0.0, 0.3)),
}


@each("case", MOUNTS)
def test_any_mount_is_found_from_nothing(case):
    scene = replace(ON_STREET, T_lidar0={"lidar0": np.eye(4), "lidar1": MOUNTS[case]})
    a, b = ([Surfels.of(cloud) for cloud in clouds(s)] for s in simulate_surroundings(scene, 5).lidars)
    found = not_none(register(a, b))
    turn, shift = poses_deg_m(MOUNTS[case], found.pose)
    assert turn < 1.0
    assert shift < 0.1
    assert not found.is_ambiguous


def clouds(stream: LidarStream) -> list[np.ndarray]:
    return np.split(stream.xyz, stream.start[1:-1])


def test_rows_are_distances_from_planes_that_are_eliminated():
    """Rows of noiseless points on planes are zero at the truth, but for patches at corners. Beside it they are as large
    as the pose error says, whatever planes fit the points."""
    scene = replace(SMALL, range_noise_m=0.0, n_stops=1)
    streams = {s.name: s for s in simulate_surroundings(scene, 6).lidars}
    state = _state(scene.T_lidar0)
    points = PatchPoints.of(streams, state, 0.03, 0.12)
    rows = PatchRows.of(points, tuple(streams), state, 0.01, 1e-9)
    residual, J = rows.at(tuple(streams), state)
    assert len(residual) > 50
    assert np.median(np.abs(residual)) < 1e-3
    step = 1e-4 * np.array([1.0, -2.0, 1.5, 1.0, 2.0, -1.0])
    T = scene.T_lidar0["lidar1"].copy()
    T[:3, :3] = T[:3, :3] @ so3.exp(step[:3])
    T[:3, 3] += step[3:]
    beside, _ = rows.at(tuple(streams), _state({"lidar0": np.eye(4), "lidar1": T}))
    np.testing.assert_allclose(beside - residual, J[:, 1] @ step, atol=1e-3 * np.abs(J[:, 1] @ step).max())


def _state(poses):
    values = {}
    for name, T in poses.items():
        values |= {(name, "rotation"): np.ascontiguousarray(T[:3, :3]), (name, "translation"): T[:3, 3]}
        values[name, "time_offset"] = np.zeros(1)
    return State(np.zeros(1), np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 6)), values)


@each("scene", ["room"], full=["street"])
def test_lidars_are_calibrated_by_what_they_share(scene, tmp_path):
    setup = {"room": SMALL, "street": ON_STREET}[scene]
    result = calibrate_measurements(setup.rig(), simulate_surroundings(setup, 2))
    error, covariance = errors(result, setup.T_lidar0["lidar1"])
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.1
    assert np.linalg.norm(error[3:]) < 5e-3
    assert error @ np.linalg.solve(covariance, error) < 22.5  # chi^2 of 6 at 99.9 %
    assert "lidar_surfaces_shared" in names(result.notes)
    assert not {"smooth_motion_assumed"} & set(names(result.notes))
    result.save(tmp_path)
    loaded = load_calibration(tmp_path)
    np.testing.assert_array_equal(loaded.T_body_sensor("lidar1"), result.T_body_sensor("lidar1"))


REFUSED = {
    "a corridor": (
        replace(SMALL, boxes=CORRIDOR, n_stops=1),
        r"moved by .* along \[.*\] of the body, as along parallel",
    ),
    "an empty room": (
        replace(SMALL, boxes=SMALL.boxes[:1], n_stops=1),
        "two poses in view of lidar0 explain its",
    ),
}


@each("case", REFUSED)
def test_scenes_that_do_not_determine_the_pose_are_refused(case):
    scene, sentence = REFUSED[case]
    with pytest.raises(EstimationError, match=sentence):
        calibrate_measurements(scene.rig(), simulate_surroundings(scene, 4))


def test_a_lidar_that_sees_other_walls_is_refused():
    measured = simulate_surroundings(SMALL, 7)
    street = simulate_surroundings(replace(ON_STREET, places=(0.0, 0.0)), 8)
    other = measured.with_streams(street.lidars[1])
    with pytest.raises(EstimationError, match="lidar1 shares too few surfaces with lidar0|explain its"):
        calibrate_measurements(SMALL.rig(), other)


def test_millimetres_are_refused():
    measured = simulate_surroundings(SMALL, 7)
    lidar1 = measured.lidars[1]
    with pytest.raises(EstimationError, match="lidar1 shares too few surfaces with lidar0"):
        calibrate_measurements(SMALL.rig(), measured.with_streams(replace(lidar1, xyz=1e3 * lidar1.xyz)))


def write_pcd(path: Path, xyz: np.ndarray) -> None:
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(xyz)}\nHEIGHT 1\nDATA binary\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(head.encode() + xyz.astype("<f4").tobytes())


def write(folder: Path, measured: Measurements) -> None:
    """The clouds as files lidar0/1.pcd and so on."""
    for stream in measured.lidars:
        for k, cloud in enumerate(clouds(stream), 1):
            write_pcd(folder / stream.name / f"{k}.pcd", cloud)


def test_a_folder_of_clouds_is_drafted(tmp_path: Path):
    write(tmp_path, simulate_surroundings(SMALL, 2))
    inspection = inspect_recording(tmp_path)
    assert inspection.verdict == "yes"
    assert any("a stop at which the rig stands still" in f.sentence for f in inspection.findings)
    draft = draft_rig(inspection)
    assert 'topic: "lidar1/*.pcd"' in draft
    assert "target" not in draft.replace("# ", "").split("sensors:")[1]


def test_a_lidar_without_points_is_refused(tmp_path: Path):
    measured = simulate_surroundings(SMALL, 2)
    write(tmp_path, measured)
    for path in (tmp_path / "lidar1").iterdir():
        write_pcd(path, np.zeros((0, 3)))
    sensors = {f"lidar{k}": {"type": "lidar", "topic": f"lidar{k}/*.pcd"} for k in range(2)}
    rig = rig_from_dict({"sensors": sensors}, "rig.yaml")
    with pytest.raises(RecordingError, match="lidar1.*0 of 2 scans have usable points"):
        calibrate(rig, tmp_path)
