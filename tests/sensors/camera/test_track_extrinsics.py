"""Cameras that follow points, placed on a known motion: against the simulated truth, which shares no code with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each
from tests.typed import not_none

from icalib.errors import EstimationError
from icalib.estimate.inputs import inputs_for
from icalib.geometry.cameras import camera_model
from icalib.initialize.initializer import joined_states
from icalib.motion.imu_data import ImuData
from icalib.optim.state import State
from icalib.rig import Parameter
from icalib.sensors.camera.initialize import track_camera_values
from icalib.sensors.camera.initialize.epipolar import MIN_POINT_RANGE_M, _ray_errors, ray_derivatives
from icalib.tools.simulation import Drive, load_scenario, rig_for, simulate, with_drawn_guess

pytestmark = pytest.mark.slow

PAPER = Path(__file__).parents[3] / "examples" / "paper"
STIFF = np.zeros((0, 1, 3)), np.zeros((0, 1, 3)), np.zeros(0)  # a lens that nothing bends


def drive(example="table2-planar", cameras=1, seed=1, noise_px=0.0, duration_s=20.0, set_back_s=0, **changes):
    """A recording of cameras alone, their clocks set back, and the state that is its truth."""
    scenario = load_scenario(PAPER / f"{example}.yaml")
    own = tuple(
        replace(c, corner_noise_px=noise_px, clock_origin_ns=c.clock_origin_ns - set_back_s * 10**9)
        for c in scenario.cameras[:cameras]
    )
    scenario = replace(scenario, duration_s=duration_s, cameras=own, sensors=(), **changes)
    simulation = simulate(scenario, seed)
    truth = simulation.truth
    imu = ImuData.build(not_none(simulation.measurements.imu), scenario.imu_noise)
    keyframes = np.arange(0.0, imu.seconds[-1], 0.05)
    bias = np.concatenate([truth.gyro_bias.mean(axis=0), truth.accel_bias.mean(axis=0)])
    poses = truth.pose_at(keyframes + truth.seconds[0])
    return simulation, State(
        keyframes, *poses, np.tile(bias, (len(keyframes), 1)), {("imu0", "intrinsics"): np.zeros(24)}
    )


def placed(simulation, state, rig):
    return track_camera_values(inputs_for(rig, [simulation.measurements]), state)


def true_rig(simulation):
    """All of the lenses known, nothing of where the cameras are."""
    return rig_for(simulation.scenario)


def errors(simulation, values, name):
    """Rotation [deg] and lever arm [m] in the axes of the IMU, time offset [s]."""
    truth, measured = simulation.truth, simulation.measurements
    T, stream = truth.T_imu_sensor[name], next(s for s in measured.tracks if s.name == name)
    turn = Rotation.from_matrix(values[name, "rotation"] @ T[:3, :3].T).as_rotvec(degrees=True)
    between = 1e-9 * (stream.origin_ns - measured.origin_ns)
    offset = values[name, "time_offset"][0] - between - truth.time_offset[name]
    return turn, values[name, "translation"] - T[:3, 3], offset


@each("example", ["table2-3d", "table2-planar"], full=["table2-ramp"])
def test_a_camera_with_a_known_lens_is_found_where_it_is(example):
    simulation, state = drive(example)
    turn, arm, offset = errors(simulation, placed(simulation, state, true_rig(simulation)), "cam0")
    seen = 2 if example == "table2-planar" else 3  # on a floor nothing shows how high the camera is
    assert np.abs(turn).max() < 0.005
    assert np.abs(arm[:seen]).max() < 1e-3
    assert abs(offset) < 5e-5


@each("example", ["table2-3d", "table2-planar"], full=["table2-ramp"])
def test_a_rough_lens_is_found_with_the_camera(example):
    """A focal length guessed to 3 %, no distortion, where it is -0.28; the principal point is not sought."""
    simulation, state = drive(example, cameras=3, noise_px=1.0)
    scenario = simulation.scenario
    guessed = with_drawn_guess(rig_for(scenario, intrinsics="free", distortion="free"), scenario, 3)
    nothing = Parameter("free")
    cameras = tuple(replace(c, rotation=nothing, translation=nothing, time_offset=nothing) for c in guessed.cameras)
    values = placed(simulation, state, guessed.with_sensors(*cameras))
    for camera in cameras:
        turn, arm, offset = errors(simulation, values, camera.name)
        assert np.abs(turn).max() < 2.5
        assert np.abs(arm[:2]).max() < 0.15
        assert abs(arm[2]) < 0.5  # nothing shows it on a floor: it stays where lever arms are
        assert abs(offset) < 0.01
        focal = values[camera.name, "intrinsics"][:2] / simulation.truth.values[camera.name]["intrinsics"][:2]
        assert np.abs(focal - 1.0).max() < 0.05
    assert abs(values["cam0", "distortion"][0] - simulation.truth.values["cam0"]["distortion"][0]) < 0.06


def test_what_the_rig_gives_stays():
    simulation, state = drive()
    rig = true_rig(simulation)
    T = simulation.truth.T_imu_sensor["cam0"]
    rotation = Parameter("fixed", T[:3, :3] @ Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix())
    arm = Parameter("free", T[:3, 3] + [0.0, 0.0, 0.02])
    given = rig.with_(cameras=(replace(rig.cameras[0], rotation=rotation, translation=arm),))
    values = placed(simulation, state, given)
    np.testing.assert_array_equal(values["cam0", "rotation"], rotation.value)
    np.testing.assert_array_equal(values["cam0", "translation"], arm.value)
    assert abs(errors(simulation, values, "cam0")[2]) < 0.02


@pytest.mark.parametrize("restarts", [True, pytest.param(False, marks=pytest.mark.full)])
def test_of_several_recordings_one_shows_how_the_camera_stands(restarts):
    """And each the offset of a clock that was set back between them."""
    drives = drive(duration_s=12.0), drive(seed=2, set_back_s=37 if restarts else 0)
    rig = true_rig(drives[0][0])
    rig = rig.with_(cameras=(replace(rig.cameras[0], clock_restarts=restarts),))
    inputs = inputs_for(rig, [simulation.measurements for simulation, _ in drives])
    state = joined_states(inputs, [s for _, s in drives], drives[0][1].values)
    values = track_camera_values(inputs, state)
    T = drives[0][0].truth.T_imu_sensor["cam0"]
    turn = Rotation.from_matrix(values["cam0", "rotation"] @ T[:3, :3].T).magnitude()
    assert np.rad2deg(turn) < 0.005
    assert np.abs(values["cam0", "translation"] - T[:3, 3])[:2].max() < 1e-3
    measured = inputs.measurements
    offset = values["cam0", "time_offset"] - 1e-9 * (measured.tracks[0].origin_ns - measured.origin_ns)
    true = [simulation.truth.time_offset["cam0"] for simulation, _ in drives]
    np.testing.assert_allclose(offset, true if restarts else true[:1], atol=5e-5)


def test_tracks_of_another_drive_do_not_fit():
    simulation, _ = drive()
    _, other = drive(seed=2)
    with pytest.raises(EstimationError, match="cam0: its feature tracks contradict the motion of the other sensors"):
        placed(simulation, other, true_rig(simulation))


def test_a_camera_whose_image_stands_still_does_not_fit():
    simulation, state = drive()
    stream, measured = simulation.measurements.tracks[0], simulation.measurements
    _, first, which = np.unique(stream.feature, return_index=True, return_inverse=True)
    frozen = measured.with_streams(replace(stream, uv=stream.uv[first[which]]))
    with pytest.raises(EstimationError, match="contradict the motion of the other sensors"):
        placed(replace(simulation, measurements=frozen), state, true_rig(simulation))


def lost_after(simulation, seconds):
    """Each point is another one then."""
    stream, measured = simulation.measurements.tracks[0], simulation.measurements
    lost = stream.feature * 1000 + (stream.seconds / seconds).astype(np.int64)[stream.image]
    return replace(simulation, measurements=measured.with_streams(replace(stream, feature=lost)))


def test_points_that_are_soon_lost_show_the_camera_over_shorter_steps():
    simulation, state = drive()
    turn, arm, offset = errors(simulation, placed(lost_after(simulation, 0.45), state, true_rig(simulation)), "cam0")
    assert np.abs(turn).max() < 0.02
    assert np.abs(arm[:2]).max() < 3e-3
    assert abs(offset) < 2e-4


def test_points_that_are_lost_after_an_image_show_nothing():
    simulation, state = drive()
    with pytest.raises(
        EstimationError, match="cam0: only .* pairs of images 0.5 s or more apart share enough tracked points"
    ):
        placed(lost_after(simulation, 0.05), state, true_rig(simulation))


def test_points_followed_at_random_do_not_fit_a_lens_without_bounds():
    simulation, state = drive()
    stream, measured = simulation.measurements.tracks[0], simulation.measurements
    anywhere = np.random.default_rng(0).uniform([0.0, 0.0], [752.0, 480.0], stream.uv.shape)
    random = measured.with_streams(replace(stream, uv=anywhere))
    rig = rig_for(simulation.scenario, intrinsics="start", distortion="free")
    with pytest.raises(EstimationError, match="contradict the motion of the other sensors"):
        placed(replace(simulation, measurements=random), state, rig)


def test_a_robot_that_goes_nowhere_does_not_show_how_the_camera_is_turned():
    simulation, state = drive(motion=Drive("spin"))
    with pytest.raises(EstimationError, match="cam0: the motion does not determine its rotation"):
        placed(simulation, state, true_rig(simulation))


def test_rays_that_meet_before_both_cameras_miss_nothing():
    rng = np.random.default_rng(0)
    R = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    b = np.array([0.4, -0.1, 0.2])
    points = rng.normal(size=(50, 3)) + [0.0, 0.0, 4.0]  # seen from the second camera
    f, h = (points - b) @ R, points / np.linalg.norm(points, axis=1)[:, None]
    f /= np.linalg.norm(f, axis=1)[:, None]
    e, begin = np.empty(50), np.array([0, 50])
    _ray_errors(f, h, *STIFF, begin, R[None], b[None], e)
    assert np.abs(e).max() < 1e-12
    # The other way they meet behind, and the angle between them counts.
    _ray_errors(f, h, *STIFF, begin, R[None], -b[None], e)
    angle = np.linalg.norm(np.cross(f @ R.T, h), axis=1)
    np.testing.assert_allclose(e, np.sqrt(0.5) * angle, atol=1e-12)
    _ray_errors(f, h, *STIFF, begin, R[None], 1e-3 * b[None], e)  # a way a thousandth as long: some meet too near
    np.testing.assert_allclose(
        e, np.sqrt(0.5) * np.maximum(angle - 1e-3 * np.linalg.norm(b) / MIN_POINT_RANGE_M, 0.0), atol=1e-9
    )


def test_a_ray_misses_by_its_own_error_across_the_plane_of_both():
    R, b = np.eye(3), np.array([1.0, 0.0, 0.0])
    point, by = np.array([0.5, 0.0, 3.0]), 1e-3
    f, h = point - b, point + np.array([0.0, by * np.linalg.norm(point), 0.0])
    f, h = f / np.linalg.norm(f), h / np.linalg.norm(h)
    e = np.empty(1)
    _ray_errors(f[None], h[None], *STIFF, np.array([0, 1]), R[None], b[None], e)
    # Both rays could be off: of two alike the error is shared, by the root of the sum of what each tells.
    across = np.sin(np.arccos(f[0])) ** 2 + np.sin(np.arccos(h[0])) ** 2
    assert abs(abs(e[0]) / by * np.sqrt(across) / np.sin(np.arccos(f[0])) - 1.0) < 1e-3


def test_a_bent_lens_moves_rays_along_their_slopes():
    rng = np.random.default_rng(1)
    f, h, f_by, h_by = (rng.standard_normal(shape) for shape in ((20, 3), (20, 3), (2, 20, 3), (2, 20, 3)))
    bent, begin, R, b = np.array([0.3, -0.2]), np.array([0, 12, 20]), np.stack([np.eye(3)] * 2), np.ones((2, 3))
    once, other = np.empty(20), np.empty(20)
    _ray_errors(f, h, f_by, h_by, bent, begin, R, b, once)
    _ray_errors(f + np.tensordot(bent, f_by, 1), h + np.tensordot(bent, h_by, 1), *STIFF, begin, R, b, other)
    np.testing.assert_allclose(once, other, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "distortion"),
    [("pinhole-radtan", [-0.28, 0.07, 2e-4, -1e-4]), ("pinhole-equidistant", [-0.01, 0.02, -0.01, 3e-3])],
)
def test_slopes_of_rays_are_those_of_the_rays_of_another_lens(name: str, distortion: list[float]):
    """The last pixel is one that was not seen."""
    model, lens = camera_model(name), np.array([458.0, 457.0, 367.0, 248.0, *distortion])
    rng, directions, h = np.random.default_rng(0), np.zeros((2, 8)), 1e-5
    directions[0, :2], directions[1, 4] = lens[:2], 0.3
    uv = np.vstack([rng.uniform([100, 60], [640, 430], (200, 2)), [np.nan, np.nan]])
    rays, valid = model.unproject(lens, uv)
    assert valid[:-1].all() and not valid[-1]
    slopes = ray_derivatives(model, lens, directions, np.where(valid[:, None], rays, 0.0))
    for direction, found in zip(directions, slopes, strict=True):
        (up, _), (down, _) = (model.unproject(lens + d * direction, uv[:-1]) for d in (h, -h))
        np.testing.assert_allclose(found[:-1], (up - down) / (2.0 * h), atol=1e-8)
        np.testing.assert_array_equal(found[-1], 0.0)
