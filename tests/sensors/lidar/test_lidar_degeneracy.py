"""In how many directions the surfaces face that a LiDAR sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import LidarStream
from icalib.detection.planes import count_directions, normal_shares
from icalib.errors import EstimationError
from icalib.sensors.lidar.initialize.odometry import lidar_trajectory, sampled_scans
from icalib.sensors.lidar.initialize.voxel_map import (
    explaining_degeneracy,
    n_directions,
)


def seeing(stream: LidarStream, faces: list[int]) -> LidarStream:
    own = np.isin(stream.plane, faces)
    start = np.concatenate([[0], np.cumsum(own)])[stream.start].astype(np.int64)
    return LidarStream(stream.name, stream.stamps_ns, start, stream.offset_s[own], stream.xyz[own], stream.plane[own])


@each(
    ("faces", "count"),
    [([0], 1), ([3], 1), ([0, 1], 1), ([2, 3], 1), ([0, 2], 2), ([0, 4, 5], 2), ([2, 4], 2), ([0, 2, 4], 3), ([], 0)],
)
def test_of_parts_of_a_room(free_robot, faces, count):
    """0: floor, 1: ceiling, 2 and 3, 4 and 5: walls that face each other."""
    assert n_directions(seeing(free_robot.streams[0], faces)) == count


@each("example", ["table2-planar", "table2-ramp", "straight-line"])
def test_of_whole_rooms(robot, example):
    assert n_directions(robot(6.0, 1, example=example).streams[0]) == 3


@pytest.mark.parametrize("seed", [1, 2])
def test_rings_that_are_far_apart_show_no_surfaces(robot, seed):
    """Four rings over 24 degrees, as few as a scanner of obstacles has; and points that are nowhere a surface."""
    few = robot(4.0, seed, {"rings": 4, "azimuth_steps": 240}).streams[0]
    with pytest.raises(
        EstimationError, match="% of the points of a scan lie on single rings, 0.* m and more apart, so that"
    ):
        lidar_trajectory("lidar0", sampled_scans(few))
    rng = np.random.default_rng(seed)
    cloud = replace(few, xyz=rng.normal(scale=4.0, size=few.xyz.shape).astype(np.float32))
    with pytest.raises(EstimationError, match="there may be too few flat surfaces, or the point times may be"):
        lidar_trajectory("lidar0", sampled_scans(cloud))


def test_shares_of_normals():
    normal = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
    np.testing.assert_allclose(normal_shares(normal, np.array([1.0, 2.0, 1.0])), [0.0, 0.25, 0.75], atol=1e-12)
    assert count_directions(np.array([0.001, 0.25, 0.75])) == 2


def test_only_what_a_lidar_saw_too_little_for_is_blamed_on_it(free_robot):
    whole = free_robot.streams[0]
    with pytest.raises(EstimationError, match="another reason"), explaining_degeneracy([whole]):
        raise EstimationError("another reason.")
    with (
        pytest.raises(EstimationError, match="lidar0 sees face two directions only"),
        explaining_degeneracy([whole, seeing(whole, [0, 2])]),
    ):
        raise EstimationError("another reason.")
