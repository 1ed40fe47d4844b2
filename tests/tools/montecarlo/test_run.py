"""One run: errors against the truth, whiteness, the solver's path, and what goes wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.data.measurements import Measurements
from icalib.errors import RecordingError
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration, RowResiduals, Visited, by_key
from icalib.sensors.camera.stream import CornerResiduals
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.lidar.stream import LidarResiduals
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.montecarlo import record as one_run
from icalib.tools.montecarlo.record import PlanesKind, RunRecord, RunTask, compare, error, run, true_value, whiteness
from icalib.tools.simulation import (
    HandheldMotion,
    Room,
    Simulation,
    handheld,
    load_scenario,
    rig_for,
    simulate,
    with_drawn_guess,
)

PAPER = Path(__file__).parents[3] / "examples" / "paper"
SCENARIO = handheld(6.0)


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(SCENARIO, 1)


@pytest.fixture(scope="module")
def visits() -> list[Visited]:
    return []


@pytest.fixture(scope="module")
def result(simulation: Simulation, visits: list[Visited]) -> Calibration:
    rig = with_drawn_guess(rig_for(SCENARIO, intrinsics="free", distortion="free"), SCENARIO, 1)
    return calibrate_measurements(rig, simulation.measurements, on_visit=visits.append)


@pytest.fixture(scope="module")
def record(result: Calibration, simulation: Simulation, visits: list[Visited]) -> RunRecord:
    return compare(1, result, simulation.truth, visits, 1.0)


def test_errors_are_estimated_minus_true_in_the_columns_of_the_covariance(record, result, simulation):
    truth = simulation.truth
    assert [b.key for b in record.blocks] == [
        f"{c}.{n}"
        for c in ("cam0", "cam1")
        for n in ("rotation", "translation", "time_offset", "intrinsics", "distortion")
    ]
    R_true, R = truth.T_imu_sensor["cam1"][:3, :3], result.group("cam1", "rotation").value
    e = record.error[record.columns("cam1.rotation")]
    np.testing.assert_allclose(R_true @ Rotation.from_rotvec(e).as_matrix(), R, atol=1e-12)
    offset = result.group("cam0", "time_offset").value - truth.time_offset["cam0"]
    assert record.error[record.columns("cam0.time_offset")] == pytest.approx(offset, abs=0.0)
    for g in result.groups:
        k = record.columns(f"{g.sensor}.{g.name}")
        assert len(k) == 0 or np.sqrt(np.diag(record.covariance)[k]) == pytest.approx(g.std_formal, rel=1e-9)
    a, b = result.group("cam0", "rotation").columns, result.group("cam1", "translation").columns
    cross = record.covariance[np.ix_(record.columns("cam0.rotation"), record.columns("cam1.translation"))]
    np.testing.assert_array_equal(cross, result.covariance[np.ix_(a, b)])


def test_errors_are_small_and_have_the_size_of_their_deviations(record):
    ratio = record.error / np.sqrt(np.diag(record.covariance))
    assert np.abs(ratio).max() < 4.5 and np.abs(ratio).max() > 0.5


def test_a_rotation_error_is_on_the_right():
    turn = Rotation.from_rotvec([0.3, -0.7, 1.1]).as_matrix()
    small = np.array([1e-3, 2e-3, -3e-3])
    np.testing.assert_allclose(
        error("rotation", turn @ Rotation.from_rotvec(small).as_matrix(), turn), small, atol=1e-12
    )


def test_truth_of_every_sensor(simulation):
    T_imu_lidar, T_imu_wheel = np.diag([-1.0, -1.0, 1.0, 1.0]), np.eye(4) + np.eye(4, k=3)
    lidar = SimLidar("lidar0", T_imu_lidar)
    wheels = SimWheels("wheel0", T_imu_wheel, reports="poses", radii=(0.1, 0.2), baseline=0.4)
    truth = simulate(replace(SCENARIO, duration_s=0.5, room=Room(), sensors=(lidar, wheels)), 1).truth
    np.testing.assert_array_equal(true_value(truth, "lidar0", "rotation"), np.diag([-1.0, -1.0, 1.0]))
    np.testing.assert_array_equal(true_value(truth, "wheel0", "translation"), [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(true_value(truth, "wheel0", "radii"), [0.1, 0.2])
    np.testing.assert_array_equal(true_value(truth, "wheel0", "baseline"), [0.4])
    np.testing.assert_array_equal(true_value(truth, "cam0", "bloom"), [0.0])
    np.testing.assert_array_equal(true_value(truth, "imu0", "intrinsics"), np.zeros(24))
    assert true_value(truth, "wheel0", "scales") is None
    assert true_value(truth, "board0", "tilt") is None and true_value(truth, "lidar0", "radii") is None


def test_the_path_leads_from_the_guess_to_the_result(record, result, simulation, visits):
    rig = with_drawn_guess(rig_for(SCENARIO, intrinsics="free", distortion="free"), SCENARIO, 1)
    guess = rig.cameras[0].translation.value
    k = record.columns("cam0.translation")
    assert record.path[0].error[k] == pytest.approx(guess - simulation.truth.T_imu_sensor["cam0"][:3, 3])
    np.testing.assert_array_equal(record.path[-1].error, record.error)
    # The result also has what noise in the Jacobians does: next to nothing here.
    assert record.path[-1].std == pytest.approx(np.sqrt(np.diag(record.covariance)), rel=1e-3)
    stages = [w.stage for w in record.path]
    assert stages == sorted(stages, key=["first", "final"].index)


def test_the_path_is_that_of_the_last_start(result, simulation, visits):
    again = compare(1, result, simulation.truth, [*visits, *visits], 1.0)
    assert len(again.path) == len(visits)


def test_corners_of_white_noise_are_white_and_repeated_ones_are_not(result):
    own = {(w.sensor, w.kind): w for w in whiteness(result)}
    assert set(own) > {("cam0", "corners"), ("imu0", "velocity"), ("imu0", "gyroscope walk")}
    assert abs(own["cam0", "corners"].lag1) < 0.03
    assert own["cam0", "corners"].mean_square == pytest.approx(1.0, abs=0.03)
    same = replace(result, residuals=result.residuals | by_key([_persistent(result.corner_residuals[0])]))
    own = {(w.sensor, w.kind): w for w in whiteness(same)}
    assert own["cam0", "corners"].lag1 == pytest.approx(0.8, abs=0.02)


def _persistent(r: CornerResiduals) -> CornerResiduals:
    """Whitened residuals of each point that keep 0.8 of themselves from image to image; every 50th set aside."""
    rng = np.random.default_rng(0)
    residual, last = np.empty_like(r.residual), {}
    for i in range(len(r.seconds)):
        for k in range(r.start[i], r.start[i + 1]):
            before = last.get(r.point[k])
            new = rng.standard_normal(2)
            last[r.point[k]] = new if before is None else 0.8 * before + 0.6 * new
            residual[k] = last[r.point[k]] * r.sigma[k]
    rejected = np.arange(len(residual)) % 50 == 0
    residual[rejected] = 1e3
    return replace(r, residual=residual, rejected=rejected)


def test_the_same_task_gives_the_same_record():
    a, b = (run(RunTask(SCENARIO, 3)) for _ in range(2))
    assert a.failure == "" and a.error.tolist() == b.error.tolist()
    assert a.covariance.tolist() == b.covariance.tolist()


def test_a_run_that_fails_says_why():
    still = replace(SCENARIO, motion=HandheldMotion(kind="motionless"))
    failed = run(RunTask(still, 0))
    assert failed.failure.endswith(".") and "\n" not in failed.failure
    assert (failed.seed, failed.blocks) == (0, ())


@pytest.mark.parametrize(("planes", "told"), [("known", True), ("found", False)])
def test_planes_are_told_or_not(monkeypatch, planes: PlanesKind, told: bool):
    seen = list[Measurements]()

    def look(rig, measurements, **_):
        seen.append(measurements)
        raise RecordingError("seen.")

    monkeypatch.setattr(one_run, "calibrate_measurements", look)
    room = replace(load_scenario(PAPER / "table2-ramp.yaml"), duration_s=3.0, cameras=(), features=None)
    assert run(RunTask(room, 1, planes=planes)).failure == "seen."
    (lidar,) = seen[0].lidars
    assert (lidar.plane >= 0).any() == told and len(lidar.xyz) > 1000


@pytest.mark.parametrize(
    ("raised", "sentence"),
    [
        (RecordingError("cam0 is empty; record more."), "cam0 is empty; record more."),
        (
            ZeroDivisionError("by zero"),
            "the program failed (ZeroDivisionError: by zero), which is a fault of icalib; please report it.",
        ),
    ],
)
def test_errors_of_all_kinds_become_records(monkeypatch, raised: Exception, sentence: str):
    def fail(*_, **__):
        raise raised

    monkeypatch.setattr(one_run, "calibrate_measurements", fail)
    assert run(RunTask(SCENARIO, 5)).failure == sentence


def test_a_solver_that_did_not_converge_is_a_failed_run_with_its_errors(result, simulation):
    lost = compare(1, replace(result, converged=False, status="not converged."), simulation.truth, [], 1.0)
    assert lost.failure == "the solver did not converge: not converged."
    assert len(lost.error) and lost.path == ()


def _steps(rng: np.random.Generator, n: int, rho: float) -> np.ndarray:
    """(n,) of variance 1, each correlated with the last by `rho`."""
    x = rng.normal(size=n)
    for k in range(1, n):
        x[k] = rho * x[k - 1] + np.sqrt(1.0 - rho**2) * x[k]
    return x


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_points_are_compared_along_their_plane(result: Calibration, rho: float):
    """Two walls in turn, each with its own noise; a pause between the halves ties nothing."""
    n = 20000
    rng = np.random.default_rng(3)
    plane = np.arange(n, dtype=np.int32) % 2
    residual = np.empty(n)
    residual[0::2], residual[1::2] = _steps(rng, n // 2, rho), _steps(rng, n // 2, rho)
    seconds = np.arange(n) * 1e-3 + np.where(np.arange(n) < n // 2, 0.0, 60.0)
    rest = (np.ones(n), np.full(n, 0.02), np.zeros((n, 3)), 0.02 * residual, np.zeros((n, 3)), np.zeros(n))
    points = LidarResiduals("lidar0", 10, n, n, seconds, plane, *rest)
    own = {w.kind: w for w in whiteness(replace(result, residuals=result.residuals | by_key([points])))}
    assert own["points"].lag1 == pytest.approx(rho, abs=0.03)
    assert own["points"].mean_square == pytest.approx(1.0, abs=0.05)


def test_rows_of_wheels_are_compared_apart(result: Calibration):
    n = 20000
    rng = np.random.default_rng(4)
    whitened = np.stack([_steps(rng, n, 0.0), 2.0 * _steps(rng, n, 0.7)], axis=1)
    labels, units = ("left", "lateral"), ("rad", "m")
    wheels = RowResiduals("wheel0", "increments", labels, units, np.arange(n) * 0.02, whitened, whitened)
    own = {w.kind: w for w in whiteness(replace(result, residuals=result.residuals | by_key([wheels])))}
    assert own["left"].lag1 == pytest.approx(0.0, abs=0.03)
    assert own["lateral"].lag1 == pytest.approx(0.7, abs=0.03)
    assert own["lateral"].mean_square == pytest.approx(4.0, rel=0.1)
