"""LiDARs and wheels of several recordings, one after the other."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import CornerStream, ImuStream, LidarStream, Measurements, WheelPoses, WheelStream, join
from icalib.errors import RecordingError
from icalib.rig import ImuNoise, ImuSensor, Lidar, Rig, Wheels, by_name

RIG = Rig(by_name(ImuSensor("imu0", "", ImuNoise(1e-4, 1e-5, 1e-3, 1e-4)), Lidar("lidar0", ""), Wheels("w", "")))


def recording(seed: int, origin_s: int, lidar_s: tuple[int, int], wheels_s: tuple[int, int] = (0, 10)) -> Measurements:
    """An IMU of 10 s from `origin_s` on; the LiDAR's and the wheels' spans count from there, on clocks of their own."""
    rng = np.random.default_rng(seed)
    n, second, origin_ns = 1000 * (lidar_s[1] - lidar_s[0]), 10**9, origin_s * 10**9
    imu = origin_ns + np.arange(0, 10 * second, second // 100)
    scans = origin_ns + 1000 * second + np.arange(lidar_s[0] * second, lidar_s[1] * second, second // 10)
    turns = origin_ns - 50 * second + np.arange(wheels_s[0] * second, wheels_s[1] * second, second // 50)
    start = np.arange(len(scans) + 1) * (n // len(scans))
    xyz, offset = rng.normal(size=(n, 3)).astype(np.float32), rng.uniform(0, 0.1, n).astype(np.float32)
    lidar = LidarStream("lidar0", scans, start, offset, xyz, rng.integers(-1, 5, n).astype(np.int32))
    wheels = WheelStream("w", turns, rng.normal(size=(len(turns), 2)))
    readings = ImuStream("imu0", imu, rng.normal(size=(len(imu), 3)), rng.normal(size=(len(imu), 3)))
    return Measurements.of_streams(readings, lidar, wheels, name=f"r{seed}")


@each("origins", [(0, 20), (20, 0), (7, 7)])
def test_all_streams_are_shifted_alike_and_stay_apart(origins):
    parts = [recording(k, s, lidar, (2, 9)) for k, s, lidar in zip((1, 2), origins, ((0, 10), (3, 8)), strict=True)]
    joined, found = join(RIG, parts)
    shift = found[1].shift_ns
    assert found[0].shift_ns == 0
    for pick in (lambda m: m.imu, lambda m: m.lidars[0], lambda m: m.wheels[0]):
        one, (a, b) = pick(joined), (pick(m) for m in parts)
        np.testing.assert_array_equal(one.stamps_ns, np.concatenate([a.stamps_ns, b.stamps_ns + shift]))
        assert (b.stamps_ns[0] + shift - a.stamps_ns[-1]) * 1e-9 >= 10.0
    (lidar,), (a, b) = joined.lidars, (m.lidars[0] for m in parts)
    for name in ("xyz", "offset_s", "plane"):
        np.testing.assert_array_equal(getattr(lidar, name), np.concatenate([getattr(a, name), getattr(b, name)]))
    np.testing.assert_array_equal(lidar.start, np.concatenate([a.start, b.start[1:] + len(a.xyz)]))
    (wheels,), (c, d) = joined.wheels, (m.wheels[0] for m in parts)
    assert isinstance(wheels, WheelStream) and isinstance(c, WheelStream) and isinstance(d, WheelStream)
    np.testing.assert_array_equal(wheels.rate, np.concatenate([c.rate, d.rate]))


def test_a_lidar_that_went_on_longer_than_the_imu_keeps_recordings_apart():
    parts = [recording(1, 0, (0, 40)), recording(2, 0, (-30, 10))]
    joined, _ = join(RIG, parts)
    assert (np.diff(joined.lidars[0].stamps_ns) > 0).all()


def test_relative_poses_cannot_be_joined():
    poses = WheelPoses("w", np.arange(3) * 10**9, np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)))
    one = recording(1, 0, (0, 10))
    both = [one.without("w").with_streams(poses)] * 2
    with pytest.raises(RecordingError, match="w measures relative poses, and there is none between two recordings"):
        join(RIG, both)


def corners(seed: int, stated: bool) -> CornerStream:
    rng, start = np.random.default_rng(seed), np.array([0, 3, 5])
    sigma = rng.uniform(0.02, 0.1, 5) if stated else np.zeros(0)
    return CornerStream("cam0", 10**9 * np.arange(2), start, np.arange(5), rng.normal(size=(5, 2)), sigma=sigma)


@pytest.mark.parametrize("stated", [True, False])
def test_corners_keep_their_sigma_where_all_recordings_state_it(stated):
    a, b = corners(1, True), corners(2, stated)
    joined = CornerStream.joined([a, b], [0, 20 * 10**9])
    assert joined.joins_ns == (20 * 10**9,)
    assert joined.start.tolist() == [0, 3, 5, 8, 10]
    np.testing.assert_array_equal(joined.uv, np.concatenate([a.uv, b.uv]))
    np.testing.assert_array_equal(joined.sigma, np.concatenate([a.sigma, b.sigma]) if stated else [])
