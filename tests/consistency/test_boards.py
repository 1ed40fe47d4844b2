"""Cameras before a target, moved by hand with an IMU: exact without noise, honest with it, what motion leaves open, and
the first reason is the true one."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.consistency.cases import (
    Case,
    Check,
    Run,
    exact,
    has_no_reason,
    known,
    leaves_nothing_open,
    off_below,
    parameters,
    reason,
    std_below,
)
from tests.consistency.recordings import by_hand, moving
from tests.remarks import names
from tests.typed import not_none

from icalib.data.measurements import Measurements
from icalib.geometry.targets import Charuco, Checkerboard, Target
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, Rig, Settings
from icalib.sensors.imu.spec import FREE
from icalib.tools.simulation import Scenario, Simulation, handheld, rig_for, simulate
from icalib.tools.simulation.rigs import Treatment

ROTATION_RAD, TRANSLATION_M, OFFSET_S = 0.087, 0.05, 0.02  # of a guess
IMU_INTRINSICS = np.random.default_rng(2).normal(0.0, np.repeat([0.01, 1e-3], [15, 9]))
BOW, BLOOMS = (1.0e-3, -0.5e-3, 0.7e-3), (0.25, 0.30)
DOUBLE_SPHERE = (250.0, 249.0, 371.0, 245.0), (-0.18, 0.59)
WIDE = {
    "eucm": ("eucm", (250.0, 249.0, 371.0, 245.0), (0.62, 1.09), 0.0),
    "eucm, corners up to 101 deg off the axis": ("eucm", (110.0, 109.0, 371.0, 245.0), (0.6, 1.1), 70.0),
    "double-sphere": ("double-sphere", (150.0, 151.0, 371.0, 245.0), (-0.2, 0.59), 0.0),
    "double-sphere, turned": ("double-sphere", (220.0, 221.0, 371.0, 245.0), (0.3, 0.7), 40.0),
    "pinhole-rational": (
        "pinhole-rational",
        (330.0, 331.0, 371.0, 245.0),
        (3.1, 0.9, 2e-4, 1e-4, 0.02, 3.4, 1.9, 0.15),
        0.0,
    ),
    "omni-radtan": ("omni-radtan", (300.0, 298.0, 371.0, 245.0), (1.2, -0.1, 0.03, 3e-4, -2e-4), 40.0),
}
ONLY_IN_FULL = {"eucm", "double-sphere", "double-sphere, turned", "omni-radtan"}


# Recordings.


def wide(model: str, intrinsics: tuple, distortion: tuple, turn_deg: float) -> Simulation:
    """Without noise; a camera turned away from the target, 0.35 m before it."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    base = handheld(12.0, noiseless=True)
    camera = replace(base.cameras[0], model=model, intrinsics=intrinsics, distortion=distortion)
    camera = replace(camera, T_imu_sensor=camera.T_imu_sensor @ turn)
    return simulate(replace(base, cameras=(camera,), motion=replace(base.motion, distance_m=0.35)), 1)


def double_sphere() -> Simulation:
    base = handheld(20.0)
    camera = replace(base.cameras[0], model="double-sphere", intrinsics=DOUBLE_SPHERE[0], distortion=DOUBLE_SPHERE[1])
    return simulate(replace(base, cameras=(camera,)), 1)


def of_target(target: Target) -> Simulation:
    base = handheld(8.0, noiseless=True)
    return simulate(replace(base, target=target, cameras=base.cameras[:1]), 1)


@cache
def as_detected() -> Simulation:
    """A bent board, edges that bloom, images that blur."""
    base = handheld(20.0)
    cameras = tuple(replace(c, bloom_px=b) for c, b in zip(base.cameras, BLOOMS, strict=True))
    return simulate(replace(base, cameras=cameras, bow=BOW, blur_s=3e-4), 5)


def turning(kind: str, imu: Literal["datasheet", "noisy"] = "datasheet", seed: int = 0) -> Callable[[], Simulation]:
    return lambda: simulate(moving(handheld(12.0, imu=imu), kind), seed)


def drifting(ppm: float, cameras: int = 1) -> Callable[[], Simulation]:
    """As `BY_HAND`, with the clocks of the first cameras at another rate."""
    scenario = handheld(15.0)
    rates = ppm * (np.arange(len(scenario.cameras)) < cameras)
    drifted = tuple(replace(c, clock_rate_ppm=float(x)) for c, x in zip(scenario.cameras, rates, strict=True))
    return lambda: simulate(replace(scenario, cameras=drifted), 1)


# Rig files.


def rates_free(simulation: Simulation) -> Rig:
    rig = lens("fixed")(simulation)
    return rig.with_(cameras=tuple(replace(c, clock_rate=Parameter()) for c in rig.cameras))


def lens(treated: Treatment) -> Callable[[Simulation], Rig]:
    """With the settings that users have by default."""
    return lambda s: rig_for(s.scenario, settings=Settings(), intrinsics=treated, distortion=treated)


def from_nothing(simulation: Simulation) -> Rig:
    return rig_for(simulation.scenario, intrinsics="free", distortion="free")


def with_bloom(simulation: Simulation) -> Rig:
    rig = rig_for(simulation.scenario)
    return replace(rig, settings=replace(rig.settings, bloom=True))


def for_real_corners(simulation: Simulation) -> Rig:
    rig = rig_for(simulation.scenario)
    settings = replace(rig.settings, bloom=True, board_shape=True, blur_noise=True)
    return rig.with_(cameras=tuple(replace(c, corner_noise_px=None) for c in rig.cameras), settings=settings)


def imu_intrinsics_free(simulation: Simulation) -> Rig:
    rig = rig_for(simulation.scenario)
    prior = Parameter("prior", np.zeros(24), FREE.sigma)
    return rig.with_(imu=replace(not_none(rig.imu), intrinsics=prior))


def guessed(mode: Literal["prior", "free"], seed: int) -> Callable[[Simulation], Rig]:
    """A guess drawn about the truth, as a prior or without a word on its size."""

    def rig(simulation: Simulation) -> Rig:
        rng, truth, plain = np.random.default_rng([seed, 99]), simulation.truth, rig_for(simulation.scenario)

        def parameter(value: np.ndarray, sigma: float) -> Parameter:
            if mode == "prior":
                return Parameter("prior", value, np.full(3 if value.ndim == 2 else len(value), sigma))
            return Parameter("free", value)

        cameras = []
        for camera in plain.cameras:
            T, offset = truth.T_imu_sensor[camera.name], truth.time_offset[camera.name]
            turn = Rotation.from_rotvec(ROTATION_RAD * rng.normal(size=3)).as_matrix()
            own = {
                "rotation": parameter(T[:3, :3] @ turn, ROTATION_RAD),
                "translation": parameter(T[:3, 3] + TRANSLATION_M * rng.normal(size=3), TRANSLATION_M),
                "time_offset": parameter(np.array([offset + OFFSET_S * rng.normal()]), OFFSET_S),
            }
            cameras.append(replace(camera, **own))
        return plain.with_(cameras=tuple(cameras))

    return rig


# What is seen.


def late(seconds: Callable[[np.ndarray], np.ndarray]) -> Callable[[Simulation], Measurements]:
    """The images of the first camera are stamped late by so much at each of their instants."""

    def seen(simulation: Simulation) -> Measurements:
        streams = simulation.measurements.cameras[:1]
        shifts = [np.round(1e9 * seconds(c.seconds)).astype(np.int64) for c in streams]
        moved = (replace(c, stamps_ns=c.stamps_ns + ns) for c, ns in zip(streams, shifts, strict=True))
        return simulation.measurements.with_streams(*moved)

    return seen


def spliced(change: Callable[[Scenario], Scenario], camera: int = 0) -> Callable[[Simulation], Measurements]:
    """A camera as another scenario has it from two thirds of the recording on, with the same noise."""

    def seen(simulation: Simulation) -> Measurements:
        other = simulate(change(simulation.scenario), 1).measurements.cameras[camera]
        own = simulation.measurements.cameras[camera]
        k = 2 * len(own.stamps_ns) // 3
        counts = np.concatenate([np.diff(own.start)[:k], np.diff(other.start)[k:]])
        columns = {
            n: np.concatenate([getattr(own, n)[own.image < k], getattr(other, n)[other.image >= k]])
            for n in ("point", "uv")
        }
        start = np.concatenate([[0], np.cumsum(counts)])
        return simulation.measurements.with_streams(replace(own, start=start, **columns))

    return seen


def moved_by_3_mm(scenario: Scenario) -> Scenario:
    """The second camera: the motion is such that the first looks at the target."""
    cam0, cam1 = scenario.cameras
    T = cam1.T_imu_sensor.copy()
    T[:3, 3] += [0.0, 0.003, 0.0]
    return replace(scenario, cameras=(cam0, replace(cam1, T_imu_sensor=T)))


def zoomed_by_1_percent(scenario: Scenario) -> Scenario:
    cam0, cam1 = scenario.cameras
    focal = tuple(np.multiply(cam0.intrinsics, [1.01, 1.01, 1.0, 1.0]))
    return replace(scenario, cameras=(replace(cam0, intrinsics=focal), cam1))


def shock_at_7_5_s(simulation: Simulation) -> Measurements:
    imu = not_none(simulation.measurements.imu)
    accel, hit = imu.accel.copy(), imu.seconds.searchsorted(7.5)
    accel[hit : hit + 5] += [40.0, -25.0, 10.0]
    return simulation.measurements.with_streams(replace(imu, accel=accel))


# Checks.


def nothing_blooms(run: Run) -> None:
    assert not any(group.name == "bloom" for group in run.result.groups)


def bloom_bow_and_noise_are_found(run: Run) -> None:
    shape = run.result.group("board0", "shape")
    assert np.abs((shape.value[:3] - BOW) / shape.std_formal[:3]).max() < 4.0
    assert np.abs(shape.value[3:] / shape.std_formal[3:]).max() < 4.0
    cameras = run.simulation.scenario.cameras
    for residuals, camera in zip(run.result.corner_residuals, cameras, strict=True):
        bloom = run.result.group(camera.name, "bloom")
        assert abs(bloom.value[0] - camera.bloom_px) < 4.0 * bloom.std_formal[0]
        assert residuals.sigma.min() == pytest.approx(camera.corner_noise_px, rel=0.25)
        true = run.simulation.truth.corners[camera.name].sigma
        assert np.median(residuals.sigma) == pytest.approx(np.median(true), rel=0.15)


def all_off_below(turn: float, way: float, offset: float) -> list[Check]:
    sizes = {"rotation": turn, "translation": way, "time_offset": offset}
    return [off_below(f"cam{k}.{name}", most) for k in (0, 1) for name, most in sizes.items()]


def lever_arm_is_at_the_guess(run: Run) -> None:
    """Open along the axis of rotation, alike for both cameras, and held there between the guesses. What the cameras see
    of each other is determined: only their common shift is fixed."""
    R = run.simulation.truth.R_world_imu
    axis = np.linalg.svd(Rotation.from_matrix(R[0].T @ R[::20]).as_rotvec(), full_matrices=False)[2][0]
    assert any("translation" in sentence for sentence in run.result.unobservable)
    moved = []
    for camera in run.rig.cameras:
        group = run.result.group(camera.name, "translation")
        assert group.verdict[int(np.argmax(np.abs(axis)))] == "unobservable"
        moved.append((group.value - not_none(camera.translation.value)) @ axis)
    assert abs(np.mean(moved)) < 1e-3


def drifts_by(ppm: float, *cameras: str) -> Check:
    """The rate of the `cameras` is found, and named in a note, within 5 ppm; nothing else is wrong."""

    def check(run: Run) -> None:
        found = [note for note in run.result.notes if note.name == "clock_rate_estimated"]
        assert len(found) == len(cameras) and not run.result.reasons, run.result.reasons
        for camera, note in zip(cameras, found, strict=True):
            match = re.search(rf"of {camera} runs (\d+) \S+ \S+ ppm {'fast' if ppm < 0.0 else 'slow'}", note)
            assert match is not None and float(match[1]) == pytest.approx(abs(ppm), abs=5.0), note
            assert run.result.value(camera, "clock_rate")[0] == pytest.approx(ppm, abs=5.0)

    return check


def names_a_lens(run: Run) -> None:
    """A shift along the axis explains it nearly as well, and may come first."""
    first = run.result.reasons[0]
    assert first.name in ("lens_changes", "mount_moves"), first
    assert re.search(r"^cam0 .*its lens by up to (3|4)\.\d px", first), first


def shock_is_told(run: Run) -> None:
    """Its time is that of the shock, and the parts that are named leave it out."""
    reason("disturbance_at_one_time")(run)
    match = re.search(r"near (\S+) s: .* --to (\S+), or --from (\S+)\.", run.result.reasons[0])
    assert match is not None and float(match[2]) < 7.5 < float(match[3]), run.result.reasons
    assert abs(float(match[1]) - 7.5) < 0.5 and "imu_noise_understated" not in names(run.result.reasons)


BY_HAND: Callable[[], Simulation] = lambda: by_hand(15.0, 1)  # noqa: E731
CASES: dict[str, Case] = {
    # Exact without noise, from nothing.
    **{
        f"noiseless, {'asynchronous' if apart else 'synchronous'}": Case(
            lambda apart=apart: simulate(handheld(12.0, asynchronous=apart, noiseless=True), 0),
            [exact(1e-8, lens=1e-8, least=1e-8), leaves_nothing_open],
            from_nothing,
            full=not apart,
        )
        for apart in (True, False)
    },
    **{
        f"a wide lens, {name}": Case(
            lambda lens=own: wide(*lens), [exact(1e-7, lens=1e-6)], from_nothing, full=name in ONLY_IN_FULL
        )
        for name, own in WIDE.items()
    },
    "ChArUco": Case(lambda: of_target(Charuco(8, 7, 0.08, 0.06, "5x5_100")), [exact(1e-8), nothing_blooms], with_bloom),
    "checkerboard": Case(
        lambda: of_target(Checkerboard(6, 7, 0.08)), [exact(1e-8), nothing_blooms], with_bloom, full=True
    ),
    # Honest with noise.
    # With xi of the other sign a double sphere fits to 0.01 px, far below the noise of 0.2 px.
    "double sphere finds the right valley": Case(double_sphere, [known()], from_nothing),
    "bloom, bow and blur": Case(
        as_detected, [bloom_bow_and_noise_are_found, *all_off_below(1e-3, 2e-3, 1e-4)], for_real_corners
    ),
    "IMU intrinsics of one per cent": Case(
        lambda: simulate(replace(handheld(30.0), imu_intrinsics=IMU_INTRINSICS), 1),
        [known(), std_below("imu0.intrinsics", 0.01)],
        imu_intrinsics_free,
    ),
    # What is unobservable is said and fixed at the guess, and the rest is right.
    "planar motion, guessed": Case(turning("planar"), [known(), lever_arm_is_at_the_guess], guessed("free", 0)),
    "planar motion, with priors": Case(
        turning("planar"), [known(), lever_arm_is_at_the_guess], guessed("prior", 0), full=True
    ),
    "turning about one axis, guessed": Case(
        turning("single_axis"), [known(), lever_arm_is_at_the_guess], guessed("free", 0), full=True
    ),
    "turning about one axis, with priors": Case(
        turning("single_axis"), [known(), lever_arm_is_at_the_guess], guessed("prior", 0)
    ),
    "motionless, guessed": Case(turning("motionless"), [known()], guessed("free", 0), full=True),
    "motionless, with priors": Case(turning("motionless"), [known()], guessed("prior", 0)),
    "planar motion, noisy IMU": Case(
        turning("planar", "noisy", 1), [known(), lever_arm_is_at_the_guess], guessed("prior", 1), full=True
    ),
    "turning about one axis, noisy IMU": Case(
        turning("single_axis", "noisy", 1), [known(), lever_arm_is_at_the_guess], guessed("prior", 1), full=True
    ),
    "turning about one axis, from nothing": Case(
        turning("single_axis"),
        refused="turned about one axis only.*turn the rig about (the . and . axes of imu0|two axes perp.*) as well",
    ),
    # The data show the attitude of the board to 1 deg, and a start value 9 deg off must not take its place.
    "nobody guesses the attitude of the board": Case(
        lambda: simulate(moving(handheld(20.0), "single_axis"), 58), [known()], guessed("prior", 58)
    ),
    # The first reason is the true one.
    "nothing is wrong": Case(BY_HAND, [has_no_reason, known()], lens("fixed")),
    # Neither camera drifts against the other, both against the IMU.
    "a clock that two cameras share is 300 ppm fast": Case(
        drifting(-300.0, 2), [drifts_by(-300.0, "cam0", "cam1"), known()], lens("fixed")
    ),
    # Stamps that run fast need an offset that falls.
    "a clock is 300 ppm fast": Case(drifting(-300.0), [drifts_by(-300.0, "cam0"), known()], lens("fixed")),
    "a clock is 100 ppm slow, rates are free": Case(
        drifting(100.0), [drifts_by(100.0, "cam0"), known()], rates_free, full=True
    ),
    "a clock that two cameras share is 300 ppm fast, rates are free": Case(
        drifting(-300.0, 2), [drifts_by(-300.0, "cam0", "cam1"), known()], rates_free
    ),
    "a clock jumps by 4 ms": Case(
        BY_HAND,
        [reason("clock_jumps", r"of cam0 .* [+-](3|4)\S* ms near 9\.\d")],
        lens("fixed"),
        late(lambda t: np.where(t > 9.4, 0.004, 0.0)),
    ),
    "a camera moves on its mount": Case(
        BY_HAND,
        [reason("mount_moves", r"^cam\d .* near (9\.9|10\.0)\d* s: it moves on its mount by \S+ deg and (2|3)\S* mm")],
        lens("fixed"),
        spliced(moved_by_3_mm, 1),
    ),
    "a lens refocuses": Case(
        BY_HAND,
        [names_a_lens],
        lens("start"),
        spliced(zoomed_by_1_percent),
    ),
    "a shock": Case(BY_HAND, [shock_is_told], lens("fixed"), shock_at_7_5_s),
}


@pytest.mark.parametrize("case", parameters(CASES))
def test_a_case(case: Case) -> None:
    case.verify()


@pytest.fixture(scope="module")
def usual() -> tuple[Rig, Measurements, Calibration]:
    """A recording that determines everything, at the default tolerances."""
    simulation = by_hand(10.0, 0)
    rig = rig_for(simulation.scenario, intrinsics="start")
    return rig, simulation.measurements, calibrate_measurements(rig, simulation.measurements)


TOLERANCES = {
    "rotation": ("rotation_tolerance_deg", 180.0 / np.pi),
    "translation": ("translation_tolerance_m", 1.0),
    "time_offset": ("time_tolerance_s", 1.0),
    "intrinsics": ("pixel_tolerance", 1.0),
}


@pytest.mark.parametrize("groups", [("rotation", "intrinsics"), ("translation", "time_offset")])
def test_a_tighter_tolerance_makes_a_parameter_weak(
    usual: tuple[Rig, Measurements, Calibration], groups: tuple[str, ...]
) -> None:
    """And no other; the estimate is the same."""
    rig, measurements, wide = usual
    std = {name: wide.group("cam0", name).std_formal for name in TOLERANCES}
    tight = {TOLERANCES[g][0]: TOLERANCES[g][1] * 0.4 * float(std[g].max()) for g in groups}
    strict = calibrate_measurements(replace(rig, settings=replace(rig.settings, **tight)), measurements)
    for name in TOLERANCES:
        assert set(wide.group("cam0", name).verdict) == {"determined"}
        assert ("weak" in strict.group("cam0", name).verdict) == (name in groups)
        np.testing.assert_allclose(strict.group("cam0", name).std_formal, std[name], rtol=0.02)
