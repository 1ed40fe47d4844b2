"""Where keyframes stand: at images, filled in between, none in long gaps."""

import numpy as np
from tests.cases import each

from icalib.data.measurements import ImuStream
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import place_keyframes, usable
from icalib.rig import ImuNoise


def imu_at(seconds):
    n = len(seconds)
    rng = np.random.default_rng(0)
    stream = ImuStream(
        "imu0", np.round(np.asarray(seconds) * 1e9).astype(np.int64), rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    )
    return ImuData.build(stream, ImuNoise(1e-3, 1e-5, 1e-2, 1e-4))


STEADY = np.arange(401) / 200.0


def without(seconds, start, end):
    return seconds[(seconds <= start) | (seconds >= end)]


def test_images_within_2_ms_share_the_earlier_one():
    times = [np.array([0.1, 0.15, 0.2]), np.array([0.1019, 0.1521, 0.2])]
    keyframes = place_keyframes(imu_at(STEADY), times, spacing=0.1, max_gap=0.5)
    np.testing.assert_array_equal(keyframes, [0.1, 0.15, 0.1521, 0.2])


def test_order_of_cameras_does_not_matter():
    a, b = np.array([0.1, 0.2, 0.3]), np.array([0.125, 0.225])
    imu = imu_at(STEADY)
    np.testing.assert_array_equal(place_keyframes(imu, [a, b], 0.05, 0.5), place_keyframes(imu, [b, a], 0.05, 0.5))


def test_long_stretches_are_filled_evenly_and_all_images_are_keyframes():
    images = np.array([0.1, 0.15, 0.38, 0.48, 1.0])
    keyframes = place_keyframes(imu_at(STEADY), [images], spacing=0.05, max_gap=0.5)
    assert np.isin(images, keyframes).all()
    counts = np.histogram(keyframes, images)[
        0
    ]  # keyframes from each image to before the next; the last keyframe counts too
    np.testing.assert_array_equal(counts, [1, 5, 2, 12])
    for a, b in zip(images[:-1], images[1:], strict=True):
        steps = np.diff(keyframes[(keyframes >= a) & (keyframes <= b)])
        np.testing.assert_allclose(steps, steps[0], rtol=1e-9)


@each(("distance", "steps"), [(0.04, 1), (0.0545, 1), (0.0555, 2), (0.104, 2), (0.106, 3)])
def test_jitter_of_a_tenth_of_the_spacing_needs_no_keyframe(distance, steps):
    keyframes = place_keyframes(imu_at(STEADY), [np.array([0.1, 0.1 + distance])], spacing=0.05, max_gap=0.5)
    assert len(keyframes) == 1 + steps
    assert np.diff(keyframes).max() <= 1.1 * 0.05


def test_images_outside_the_recording_have_no_keyframe():
    keyframes = place_keyframes(imu_at(STEADY), [np.array([-0.1, 0.0, 0.05, 2.0, 2.01])], 3.0, 0.5)
    np.testing.assert_array_equal(keyframes, [0.0, 0.05, 2.0])


def test_short_gaps_are_filled():
    imu = imu_at(without(STEADY, 0.5, 0.8))
    np.testing.assert_allclose(imu.gaps, [(0.5, 0.8)])
    images = np.arange(0.1, 1.0, 0.1)
    keyframes = place_keyframes(imu, [images], spacing=0.05, max_gap=0.5)
    assert np.isin(images, keyframes).all()
    assert np.diff(keyframes).max() <= 0.05 + 1e-9


def test_long_gaps_hold_no_keyframe():
    imu = imu_at(without(STEADY, 0.5, 1.3))
    images = np.arange(0.1, 1.6, 0.1)
    keyframes = place_keyframes(imu, [images], spacing=0.05, max_gap=0.5)
    assert not ((keyframes > 0.5 + 1e-9) & (keyframes < 1.3 - 1e-9)).any()
    assert keyframes[0] == images[0] and keyframes[-1] == images[-1]
    # Up to the gap and after it the spacing holds, but for the ends towards the gap.
    assert np.sort(np.diff(keyframes))[-2] <= 0.05 + 1e-9


def test_usable_is_what_lies_inside_the_recording_and_outside_long_gaps():
    times = np.array([-1e-3, 0.0, 0.3, 0.5, 0.6, 1.2, 1.3, 2.0, 2.1])
    imu = imu_at(without(STEADY, 0.5, 1.3))
    np.testing.assert_array_equal(usable(imu, times, 0.5), [False, True, True, True, False, False, True, True, False])
    np.testing.assert_array_equal(usable(imu, times, 1.0), [False, True, True, True, True, True, True, True, False])
