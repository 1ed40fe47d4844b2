"""IMU and LiDAR together, points on known planes: what was put in comes out, and its standard deviations are honest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from tests.setups import RINGS
from tests.typed import not_none

from icalib.detection.planes import PlaneSearch, find_planes
from icalib.estimate.solver import minimise
from icalib.geometry import so3
from icalib.optim.state import make_layout
from icalib.sensors.lidar.binning import BIN_S, LidarNoise, in_world
from icalib.tools.simulation import simulate

pytestmark = pytest.mark.slow

PARTS = {"rotation": slice(0, 3), "translation": slice(3, 6), "time_offset": slice(6, 7)}
BEAM = LidarNoise(1e-3, 0.03)  # as simulated, and a little of what the model lacks where beams graze a plane


def errors(setup, state):
    """(7,) rotation, translation, time offset of the LiDAR: estimated minus true."""
    got, true = ([s.values["lidar0", n] for n in PARTS] for s in (state, setup.state))
    turn = so3.log(np.ascontiguousarray(true[0].T @ got[0]))
    return np.concatenate([turn, got[1] - true[1], got[2] - true[2]])


def covariance(setup, outcome):
    """(7, 7) all else marginalised."""
    s = setup.columns_scale()
    columns = setup.layout.columns("lidar0", *PARTS)
    scaled = np.linalg.inv(outcome.information * s[:, None] * s)
    return (scaled * s[:, None] * s)[np.ix_(columns, columns)]


def recover(setup, start, noise, passes, **options):
    """Each pass takes moments and preintegrates anew."""
    outcome = None
    for _ in range(passes):
        outcome = minimise(setup.problem(start, noise, **options), start)
        assert outcome.converged, outcome.status
        start = outcome.state
    return outcome


def test_noiseless_recovery(robot_scenario, room_of):
    """Bins are short, and readings dense: between two the simulated rate is constant and the estimator's linear, in the
    mean w' T^2 / 12 apart (at 300 Hz 6e-6 rad)."""
    scenario = robot_scenario(4.0, noiseless=True)
    scenario = replace(scenario, imu_rate_hz=8000.0, gyro_bias=(0.0,) * 3, accel_bias=(0.0,) * 3)
    setup = room_of(simulate(scenario, seed=1), spacing=5e-3)
    outcome = recover(setup, setup.perturbed(np.random.default_rng(2), 3.0), LidarNoise(0.03), 2, bin_s=1e-4)
    assert np.abs(errors(setup, not_none(outcome).state)).max() < 1e-8
    # The world stays where the solver found it, turned about gravity.
    back = so3.exp(
        so3.log(np.ascontiguousarray(setup.state.rotation[0] @ not_none(outcome).state.rotation[0].T)) * [0.0, 0.0, 1.0]
    )
    planes = [back @ not_none(outcome).state.values[k][:3] - setup.state.values[k][:3] for k in setup.planes]
    assert np.abs(planes).max() < 5e-8


def test_errors_of_rings_are_recovered_without_noise(robot_scenario, room_of):
    """0.2 deg twice and 2 cm RMS. Corrected points are float32, wrong by up to 6e-8 of their distance."""
    off = np.random.default_rng(5).standard_normal((3, 16)) * [[0.2], [0.02], [0.2]]
    off[1, 0] = 0.0  # of the rings, which all have as many points, the first has no offset of its own
    off[2] -= off[2].mean()  # which is a rotation of the LiDAR
    rings = {
        "elevation_errors_deg": tuple(off[0]),
        "ring_offsets_m": tuple(off[1]),
        "azimuth_errors_deg": tuple(off[2]),
    }
    scenario = robot_scenario(3.0, noiseless=True, azimuth_steps=600, **rings)
    scenario = replace(scenario, imu_rate_hz=8000.0, gyro_bias=(0.0,) * 3, accel_bias=(0.0,) * 3)
    setup = room_of(simulate(scenario, seed=1), spacing=5e-3, rings=True)
    outcome = not_none(recover(setup, setup.state, LidarNoise(0.03), 3, bin_s=1e-4))
    elevations, offsets, azimuths = (outcome.state.values["lidar0", name] for name in RINGS)
    assert np.abs(elevations - np.deg2rad(off[0])).max() < 1e-7
    assert np.abs(offsets - off[1]).max() < 1e-6
    assert np.abs(azimuths - np.deg2rad(off[2])).max() < 1e-6
    assert np.abs(errors(setup, outcome.state)).max() < 1e-6


def test_a_start_far_off_leads_to_the_same_place(robot_scenario, room_of):
    setup = room_of(simulate(robot_scenario(5.0), seed=2))
    near = recover(setup, setup.state, BEAM, 3)
    far = recover(setup, setup.perturbed(np.random.default_rng(0), 30.0), BEAM, 4)
    apart = np.abs(errors(setup, not_none(far).state) - errors(setup, not_none(near).state))
    assert (apart < 0.05 * np.sqrt(np.diag(covariance(setup, near)))).all()


def test_longer_bins_change_the_answer_little(robot_scenario, room_of):
    """Far less than its standard deviations, which stay."""
    setup = room_of(simulate(robot_scenario(5.0), seed=3))
    start = not_none(recover(setup, setup.state, BEAM, 2)).state
    short, long = (minimise(setup.problem(start, BEAM, bin_s=b), start) for b in (1e-3, BIN_S))
    std = np.sqrt(np.diag(covariance(setup, short)))
    assert (np.abs(errors(setup, long.state) - errors(setup, short.state)) < 0.1 * std).all()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance(setup, long))), std, rtol=0.01)


def test_gauge_changes_no_calibration(robot_scenario, room_of):
    """Another world, a first keyframe held elsewhere: the same errors, the same covariance."""
    setup = room_of(simulate(robot_scenario(3.0, azimuth_steps=600), seed=4))
    found = []
    for turn, move in ((0.0, 0.0), (2.0, 30.0)):
        Q, state = so3.exp(np.array([0.0, 0.0, turn])), setup.state
        planes = {k: np.concatenate([Q @ state.values[k][:3], Q @ state.values[k][3:] + move]) for k in setup.planes}
        state = replace(
            state,
            rotation=Q @ state.rotation,
            position=state.position @ Q.T + move,
            velocity=state.velocity @ Q.T,
            values=state.values | planes,
        )
        outcome = minimise(setup.problem(state, BEAM), state)
        assert outcome.converged
        np.testing.assert_allclose(outcome.state.position[0], state.position[0], atol=1e-3)
        found.append((errors(setup, outcome.state), covariance(setup, outcome)))
    std = np.sqrt(np.diag(found[0][1]))
    np.testing.assert_allclose(found[1][0], found[0][0], atol=0.02 * std.min(), rtol=0)
    np.testing.assert_allclose(found[1][1] / np.outer(std, std), found[0][1] / np.outer(std, std), atol=1e-2)


def check_nees(robot_scenario, room_of, name, seeds, probability):
    e, P = [], []
    for seed in seeds:
        setup = room_of(simulate(robot_scenario(10.0, example=name), seed))
        outcome = recover(setup, setup.perturbed(np.random.default_rng(seed), 2.0), BEAM, 2)
        e.append(errors(setup, not_none(outcome).state))
        P.append(covariance(setup, outcome))
    for part, own in (PARTS | {"all": slice(0, 7)}).items():
        nees = [x[own] @ np.linalg.solve(C[own, own], x[own]) for x, C in zip(e, P, strict=True)]
        dof = len(e) * (own.stop - own.start)
        low, high = chi2.ppf([0.5 - 0.5 * probability, 0.5 + 0.5 * probability], dof) / dof
        print(name, part, round(sum(nees) / dof, 3), round(low, 3), round(high, 3))
        assert low <= sum(nees) / dof <= high, part


@pytest.mark.full
@pytest.mark.parametrize("name", ["table2-3d", "table2-ramp"])
def test_a_few_recordings(robot_scenario, room_of, name):
    check_nees(robot_scenario, room_of, name, range(3), 0.9999)


@pytest.mark.full
@pytest.mark.parametrize("name", ["table2-3d", "table2-ramp"])
def test_fifty_recordings(robot_scenario, room_of, name):
    check_nees(robot_scenario, room_of, name, range(50), 0.99)


def test_planar_motion_leaves_the_translation_along_its_axis_open(robot_scenario, room_of):
    setup = room_of(simulate(robot_scenario(10.0, example="table2-planar"), seed=5))
    start = setup.perturbed(np.random.default_rng(5), 2.0)
    outcome = recover(setup, start, BEAM, 2)
    own = setup.layout.columns("lidar0", *PARTS)
    scale = setup.columns_scale()
    S = np.linalg.inv(covariance(setup, outcome)) * scale[own][:, None] * scale[own]
    value, vector = np.linalg.eigh(S)
    assert value[0] < 1e-3 and value[1] > 0.1
    vertical = setup.state.rotation.transpose(0, 2, 1)[:, :, 2].mean(axis=0)  # the axis that it turns about, in the IMU
    assert abs(vector[3:6, 0] @ vertical) > 0.99
    assert abs(errors(setup, not_none(outcome).state)[5] - errors(setup, start)[5]) < 0.05
    assert np.abs(errors(setup, not_none(outcome).state)[3:5]).max() < 0.01


def wrong_by_a_centimetre(setup, rng):
    """The truth with a trajectory off by 1 cm and 0.3 deg, slowly, and a LiDAR by 0.3 deg, 2 cm and 1 ms; no planes."""
    entries = [
        (b.sensor, b.name, b.kind, b.size, b.start is not None) for b in setup.layout.blocks if b.kind != "plane"
    ]
    seconds = setup.state.seconds
    chain = np.zeros((len(seconds), 15))
    for own, largest in ((slice(0, 3), 5e-3), (slice(3, 6), 1e-2)):
        wave = np.sin(2.0 * np.pi * rng.uniform(0.1, 0.6, 3) * seconds[:, None] + rng.uniform(0.0, 6.0, 3))
        chain[:, own] = wave * largest / np.sqrt(3.0)
    calib = np.concatenate([rng.normal(size=3) * 3e-3, rng.normal(size=3) * 1e-2, [1e-3]])
    return setup.state.retract(make_layout(entries), chain, calib), entries


def test_found_planes_do_nearly_as_well_as_known_ones(robot_scenario, room_of):
    """Planes and association made anew in three rounds, each with the trajectory of the last."""
    setup = room_of(simulate(robot_scenario(6.0, azimuth_steps=900), seed=7))
    huber = LidarNoise(0.03, loss="huber")
    known = recover(setup, setup.state, huber, 2)
    state, entries = wrong_by_a_centimetre(setup, np.random.default_rng(3))
    face = np.where(setup.plane >= 0, setup.plane, len(setup.planes))
    for size in (1.0, 0.3, 0.1):
        search = PlaneSearch(position_m=0.01 * size, angle_rad=0.01 * size)
        points, seen_from = in_world(setup.motion(state), setup.stream)
        found = find_planes(points, seen_from, search)
        plane = found.of_points(points, seen_from, search)
        keys = tuple((f"plane{q}", "plane") for q in range(len(found.planes)))
        layout = make_layout(entries + [(*key, "plane", 3, True) for key in keys])
        state = replace(state, values=state.values | dict(zip(keys, found.planes.copy(), strict=True)))
        outcome = minimise(replace(setup, layout=layout, planes=keys, plane=plane).problem(state, huber), state)
        assert outcome.converged
        state = outcome.state
    table = np.zeros((len(keys), len(setup.planes) + 1), dtype=int)
    np.add.at(table, (plane[plane >= 0], face[plane >= 0]), 1)
    assert table.max(axis=1).sum() > 0.998 * table.sum()
    std = np.sqrt(np.diag(covariance(setup, known)))
    assert (np.abs(errors(setup, state) - errors(setup, not_none(known).state)) < 1.0 * std).all()
