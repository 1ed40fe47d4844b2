"""Wheels on a plane: rows against the obvious geometry, and which plane is the floor."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.geometry.planes import plane_of
from icalib.optim.arrowhead import make_pieces
from icalib.optim.state import make_layout
from icalib.rig import Ground
from icalib.sensors.wheels.assess import ground_warnings
from icalib.sensors.wheels.ground_factor import GroundFactor, floors

KEY = ("plane 0", "plane")
LEVEL, FLOOR = Ground("level", 0.01, 0.0, 0.004, 0.002), Ground("floor", 0.01, 0.0, 0.004, 0.002)


def standing(world_of, drive_of_kind, plane=None, height=0.0):
    """A planar world with the height of its wheels, and a plane, in its state and layout."""
    world = world_of(drive_of_kind("planar", 1))
    own = {("wheel0", "ground_height"): np.array([height])} | ({} if plane is None else {KEY: plane})
    entries = [(b.sensor, b.name, b.kind, b.size, b.start is not None) for b in world.layout.blocks]
    entries += [("wheel0", "ground_height", "vector", 1, True)]
    entries += [] if plane is None else [(*KEY, "plane", 3, True)]
    return replace(world, layout=make_layout(entries), state=replace(world.state, values=world.state.values | own))


def rows(factor, state):
    """(n, 4) before whitening."""
    out = factor.output()
    for piece in make_pieces(len(state.seconds), factor.layout.size):
        factor.accumulate(state, piece, out, sums=False)
    return out.residual * factor.sigma


def factor_on(world, ground=LEVEL, key=None):
    return GroundFactor.build("wheel0", ground, (key,), world.state, world.layout)


def test_on_a_flat_floor_nothing_is_left(world_of, drive_of_kind):
    world = standing(world_of, drive_of_kind)
    r = rows(factor_on(world), world.state)
    assert r.shape == (len(world.state.seconds) - 1, 4) and np.abs(r).max() < 1e-9


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_sloping_floor_that_looks_either_way(world_of, drive_of_kind, side):
    """Heights are measured along its normal, upwards; tilts are its normal's components in the wheels' axes."""
    n = Rotation.from_euler("xy", [0.05, -0.1]).apply([0.0, 0.0, 1.0])
    q = np.array([1.0, 2.0, -0.3])
    world = standing(world_of, drive_of_kind, plane_of(side * n, q), 0.02)
    r = rows(factor_on(world, replace(FLOOR, height=0.05), KEY), world.state)
    drive, t = world.drive, world.state.seconds[:-1]
    origin = drive.pose(t)[1] - drive.rotation(t) @ drive.lever
    np.testing.assert_allclose(r[:, :2], (drive.rotation(t).transpose(0, 2, 1) @ n)[:, :2], atol=1e-12)
    np.testing.assert_allclose(r[:, 2], (origin - q) @ n - 0.02, atol=1e-9)
    np.testing.assert_allclose(r[:, 3], -0.03, atol=1e-12)


def test_what_was_measured_of_the_height_counts_once(world_of, drive_of_kind):
    world = standing(world_of, drive_of_kind, height=0.03)
    factor = factor_on(world)
    out = factor.output()
    for piece in make_pieces(len(world.state.seconds), factor.layout.size):
        factor.accumulate(world.state, piece, out, sums=False)
    assert (out.residual[:, 3] ** 2).sum() == pytest.approx((0.03 / 0.004) ** 2, rel=1e-9)
    assert factor.count(out, "ground height") == len(factor.keyframes) and list(factor.kinds) == [
        "ground tilt",
        "ground height",
    ]
    assert factor.rms(out, "ground height") == (pytest.approx(0.03), "m")


@pytest.mark.parametrize(
    ("ground", "kinds"),
    [(Ground("level", 0.01), ["ground tilt"]), (Ground("level", None, 0.0, 0.004), ["ground height"])],
)
def test_what_is_not_asked_for_weighs_nothing(world_of, drive_of_kind, dense, ground, kinds):
    world = standing(world_of, drive_of_kind)
    if ground.height_sigma is None:  # then the height is not in the calibration parameters
        world = replace(
            world,
            layout=make_layout(
                [
                    (b.sensor, b.name, b.kind, b.size, b.start is not None)
                    for b in world.layout.blocks
                    if b.name != "ground_height"
                ]
            ),
        )
    factor = factor_on(world, ground)
    moved = world.moved(rotation=[0.1, 0.2, 0.0], translation=np.array([0.0, 0.0, 0.3]))
    out, n = factor.output(), len(world.state.seconds)
    pieces = make_pieces(n, world.layout.size)
    for piece in pieces:
        factor.accumulate(moved, piece, out)
    heard = np.flatnonzero(out.residual[:, :3].any(axis=0)).tolist()
    assert heard == ([0, 1] if kinds == ["ground tilt"] else [2]) and list(factor.kinds) == kinds
    H, _ = dense(pieces, n)
    z, x = 15 * n + world.layout.block("wheel0", "translation").start + 2, 15 * n
    assert (H[z, z] > 0) == (kinds == ["ground height"]) and (H[x, x] > 0) == (kinds == ["ground tilt"])


def test_signs(world_of, drive_of_kind):
    """A frame that is higher on the vehicle leaves a positive height; nose down, the normal points forward less."""
    world = standing(world_of, drive_of_kind)
    factor = factor_on(world)
    up = world.drive.R_imu_wheel[:, 2]
    assert np.all(rows(factor, world.moved(translation=0.1 * up))[:, 2] == pytest.approx(0.1))
    assert np.all(rows(factor, world.moved(rotation=[0.0, 0.1, 0.0]))[:, 0] == pytest.approx(-np.sin(0.1)))
    assert np.all(rows(factor, world.moved(rotation=[0.1, 0.0, 0.0]))[:, 1] == pytest.approx(np.sin(0.1)))


def test_the_floor_is_the_level_plane_below_with_most_points(world_of, drive_of_kind):
    world = world_of(drive_of_kind("planar", 1))
    p = world.state.position.mean(axis=0)
    planes = {
        "plane 0": plane_of(np.array([1.0, 0.0, 0.1]), p - [3.0, 0.0, 0.0]),  # a wall
        "plane 1": plane_of(np.array([0.0, 0.0, 1.0]), p + [0.0, 0.0, 2.0]),  # a ceiling
        "plane 2": plane_of(np.array([0.05, 0.0, -1.0]), p - [0.0, 0.0, 0.4]),  # the floor, from below
        "plane 3": plane_of(np.array([0.0, 0.0, 1.0]), p - [0.0, 0.0, 0.1]),  # a table
    }
    keys = tuple((name, "plane") for name in planes)
    values = world.state.values | {(name, "plane"): plane for name, plane in planes.items()}
    state = replace(world.state, values=values)
    assert floors(state, keys, np.array([900, 800, 300, 20]), np.zeros(4)) == (keys[2],)
    assert floors(state, keys[:2], np.array([900, 800]), np.zeros(2)) == (None,)
    second = tuple((f"plane {r}.{k}", "plane") for r in (1, 2) for k in (2, 3))
    two = {key: planes[f"plane {key[0][-1]}"] for key in second}
    half = replace(world.state, values=world.state.values | two, starts=(0, 40))
    assert floors(half, second, np.array([5, 20, 30, 20]), np.array([0, 0, 1, 1])) == (second[1], second[2])


def test_recordings_that_do_not_see_the_floor_have_no_part(world_of, drive_of_kind):
    world = standing(world_of, drive_of_kind, plane_of(np.array([0.0, 0.0, 1.0]), np.zeros(3)))
    state = replace(world.state, starts=(0, 30))
    factor = GroundFactor.build("wheel0", FLOOR, (None, KEY), state, world.layout)
    assert factor.keyframes.tolist() == list(range(30, len(state.seconds) - 1))
    none = GroundFactor.build("wheel0", FLOOR, (None, None), state, world.layout)
    found: Any = SimpleNamespace(
        problem=SimpleNamespace(factors={("seen", "ground"): factor, ("unseen", "ground"): none})
    )
    (words,) = ground_warnings(found)
    assert (
        "none of the planes that LiDARs see is a floor" in words and "the ground of wheel0 counts for nothing" in words
    )
    assert len(none.keyframes) == 0 and none.rms(none.output(), "ground tilt") == (0.0, "rad")
