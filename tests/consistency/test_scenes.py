"""Targets of several bodies, tag maps among them: how they stand is found, and nothing of it is given."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry.targets import Scene
from icalib.model.bodies import Bodies
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, Rig
from icalib.sensors.camera.initialize.scene_intrinsics import check_bodies_still, find_scene, scene_error_ratios
from icalib.sensors.camera.model import choose_bodies, restrict
from icalib.tools.simulation import Scenario, Simulation, rig_for, simulate, tag_map


def seen_only(recording: Measurements, wanted: Callable[[np.ndarray], np.ndarray]) -> Measurements:
    """The recording without the corners whose points are not `wanted`."""

    def cut(s: CornerStream) -> CornerStream:
        keep = wanted(s.point)
        count = np.bincount(s.image[keep], minlength=len(s.stamps_ns))
        start = np.concatenate([[0], np.cumsum(count[count > 0])])
        return CornerStream(s.name, s.stamps_ns[count > 0], start, s.point[keep], s.uv[keep])

    return recording.with_streams(*(cut(c) for c in recording.cameras))


def free(scenario: Scenario) -> Rig:
    return rig_for(scenario, intrinsics="free", distortion="free")


def camera_errors(result: Calibration, simulation: Simulation, camera: str) -> list[float]:
    """rad, m, s, relative."""
    T = simulation.truth.T_imu_sensor[camera]
    found = result.group(camera, "intrinsics").value
    return [
        Rotation.from_matrix(T[:3, :3].T @ result.group(camera, "rotation").value).magnitude(),
        float(np.linalg.norm(result.group(camera, "translation").value - T[:3, 3])),
        abs(float(result.group(camera, "time_offset").value[0] - simulation.truth.time_offset[camera])),
        float(np.abs(found / simulation.truth.values[camera]["intrinsics"] - 1.0).max()),
    ]


def scene_errors(result: Calibration, simulation: Simulation) -> list[float]:
    """rad, m of each body in the frame of the reference."""
    names = simulation.scenario.target.bodies
    true = dict(zip(names, simulation.truth.T_world_bodies, strict=True))
    errors = []
    for body in result.bodies:
        T = np.linalg.inv(true[body]) @ true[result.bodies[0]] @ result.T_scene_body(body)
        errors += [Rotation.from_matrix(T[:3, :3]).magnitude(), float(np.linalg.norm(T[:3, 3]))]
    return errors


@pytest.mark.parametrize("with_grid", [True, pytest.param(False, marks=pytest.mark.full)])
def test_noiseless_scenes_are_recovered_from_nothing(with_grid: bool):
    simulation = simulate(tag_map(8.0, noiseless=True, with_grid=with_grid), 0)
    result = calibrate_measurements(free(simulation.scenario), simulation.measurements)
    assert result.converged, result.status
    assert set(result.bodies) == set(simulation.scenario.target.bodies)
    assert result.bodies[0] == ("grid" if with_grid else result.bodies[0])
    assert max(scene_errors(result, simulation)) < 1e-7
    for camera in ("cam0", "cam1"):
        assert max(camera_errors(result, simulation, camera)) < 1e-7


def test_a_scene_without_an_imu():
    scenario = tag_map(10.0, noiseless=True)
    together = tuple(dataclasses.replace(c, time_offset_s=0.0) for c in scenario.cameras)
    simulation = simulate(dataclasses.replace(scenario, cameras=together), 1)
    rig = free(simulation.scenario).with_(imu=None)
    result = calibrate_measurements(rig, simulation.measurements.without("imu0"))
    assert max(scene_errors(result, simulation)) < 1e-7
    T0, T1 = (simulation.truth.T_imu_sensor[c] for c in ("cam0", "cam1"))
    np.testing.assert_allclose(result.T_imu_sensor("cam1"), np.linalg.inv(T0) @ T1, atol=1e-7)


def test_recordings_that_show_different_tags_share_one_scene():
    """Eight of the twelve tags each, four in both."""
    simulations = [simulate(tag_map(8.0, noiseless=True), seed) for seed in (0, 1)]
    tags = simulations[0].scenario.target.body
    kept = (lambda q: tags[q] < 8, lambda q: tags[q] >= 4)
    recordings = [seen_only(s.measurements, k) for s, k in zip(simulations, kept, strict=True)]
    result = calibrate_measurements(free(simulations[0].scenario), recordings)
    assert len(result.bodies) == 12
    assert max(scene_errors(result, simulations[0])) < 1e-7
    assert max(camera_errors(result, simulations[0], "cam0")) < 1e-7


def moved_between(step: list[float], noiseless: bool) -> tuple[Rig, list[Measurements]]:
    """Two recordings; in the second every other tag is moved by `step` [m]."""
    simulations = [simulate(tag_map(8.0, noiseless=noiseless), seed) for seed in (0, 1)]
    poses = simulations[1].scenario.T_world_bodies
    assert poses is not None
    moved = poses.copy()
    moved[::2, :3, 3] += step
    other = simulate(dataclasses.replace(simulations[1].scenario, T_world_bodies=moved), 1)
    pairs = (simulations[0], "old"), (other, "new")
    return rig_for(simulations[0].scenario), [dataclasses.replace(s.measurements, name=name) for s, name in pairs]


def test_a_scene_that_was_changed_between_recordings_is_named():
    rig, recordings = moved_between([0.02, -0.05, 0.1], noiseless=True)
    with pytest.raises(
        EstimationError, match="^(new|old): the poses of the targets relative to each other differ from the other"
    ):
        calibrate_measurements(rig, recordings)


@pytest.mark.full
def test_a_small_change_is_named_beside_noise():
    rig, pair = moved_between([0.0, 0.01, 0.02], noiseless=False)
    bodies, recordings = chosen(rig, pair)
    with pytest.raises(EstimationError, match="^(new|old): the poses of the targets relative to each other"):
        check_bodies_still(rig, find_scene(rig, bodies, recordings), recordings)


def images(recording: Measurements, count: int) -> Measurements:
    """The first images of each camera."""
    cameras = (c.of_rows(c.image < count, c.stamps_ns[:count], np.diff(c.start)[:count]) for c in recording.cameras)
    return recording.with_streams(*cameras)


def chosen(rig: Rig, recordings: list[Measurements]) -> tuple[Bodies, list[Measurements]]:
    bodies = choose_bodies(rig.target, recordings, bent=False)
    return bodies, [restrict(bodies, r) for r in recordings]


@pytest.mark.parametrize("count", [4, *(pytest.param(n, marks=pytest.mark.full) for n in (1, 200))])
def test_a_scene_that_stayed_is_no_change(count: int):
    """However few images one of the recordings has: in a scene of its own they fit better by chance."""
    rig, (first, second) = moved_between([0.0, 0.0, 0.0], noiseless=False)
    bodies, recordings = chosen(rig, [first, images(second, count)])
    scene = find_scene(rig, bodies, recordings)
    check_bodies_still(rig, scene, recordings)
    np.testing.assert_allclose(scene_error_ratios(rig, scene, recordings), 1.0, atol=0.15)


@pytest.mark.full
def test_a_wrong_lens_is_no_change_of_the_scene():
    """Ten images alike hide it in a scene of their own."""
    rig, (first, second) = moved_between([0.0, 0.0, 0.0], noiseless=False)

    def wrong(p: Parameter) -> Parameter:
        assert p.value is not None
        return dataclasses.replace(p, value=0.8 * p.value)

    cameras = tuple(dataclasses.replace(c, distortion=wrong(c.distortion)) for c in rig.cameras)
    rig = rig.with_(cameras=cameras)
    bodies, recordings = chosen(rig, [first, images(second, 10)])
    check_bodies_still(rig, find_scene(rig, bodies, recordings), recordings)


@pytest.mark.full
def test_of_three_recordings_the_one_that_was_changed_is_named():
    rig, (old, new) = moved_between([0.0, 0.02, 0.03], noiseless=False)
    third = dataclasses.replace(simulate(tag_map(8.0), 2).measurements, name="third")
    bodies, recordings = chosen(rig, [old, new, third])
    with pytest.raises(EstimationError, match="^new: the poses of the targets relative to each other"):
        check_bodies_still(rig, find_scene(rig, bodies, recordings), recordings)


def test_tags_that_no_image_ties_to_the_others_are_left_out_and_named():
    simulation = simulate(tag_map(8.0, noiseless=True), 0)
    tags = simulation.scenario.target.body

    def wanted(point: np.ndarray) -> np.ndarray:
        alone = tags[point] == 5
        return ~alone

    measurements = seen_only(simulation.measurements, wanted)
    only = seen_only(simulation.measurements, lambda q: ~wanted(q))
    first = only.cameras[0]
    stamps = first.stamps_ns + np.int64(1_000)  # images of their own
    merged = merge(measurements.cameras[0], dataclasses.replace(first, stamps_ns=stamps))
    measurements = measurements.with_streams(merged, measurements.cameras[1])
    result = calibrate_measurements(free(simulation.scenario), measurements)
    left_out = simulation.scenario.target.bodies[5]
    assert left_out not in result.bodies
    assert any(left_out in note for note in result.notes if note.name.startswith("bodies_"))
    assert max(camera_errors(result, simulation, "cam0")) < 1e-7


def merge(a: CornerStream, b: CornerStream) -> CornerStream:
    """The images of both, by stamp."""
    stamps = np.concatenate([a.stamps_ns, b.stamps_ns])
    order = np.argsort(stamps)
    parts = [(s.point[i:j], s.uv[i:j]) for s in (a, b) for i, j in pairwise(s.start.tolist())]
    rows = [parts[k] for k in order]
    start = np.concatenate([[0], np.cumsum([len(p) for p, _ in rows])])
    return CornerStream(
        a.name, stamps[order], start, np.concatenate([p for p, _ in rows]), np.concatenate([uv for _, uv in rows])
    )


def test_the_size_of_tags_shows_against_the_imu():
    simulation = simulate(tag_map(8.0), 0)
    rig = rig_for(simulation.scenario)
    small = dataclasses.replace(simulation.scenario.target, size=0.12)
    with pytest.raises(EstimationError, match=r"times as large as in the rig file"):
        calibrate_measurements(dataclasses.replace(rig, target=small), simulation.measurements)


@pytest.mark.full
@pytest.mark.parametrize("with_grid", [False, True], ids=["tags", "tags and a grid"])
def test_a_few_recordings_are_consistent(consistency, with_grid: bool):
    scenario = tag_map(8.0, with_grid=with_grid)
    rig = rig_for(scenario, intrinsics="start", distortion="start")
    found = consistency(scenario, rig, range(5), 0.9999)
    assert {block: c for block, c in found.items() if not c.consistent} == {}


@pytest.mark.full
def test_fifty_recordings_are_consistent(consistency):
    scenario = tag_map(10.0, with_grid=True)
    assert isinstance(scenario.target, Scene)
    found = consistency(scenario, free(scenario), range(50), 0.95)
    print({block: (round(c.mean, 3), round(c.low, 3), round(c.high, 3)) for block, c in found.items()})
    assert {block: c for block, c in found.items() if not c.consistent} == {}
