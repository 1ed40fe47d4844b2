"""Streams from numpy arrays are those that a reader makes, and nonsense is refused in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.data import arrays
from icalib.errors import RecordingError
from icalib.tools.simulation import handheld, simulate

T = np.array([10.0, 10.1, 10.25])


def same(a: Any, b: Any) -> None:
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        assert np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y, f.name
        assert not isinstance(x, np.ndarray) or x.dtype == y.dtype, f.name


def test_arrays_of_a_simulated_recording_give_it_back():
    made = simulate(handheld(1.5), 1).measurements
    imu = made.imu
    assert imu is not None
    cameras = []
    for c in made.cameras:
        cuts = c.start[1:-1]
        cameras.append(arrays.corners(c.name, c.stamps_ns, np.split(c.point, cuts), np.split(c.uv, cuts)))
    found = arrays.measurements(*cameras, arrays.imu(imu.name, imu.stamps_ns, imu.gyro, imu.accel), name="run")
    assert found.name == "run" and found.imu is not None
    same(found.imu, imu)
    for a, b in zip(found.cameras, made.cameras, strict=True):
        same(a, b)


def test_seconds_and_nanoseconds():
    gyro = np.zeros((3, 3))
    ns = [10_000_000_000, 10_100_000_000, 10_250_000_000]
    assert arrays.imu("imu0", T, gyro, gyro).stamps_ns.tolist() == ns
    assert arrays.imu("imu0", np.array(ns), gyro, gyro).stamps_ns.tolist() == ns


def test_every_other_kind():
    scans = [np.ones((2, 3)), np.zeros((0, 3)), 2.0 * np.ones((1, 3))]
    scan = arrays.lidar("lidar0", T, scans, [[0.0, 0.01], [], [0.02]])
    assert (
        scan.start.tolist() == [0, 2, 2, 3]
        and scan.offset_s.tolist() == np.array([0.0, 0.01, 0.02], np.float32).tolist()
    )
    assert scan.xyz.tolist() == [[1.0] * 3, [1.0] * 3, [2.0] * 3] and scan.plane.tolist() == [-1] * 3
    seen = arrays.tracks("cam0", T, [[7, 8], [7], []], [np.ones((2, 2)), np.ones((1, 2)), []])
    assert seen.feature.tolist() == [7, 8, 7] and seen.start.tolist() == [0, 2, 3, 3]
    turned = arrays.wheels("wheel0", T, np.ones((3, 2)), sampling="instantaneous", kind="twist")
    assert (turned.sampling, turned.kind) == ("instantaneous", "twist")
    rotations = Rotation.from_rotvec(np.ones((3, 3)))
    placed = arrays.poses("mocap0", T, rotations, np.ones((3, 3)))
    np.testing.assert_array_equal(placed.rotation, rotations.as_matrix())
    found = arrays.measurements(scan, seen, turned, placed)
    assert (found.imu, found.lidars, found.tracks, found.wheels, found.poses) == (
        None,
        (scan,),
        (seen,),
        (turned,),
        (placed,),
    )


@each(
    ("make", "words"),
    [
        (
            lambda: arrays.imu("imu0", T[::-1], np.zeros((3, 3)), np.zeros((3, 3))),
            "imu0: stamps must increase, but",
        ),
        (lambda: arrays.imu("imu0", T, np.zeros((3, 2)), np.zeros((3, 3))), r"gyro must have shape \(3, 3\)"),
        (lambda: arrays.imu("imu0", T, np.full((3, 3), np.nan), np.zeros((3, 3))), "gyro has entries that are NaN"),
        (lambda: arrays.imu("imu0", [], [], []), "stamps must be a vector"),
        (lambda: arrays.imu("imu0", [1.0, np.inf], np.zeros((2, 3)), np.zeros((2, 3))), "stamps have entries that are"),
        (lambda: arrays.imu("imu0", T, "abc", np.zeros((3, 3))), "gyro must be an array of numbers"),
        (lambda: arrays.corners("cam0", T, [[0]], [[[1.0, 2.0]]]), "cam0: there are 3 stamps, but 1 and 1 groups"),
        (lambda: arrays.corners("cam0", T[:1], [[0, 1]], [[[1.0, 2.0]]]), "cam0: group 0 has 2 numbers for 1 values"),
        (lambda: arrays.poses("mocap0", T, np.ones((3, 3, 3)), np.ones((3, 3))), "mocap0: rotation has matrices"),
        (
            lambda: arrays.lidar("lidar0", T[:1], [np.ones((2, 3))], [[0.0]]),
            "lidar0: offset_s must have a row for",
        ),
    ],
)
def test_nonsense_is_refused_in_one_sentence(make: Callable[[], Any], words: str):
    with pytest.raises(RecordingError, match=words) as raised:
        make()
    assert "\n" not in str(raised.value) and str(raised.value).endswith(".")
