"""Recordings joined: stamps, keyframes, the chain's seams, tilts of each board."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from tests.cases import each
from tests.typed import not_none

from icalib.data.measurements import PAUSE_NS, Measurements, join
from icalib.data.recordings import naming, open_all
from icalib.errors import RecordingError
from icalib.estimate.inputs import inputs_for
from icalib.estimate.problem import assemble
from icalib.estimate.residual_statistics import segment_ends
from icalib.geometry import so3
from icalib.motion.factor import of_type
from icalib.motion.poses import first_keyframes, place_keyframes, usable
from icalib.optim.state import KEYFRAME_DIM, State
from icalib.rig import Rig
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.corner_noise import NoiseModel
from icalib.sensors.camera.initialize import initial_guesses, initial_state
from icalib.sensors.camera.model import MODEL
from icalib.sensors.imu.residual import ImuFactor
from icalib.sensors.parameter import fixed
from icalib.tools.simulation import handheld, rig_for, simulate

DAY_NS = 86_400 * 10**9


@pytest.fixture(scope="module")
def rig() -> Rig:
    return rig_for(handheld(6.0))


@pytest.fixture(scope="module")
def recordings() -> list[Measurements]:
    """Two, of which the camera's clocks and the IMU's have nothing in common, and the second was recorded first."""
    other = handheld(5.0)
    cameras = tuple(dataclasses.replace(c, clock_origin_ns=c.clock_origin_ns - DAY_NS) for c in other.cameras)
    origin = other.imu_clock_origin_ns - DAY_NS
    other = dataclasses.replace(other, cameras=cameras, imu_clock_origin_ns=origin)
    return [simulate(s, k).measurements for k, s in enumerate((handheld(6.0), other))]


def test_all_clocks_of_a_recording_are_shifted_alike(rig, recordings):
    joined, (first, second) = join(rig, recordings)
    assert first.shift_ns == 0
    for stream, part in zip((joined.imu, *joined.cameras), (None, 0, 1), strict=True):
        own = second.rows[not_none(stream).key]
        raw = recordings[1].imu if part is None else recordings[1].cameras[part]
        np.testing.assert_array_equal(not_none(stream).stamps_ns[own] - second.shift_ns, raw.stamps_ns)
        assert (np.diff(not_none(stream).stamps_ns) > 0).all()
        assert np.diff(not_none(stream).stamps_ns).max() > PAUSE_NS + 10 * 10**9
    for corners, a, b in zip(joined.cameras, *(m.cameras for m in recordings), strict=True):
        np.testing.assert_array_equal(corners.uv, np.concatenate([a.uv, b.uv]))
        np.testing.assert_array_equal(corners.image[len(a.uv) :], b.image + len(a.stamps_ns))
    assert second.begin == pytest.approx(
        (second.measurements.origin_ns + second.shift_ns - first.measurements.origin_ns) * 1e-9
    )


def test_a_single_recording_stays_as_it_is(rig, recordings):
    joined, parts = join(rig, recordings[:1])
    assert joined is recordings[0]
    assert [(p.shift_ns, p.begin) for p in parts] == [(0, 0.0)]


def test_streams_that_outlast_each_other_stay_apart(rig, recordings):
    """The cameras of the first run on for a minute; whatever the time offset, its images lie before the second's."""
    first, second = recordings
    late = first.with_streams(*(dataclasses.replace(c, stamps_ns=c.stamps_ns * 1) for c in first.cameras))
    for c in late.cameras:
        c.stamps_ns[-1] += 60 * 10**9
    joined, parts = join(rig, [late, second])
    for offset_ns in (0, 30 * 10**9):
        images = joined.cameras[0].stamps_ns[parts[0].rows["cam0"]] + offset_ns
        assert images.max() < second.imu.stamps_ns[0] + parts[1].shift_ns


def test_without_an_imu_given_offsets_keep_recordings_apart(rig, recordings):
    cameras = (rig.cameras[0], dataclasses.replace(rig.cameras[1], time_offset=fixed(np.array([500.0]))))
    alone = [m.without("imu0") for m in recordings]
    joined, parts = join(rig.with_(imu=None, cameras=cameras), alone)
    before = joined.cameras[1].stamps_ns[parts[0].rows["cam1"]] + 500 * 10**9
    assert before.max() < joined.cameras[0].stamps_ns[parts[1].rows["cam0"]].min()


def test_keyframes_and_images_stay_off_the_seam(rig, recordings):
    inputs = inputs_for(rig, recordings)
    imu = inputs.imu
    ((end, begin),) = not_none(imu).seams
    assert not_none(imu).gaps == ()
    times = np.array([end - 0.5, end - 0.4, end + 1.0, begin - 1.0, begin + 0.4, begin + 0.5])
    np.testing.assert_array_equal(usable(not_none(imu), times, 1e9), [True, True, False, False, True, True])
    keyframes = place_keyframes(not_none(imu), [times], 0.05, 1e9)
    k = first_keyframes(imu, keyframes)[1]
    np.testing.assert_allclose(keyframes, [end - 0.5, end - 0.45, end - 0.4, begin + 0.4, begin + 0.45, begin + 0.5])
    assert k == 3


@pytest.fixture(scope="module", params=["plain", "real corners"])
def problem(rig, recordings, request):
    """Two recordings at their first guess; with bloom, a bent board and a common error of each image, or without."""
    real = request.param != "plain"
    settings = dataclasses.replace(rig.settings, bloom=real, board_shape=real, common_error=real, blur_noise=real)
    inputs = inputs_for(dataclasses.replace(rig, settings=settings), recordings)
    state = initial_state(inputs, *initial_guesses(rig, inputs.bodies, recordings))
    if real:
        state.values["board0", "shape"][:] = 1e-3
    models = [NoiseModel(0.2, tau=0.1 if real else 0.0) for _ in rig.cameras]
    streams, noise = inputs.measurements.cameras, MODEL.first_noise(rig.cameras, rig, inputs.measurements)
    for c, m, s in zip(rig.cameras, models, streams, strict=True):
        noise[c.name] = dataclasses.replace(noise[c.name], corners=m.noise(s, settings))
    return assemble(inputs, state, noise), state


def test_nothing_is_known_across_the_seam(problem):
    built, state = problem
    chain = built.chain
    assert isinstance(chain, ImuFactor)
    k = state.starts[1]
    W = chain.increments.W
    assert not W[k - 1].any() and W[k - 2].any() and W[k].any()
    pieces, out = built.pieces(), built.residuals()
    built.linearise(state, pieces, out)
    piece = next(p for p in pieces if p.first < k <= p.last)
    assert not piece.upper[k - 1 - piece.first].any()
    assert not out[chain.key].residual[k - 1].any()
    for camera in of_type(built.factors, CornerFactor):
        assert len(camera.seams) == 1
        m = camera.seams[0]
        assert camera.keyframe[m - 1] < k <= camera.keyframe[m]


def test_the_gradient_is_that_of_the_cost(problem):
    """Border and chain, over both recordings: central differences of half the chi^2."""
    built, state = problem
    rng = np.random.default_rng(0)
    pieces, out = built.pieces(), built.residuals()
    built.linearise(state, pieces, out)
    chain_gradient = np.zeros((built.n_keyframes, KEYFRAME_DIM))
    for p in pieces:
        chain_gradient[p.first : p.last + 1] += p.side[:, :, -1]
    calib_gradient = sum(p.calib[:-1, -1] for p in pieces)
    for tilted in (False, True):
        chain = (
            rng.normal(size=(built.n_keyframes, KEYFRAME_DIM))
            * np.repeat([1e-3, 1e-3, 1e-3, 1e-4, 1e-3], 3)
            * (not tilted)
        )
        calib = np.zeros(built.layout.size)
        for b in built.layout.free:
            if (b.name == "tilt") == tilted:
                calib[b.columns] = 1e-4 * rng.normal(size=b.size)
        slope = float((chain_gradient * chain).sum() + calib_gradient @ calib)
        h = 1e-4
        up, down = (
            built.linearise(state.retract(built.layout, s * chain, s * calib), pieces, out, sums=False) for s in (h, -h)
        )
        assert (up - down) / (2.0 * h) == pytest.approx(slope, rel=1e-5)


def test_a_tilt_turns_its_own_recording(problem):
    built, state = problem
    calib = np.zeros(built.layout.size)
    calib[built.layout.block("board0 in recording 2", "tilt").columns] = [0.1, -0.2]
    Q, k = so3.exp(np.array([0.1, -0.2, 0.0])), state.starts[1]
    # A turn as a whole is what the keyframes' own steps are counted from.
    chain = np.zeros((len(state.seconds), KEYFRAME_DIM))
    turn = np.array([0.1, -0.2, 0.0])
    chain[k:, 0:3], chain[k:, 3:6] = turn @ state.rotation[k:], np.cross(turn, state.position[k:])
    moved = state.retract(built.layout, chain, calib)
    np.testing.assert_array_equal(moved.rotation[:k], state.rotation[:k])
    np.testing.assert_array_equal(moved.position[:k], state.position[:k])
    np.testing.assert_allclose(moved.rotation[k:], Q @ state.rotation[k:], atol=1e-14)
    np.testing.assert_allclose(moved.position[k:], state.position[k:] @ Q.T, atol=1e-14)
    np.testing.assert_array_equal(moved.values["board0", "tilt"], state.values["board0", "tilt"])


def test_a_state_knows_its_recordings():
    zeros = np.zeros((7, 3))
    state = State(np.arange(7.0), zeros, zeros, zeros, zeros, {}, (0, 3, 5))
    assert state.recordings == [slice(0, 3), slice(3, 5), slice(5, 7)]


@each(
    ("starts", "n", "segments", "expected"),
    [
        ((0,), 101, 4, [0, 25, 50, 75, 100]),
        ((0, 51), 101, 4, [0, 25, 51, 75, 100]),
        ((0, 81), 101, 4, [0, 27, 54, 81, 100]),
        ((0, 40, 50), 101, 2, [0, 40, 50, 100]),
    ],
)
def test_segments_end_where_recordings_do(starts, n, segments, expected):
    np.testing.assert_array_equal(segment_ends(starts, n, segments), expected)


def test_recordings_are_named_by_folder_or_path(tmp_path):
    for name in ("a/imu0", "b/imu0", "c/d/a/imu0"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "data.csv").write_text("")
    paths = [tmp_path / "a", tmp_path / "b", tmp_path / "c/d/a"]
    assert list(open_all(paths)) == [str(paths[0]), "b", str(paths[2])]
    assert list(open_all(paths[1])) == ["b"]
    reader = next(iter(open_all(paths[1]).values()))
    assert open_all([reader, paths[0]]).keys() == {"recording 1", "a"}
    with pytest.raises(RecordingError, match="b is given twice; give each recording once"):
        open_all([paths[1], str(paths[1])])
    with pytest.raises(RecordingError, match="no recording was given"):
        open_all([])


def test_errors_begin_with_the_recording():
    with pytest.raises(RecordingError, match=r"^evening: no corners\.$"), naming("evening"):
        raise RecordingError("no corners.")
    with pytest.raises(RecordingError, match=r"^evening/cam0: no corners\.$"), naming("evening"):
        raise RecordingError("evening/cam0: no corners.")
    with pytest.raises(RecordingError, match=r"^a: at 3 ns a corner is missing\.$"), naming("a"):
        raise RecordingError("at 3 ns a corner is missing.")
    with pytest.raises(RecordingError, match=r"^no corners\.$"), naming(""):
        raise RecordingError("no corners.")
