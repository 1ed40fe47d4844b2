"""Boards that look the same after a turn are numbered alike across gaps, and by all cameras of a rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.data.measurements import CornerStream, Measurements
from icalib.geometry import so3
from icalib.geometry.targets import Checkerboard, Circles, Target
from icalib.initialize.rig_guess import guess_of_rig
from icalib.rig import Rig
from icalib.sensors.camera.initialize.guess import resolve_symmetry
from icalib.tools.simulation import HandheldMotion, Simulation, handheld, rig_for, simulate

pytestmark = pytest.mark.slow

BOARDS = {
    "halves": Checkerboard(6, 8, 0.08),
    "quarters": Checkerboard(6, 6, 0.09),
    "circles": Circles(7, 8, 0.07, 0.04),
}
TURNED_DEG = 100.0  # between the images before and after a gap: nearer to the wrong half turn


@pytest.fixture(
    scope="module", params=["halves", *(pytest.param(x, marks=pytest.mark.full) for x in ("quarters", "circles"))]
)
def simulation(request) -> Simulation:
    """A rig that is turned by up to 180 degrees in front of the board."""
    scenario = handheld(20.0)
    cameras = tuple(replace(c, time_offset_s=0.004) for c in scenario.cameras)  # images taken together have one stamp
    motion = HandheldMotion(rotation_scale=3.0)
    return simulate(replace(scenario, cameras=cameras, target=BOARDS[request.param], motion=motion), 1)


def turned(stream: CornerStream, target: Target, turn: np.ndarray) -> CornerStream:
    """Image i with the numbers after turn[i]."""
    return replace(stream, point=np.stack(target.turns)[turn[stream.image], stream.point])


def without(stream: CornerStream, begin: float, end: float) -> CornerStream:
    """No images in an interval of its own seconds."""
    kept = (stream.seconds < begin) | (stream.seconds > end)
    return stream.of_rows(kept[stream.image], stream.stamps_ns[kept], np.diff(stream.start)[kept])


def long_turn(simulation: Simulation) -> tuple[float, float]:
    """Instants of cam0 between which the rig turned by more than TURNED_DEG, 2 to 4 s apart."""
    t = simulation.measurements.cameras[0].seconds
    R = np.ascontiguousarray(simulation.truth.pose_at(t)[0])
    for i in range(100, len(t)):
        for j in np.flatnonzero((t > t[i] + 2.0) & (t < t[i] + 4.0)):
            if np.rad2deg(np.linalg.norm(so3.log(np.ascontiguousarray(R[i].T @ R[j])))) > TURNED_DEG:
                return float(t[i]), float(t[j])
    raise AssertionError("no such turn")


def same_but_one_turn(found: Measurements, truth: Measurements, target: Target) -> bool:
    """Whether all images of all cameras have the true numbers after one turn, whichever."""
    for turn in target.turns:
        pairs = list(zip(found.cameras, truth.cameras, strict=True))
        if all(_as_sets(a) == _as_sets(replace(b, point=turn[b.point])) for a, b in pairs):
            return True
    return False


def _as_sets(stream: CornerStream) -> set[tuple[int, int, float, float]]:
    return {
        (int(i), int(p), float(u), float(v)) for i, p, (u, v) in zip(stream.image, stream.point, stream.uv, strict=True)
    }


def shown(simulation: Simulation, rig: Rig, gaps: tuple[int, ...]) -> tuple[Measurements, Measurements]:
    """What cameras saw, those of `gaps` not during a long turn, after which they are numbered wrongly; cam1 starts with
    other numbers than cam0. And the truth."""
    target, (begin, end) = rig.target, long_turn(simulation)
    cameras, wrong = list(simulation.measurements.cameras), []
    for k, stream in enumerate(cameras):
        cameras[k] = without(stream, begin, end) if k in gaps else stream
        turn = np.full(len(cameras[k].stamps_ns), k)
        if k in gaps:
            turn[cameras[k].seconds > begin] += 1 + k
        wrong.append(turned(cameras[k], target, turn % len(target.turns)))
    measured = simulation.measurements.only(*rig.sensors)
    return measured.with_streams(*wrong), measured.with_streams(*cameras)


def test_the_gyroscope_bridges_gaps_of_all_cameras(simulation):
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    wrong, truth = shown(simulation, rig, gaps=(0, 1))
    assert not same_but_one_turn(wrong, truth, rig.target)
    (found,) = resolve_symmetry(rig, [wrong])
    assert same_but_one_turn(found, truth, rig.target)


def test_a_camera_bridges_gaps_of_the_other(simulation):
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free").with_(imu=None)
    for gaps in ((0,), (1,)):
        wrong, truth = shown(simulation, rig, gaps)
        assert not same_but_one_turn(wrong, truth, rig.target)
        (found,) = resolve_symmetry(rig, [wrong])
        assert same_but_one_turn(found, truth, rig.target)


@pytest.mark.parametrize("simulation", ["halves"], indirect=True)
def test_an_estimate_starts_from_the_same_numbers(simulation):
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    wrong, truth = shown(simulation, rig, gaps=(0,))
    inputs, _, _ = guess_of_rig(rig, [wrong])
    assert same_but_one_turn(inputs.measurements, truth, rig.target)


@pytest.mark.parametrize("simulation", ["halves"], indirect=True)
def test_a_camera_alone_keeps_its_numbers(simulation):
    """Between two images it may have turned by any angle."""
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    wrong, _ = shown(simulation, rig, gaps=(0,))
    alone = wrong.only(wrong.cameras[0].name)
    (found,) = resolve_symmetry(rig.with_(imu=None, cameras=rig.cameras[:1]), [alone])
    assert _as_sets(found.cameras[0]) == _as_sets(alone.cameras[0])
