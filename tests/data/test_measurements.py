"""Streams refuse arrays that do not belong together."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import CornerStream, LidarStream, TrackStream, WheelPoses, WheelStream
from icalib.errors import RecordingError

STAMPS = np.array([10, 20, 40], dtype=np.int64)
START = np.array([0, 2, 2, 5], dtype=np.int64)
GOOD = {
    CornerStream: {"start": START, "point": np.arange(5), "uv": np.zeros((5, 2)), "sigma": np.ones(5)},
    TrackStream: {"start": START, "feature": np.arange(5), "uv": np.zeros((5, 2))},
    LidarStream: {
        "start": START,
        "offset_s": np.zeros(5, np.float32),
        "xyz": np.zeros((5, 3), np.float32),
        "plane": np.zeros(5, np.int32),
    },
    WheelStream: {"rate": np.zeros((3, 2))},
    WheelPoses: {"pose": np.zeros((2, 3)), "covariance": np.zeros((2, 3, 3))},
}
BAD = [
    (CornerStream, "sigma", np.ones(4), "sigma must be positive, one for each of the 5 corners or none"),
    (CornerStream, "sigma", np.array([1.0, 1.0, 0.0, 1.0, 1.0]), "sigma must be positive"),
    (TrackStream, "start", START[1:], "shape \\(4,\\)"),
    (TrackStream, "start", np.array([0, 2, 1, 5]), "run upwards"),
    (TrackStream, "start", np.array([1, 2, 2, 5]), "from 0"),
    (TrackStream, "feature", np.arange(4), "feature must have a row for each of the 5 observations, not 4"),
    (TrackStream, "feature", np.arange(5.0), "int64"),
    (TrackStream, "uv", np.zeros((5, 3)), "\\(N, 2\\)"),
    (LidarStream, "xyz", np.zeros((5, 2), np.float32), "\\(N, 3\\)"),
    (LidarStream, "xyz", np.zeros((5, 3)), "xyz must be float32"),
    (LidarStream, "offset_s", np.zeros(5), "offset_s must be float32"),
    (LidarStream, "plane", np.zeros(4, np.int32), "plane must have a row for each of the 5 points"),
    (LidarStream, "plane", np.zeros(5, np.int64), "int32"),
    (WheelStream, "rate", np.zeros((2, 2)), "\\(3, 2\\)"),
    (WheelPoses, "pose", np.zeros((3, 3)), "\\(2, 3\\)"),
    (WheelPoses, "covariance", np.zeros((2, 3)), "\\(2, 3, 3\\)"),
]


@each("kind", GOOD)
def test_seconds_count_from_the_first_stamp(kind):
    stream = kind("a", STAMPS, **GOOD[kind])
    assert stream.origin_ns == 10
    np.testing.assert_allclose(stream.seconds, [0.0, 1e-8, 3e-8])
    if kind is TrackStream:
        np.testing.assert_array_equal(stream.image, [0, 0, 2, 2, 2])


@each(("kind", "field", "value", "words"), BAD)
def test_what_does_not_belong_together_is_refused(kind, field, value, words):
    with pytest.raises(RecordingError, match=words):
        kind("a", STAMPS, **GOOD[kind] | {field: value})
    with pytest.raises(RecordingError, match="int64 nanoseconds"):
        kind("a", STAMPS.astype(float), **GOOD[kind])


@pytest.mark.parametrize("stated", [True, False])
def test_corners_that_are_chosen_keep_their_sigma(stated):
    sigma = np.array([0.02, 0.03, 0.06, 0.03, 0.1]) if stated else np.zeros(0)
    uv = np.arange(10.0).reshape(5, 2)
    stream = CornerStream("cam0", STAMPS, START, np.arange(5), uv, sigma=sigma)
    np.testing.assert_allclose(stream.relative_sigma, sigma / 0.03 if stated else np.ones(5))
    chosen = stream.of_rows(np.array([0, 3, 4]), STAMPS[[0, 2]], np.array([1, 2]))
    assert chosen.start.tolist() == [0, 1, 3] and chosen.point.tolist() == [0, 3, 4]
    np.testing.assert_array_equal(chosen.uv, uv[[0, 3, 4]])
    np.testing.assert_array_equal(chosen.sigma, sigma[[0, 3, 4]] if stated else [])
