"""A plausible calibration of two cameras and an IMU, made from obvious formulas, with a verdict of each kind."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.remarks import remark
from tests.typed import instance

from icalib.geometry.targets import AprilGrid
from icalib.result import (
    Calibration,
    CrossValidation,
    Iteration,
    ParameterGroup,
    Plane,
    PredictedFit,
    RowResiduals,
    SensorFit,
    Trajectory,
    Verdict,
    by_key,
)
from icalib.rig import Camera, ImuNoise, ImuSensor, Lidar, Parameter, Rig, Settings, Wheels, by_name
from icalib.rig.file import rig_to_dict
from icalib.sensors.camera.stream import CornerResiduals
from icalib.sensors.imu.spec import INTRINSICS_LABELS
from icalib.sensors.imu.stream import ImuResiduals
from icalib.sensors.lidar.stream import LidarResiduals

N_KEYFRAMES, CORNERS_PER_IMAGE = 300, 34
POSES = {
    "cam0": ([0.35, 1.47, 89.15], [-0.02164, -0.06468, 0.00981]),
    "cam1": ([-1.05, 1.45, 89.27], [-0.01984, 0.04537, 0.00786]),
}
INTRINSICS = {"cam0": [458.654, 457.296, 367.215, 248.375], "cam1": [457.587, 456.134, 379.999, 255.238]}
DISTORTION = {"cam0": [-0.2834, 0.0739, 1.9e-4, 1.8e-5], "cam1": [-0.2837, 0.0745, -1.0e-4, -3.6e-5]}
SIZES = {  # tangent size, unit, labels, formal standard deviation
    "rotation": ("rad", ("x", "y", "z"), 1.2e-4),
    "translation": ("m", ("x", "y", "z"), 4e-4),
    "time_offset": ("s", ("time_offset",), 1.1e-5),
    "intrinsics": ("px", ("fx", "fy", "cx", "cy"), 0.05),
    "distortion": ("", ("k1", "k2", "p1", "p2"), 2e-4),
    "bloom": ("px", ("bloom",), 3e-3),
    "shape": ("m", ("bow_xx", "bow_xy", "bow_yy"), 2e-5),
    "tilt": ("rad", ("x", "y"), 5e-5),
    "radii": ("m", ("left", "right"), 4e-5),
    "baseline": ("m", ("baseline",), 5e-4),
}
LIDAR, WHEELS = Lidar("lidar0", "lidar0"), Wheels("wheel0", "wheel0/rates.csv")


@pytest.fixture(scope="session")
def calibration() -> Calibration:
    rng = np.random.default_rng(7)
    groups = _groups()
    names = tuple(f"{g.sensor}.{g.name}.{n}" for g in groups if g.columns for n in g.labels)
    trajectory = _trajectory()
    rig = _rig()
    return Calibration(
        groups=groups,
        covariance=_covariance(groups, rng),
        covariance_names=names,
        null_space=_null_space(names),
        unobservable=(remark("cam1 translation y: turn the rig about a second axis to determine it."),),
        fits=tuple(_fits()),
        residuals=by_key(
            [
                *(_corners(name, trajectory, instance(rig.target, AprilGrid), rng) for name in POSES),
                ImuResiduals("imu0", trajectory.seconds[:-1], rng.normal(size=(N_KEYFRAMES - 1, 15))),
            ]
        ),
        trajectory=trajectory,
        iterations=tuple(_iterations()),
        converged=True,
        status="converged after 8 iterations: the predicted decrease of chi^2 fell below 1e-3.",
        warnings=(
            remark(
                "the accelerometer of imu0 leaves residuals 1.6 times as large as its noise says; a larger one fits."
            ),
        ),
        notes=tuple(
            map(
                remark,
                ("IMU noise (default for a consumer IMU): gyro 1.6e-4 rad/s/sqrt(Hz).", "3 corners <repaired> & kept."),
            )
        ),
        rig=rig_to_dict(rig),
        rates={"imu0": 200.0, "cam0": 20.0, "cam1": 20.0},
        inputs={"recording/imu0/data.csv.gz": "ab" * 32, "recording/cam0/corners.csv.gz": "cd" * 32},
        settings=dataclasses.asdict(rig.settings),
        versions={"icalib": "0.1.0", "python": "3.11.2", "numpy": "2.0.0"},
        timings={"reading": 0.41, "first guess": 0.25, "solving": 1.3},
        cross_validation=_held_out(groups),
    )


def _held_out(groups: tuple[ParameterGroup, ...]) -> CrossValidation:
    """Eight parts, what moves without each three times what is allowed."""
    fits = (
        PredictedFit("cam0", "corners", 20_000, 19_500.0, 19_900.0, 0.2, 0.20204, "px"),
        PredictedFit("imu0", "gyroscope", 897, 640.0, 655.5),
    )
    std = np.concatenate([g.std_formal for g in groups if g.columns])
    moved = 1.2 * std * np.random.default_rng(9).normal(size=(8, len(std)))
    return CrossValidation(8, len(std), 900.0, 100.0, 25.0, fits, moved, np.tile(0.4 * std, (8, 1)))


def _rig() -> Rig:
    cameras = tuple(
        Camera(name, f"{name}/corners.csv", "pinhole-radtan", (752, 480), distortion=Parameter("fixed", np.array(d)))
        for name, d in DISTORTION.items()
    )
    noise = ImuNoise(1.6e-4, 2.2e-5, 2.8e-3, 8.6e-4, "default for a consumer IMU")
    return Rig(
        by_name(ImuSensor("imu0", "imu0/data.csv", noise), *cameras), AprilGrid(6, 6, 0.088, 0.3), settings=Settings()
    )


def _groups() -> tuple[ParameterGroup, ...]:
    groups: list[ParameterGroup] = []
    for cam, (rpy, position) in POSES.items():
        values = {
            "rotation": Rotation.from_euler("xyz", rpy, degrees=True).as_matrix(),
            "translation": position,
            "time_offset": [-1.354e-4],
            "intrinsics": INTRINSICS[cam],
            "distortion": DISTORTION[cam],
            "bloom": [0.27],
        }
        for name, value in values.items():
            groups.append(_group(groups, cam, name, value, name == "distortion"))
    groups.append(_group(groups, "board0", "shape", [8e-4, -2e-4, 5e-4], False))
    groups.append(_group(groups, "board0", "tilt", Rotation.from_euler("x", 88.0, degrees=True).as_matrix(), False))
    groups.append(
        ParameterGroup(
            "imu0",
            "intrinsics",
            INTRINSICS_LABELS,
            "",
            np.zeros(24),
            np.zeros(24),
            np.zeros(24),
            ("fixed",) * 24,
            "fixed",
        )
    )
    return tuple(groups)


def _group(before: list[ParameterGroup], sensor: str, name: str, value: object, fixed: bool) -> ParameterGroup:
    unit, labels, std = SIZES[name]
    n, array = len(labels), np.array(value, dtype=np.float64)
    if fixed:
        zeros = np.zeros(n)
        return ParameterGroup(sensor, name, labels, unit, array, zeros, zeros, ("fixed",) * n, "fixed")
    start = sum(len(g.labels) for g in before if g.columns)
    verdict: list[Verdict] = ["determined"] * n
    if (sensor, name) == ("cam1", "translation"):
        verdict = ["determined", "unobservable", "weak"]
    formal, factor = np.full(n, std) * (1.0 + 0.1 * np.arange(n)), np.full(n, 2.7)
    columns = tuple(range(start, start + n))
    return ParameterGroup(
        sensor, name, labels, unit, array, formal, formal * factor, tuple(verdict), "free", columns, factor
    )


def _covariance(groups: tuple[ParameterGroup, ...], rng: np.random.Generator) -> np.ndarray:
    std = np.concatenate([g.std_formal for g in groups if g.columns])
    mixed = rng.normal(size=(len(std), len(std))) + 4.0 * np.eye(len(std))
    full = mixed @ mixed.T
    scale = std / np.sqrt(np.diag(full))
    return full * np.outer(scale, scale)


def _null_space(names: tuple[str, ...]) -> np.ndarray:
    """(B, 1): the component that is unobservable."""
    return np.eye(len(names))[:, [names.index("cam1.translation.y")]]


def pose_at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_world_body (n, 3, 3) and p_world_body (n, 3) at t (n,) s."""
    angles = np.stack([0.5 * np.sin(2.1 * t), 0.4 * np.sin(1.7 * t + 1), 0.6 * np.sin(1.3 * t)], axis=1)
    position = np.stack([0.4 + 0.3 * np.sin(1.9 * t), 0.2 * np.cos(1.6 * t) - 1.2, 0.3 + 0.2 * np.sin(2.3 * t)], axis=1)
    facing = Rotation.from_matrix(np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]]).T[[2, 0, 1]])
    return (facing * Rotation.from_rotvec(angles)).as_matrix(), position


def _trajectory() -> Trajectory:
    t = 0.05 * np.arange(N_KEYFRAMES)
    rotation, position = pose_at(t)
    return Trajectory(
        seconds=t,
        rotation=rotation,
        position=position,
        velocity=np.gradient(position, t, axis=0),
        gyro_bias=1e-3 * np.stack([np.cos(0.1 * t), np.sin(0.1 * t), 0.1 * t], axis=1),
        accel_bias=1e-2 * np.stack([np.sin(0.1 * t), np.cos(0.2 * t), -0.1 * t], axis=1),
    )


def _corners(name: str, path: Trajectory, target: AprilGrid, rng: np.random.Generator) -> CornerResiduals:
    fx, fy, cx, cy = INTRINSICS[name]
    point = np.concatenate(
        [np.sort(rng.choice(len(target.points), CORNERS_PER_IMAGE, replace=False)) for _ in range(N_KEYFRAMES)]
    )
    image = np.repeat(np.arange(N_KEYFRAMES), CORNERS_PER_IMAGE)
    shift = path.position[image, :2] - path.position[:, :2].mean(axis=0)
    xy = target.points[point, :2] - 0.35 + shift
    uv = np.stack([cx + fx * xy[:, 0] / 1.2, cy + fy * xy[:, 1] / 1.2], axis=1)
    inside = ((uv > 0.0) & (uv < [752, 480])).all(axis=1)
    image, point, uv = image[inside], point[inside], uv[inside]
    rejected = rng.random(len(uv)) < 0.01
    residual = 0.2 * rng.normal(size=uv.shape) * np.where(rejected, 12.0, 1.0)[:, None]
    residual[:, 0] += 1e-4 * (uv[:, 0] - cx)
    start = np.concatenate([[0], np.cumsum(np.bincount(image, minlength=N_KEYFRAMES))])
    return CornerResiduals(name, path.seconds - 1e-4, start, point, uv, residual, np.full(len(uv), 0.2), rejected)


def _fits():
    for cam in POSES:
        yield SensorFit(cam, "corners", 20400, 19800.5, 20011.2, 0.203, "px", 102)
    yield SensorFit("imu0", "gyroscope", 897, 610.4, 640.0)
    yield SensorFit("imu0", "accelerometer", 897, 64.0, 163.8)
    yield SensorFit("imu0", "bias walk", 1794, 0.0, 0.0)


def _iterations():
    cost, damping = 4e6, 1e-4
    for stage, n in (("first", 6), ("noise", 4), ("final", 3)):
        for k in range(n):
            accepted = not (stage == "first" and k == 2)
            yield Iteration(stage, cost, 0.9 * cost * 0.1**k, damping, accepted)
            cost, damping = (
                (2e4 + 0.08 * (cost - 2e4), 0.0 if k > 2 else 0.1 * damping) if accepted else (cost, damping)
            )


ROBOT_POSES = {"lidar0": ([2.0, -1.5, 8.0], [0.02, 0.03, 0.18]), "wheel0": ([3.0, 2.0, -3.0], [-0.15, 0.04, -0.33])}
WALLS = (([1.0, 0.0, 0.0], [6.0, 0.5, 1.0]), ([0.0, -1.0, 0.0], [0.0, 5.0, 1.2]), ([0.0, 0.0, 1.0], [0.3, 0.2, 0.0]))


@pytest.fixture(scope="session")
def robot(calibration: Calibration) -> Calibration:
    """The same with a LiDAR, which sees two walls and the floor, and wheels."""
    rng, rig = np.random.default_rng(8), _rig().with_(lidars=(LIDAR,), wheels=(WHEELS,))
    groups = list(calibration.groups)
    for name, (rpy, position) in ROBOT_POSES.items():
        R = Rotation.from_euler("xyz", rpy, degrees=True).as_matrix()
        values: dict[str, object] = {"rotation": R, "translation": position, "time_offset": [-0.01]}
        values |= {"radii": [0.1, 0.102], "baseline": [0.42]} if name == "wheel0" else {}
        for key, value in values.items():
            groups.append(_group(groups, name, key, value, False))
    names = tuple(f"{g.sensor}.{g.name}.{n}" for g in groups if g.columns for n in g.labels)
    seconds = 0.05 * np.arange(N_KEYFRAMES - 1)
    whitened = rng.normal(size=(len(seconds), 4))
    labels, units = ("left", "right", "lateral", "vertical"), ("rad", "rad", "m", "m")
    fits = (SensorFit("lidar0", "points", 40000, 39900.0, 40100.0, 0.03, "m"),)
    fits += (SensorFit("wheel0", "lateral slip", 299, 297.0, 310.0, 1.1e-3, "m"),)
    return dataclasses.replace(
        calibration,
        groups=tuple(groups),
        covariance=_covariance(tuple(groups), rng),
        covariance_names=names,
        null_space=_null_space(names),
        cross_validation=_held_out(tuple(groups)),
        rig=rig_to_dict(rig),
        fits=(*calibration.fits, *fits),
        residuals=calibration.residuals
        | by_key(
            [_points(rng), RowResiduals("wheel0", "increments", labels, units, seconds, 1e-3 * whitened, whitened)]
        ),
        planes=tuple(Plane(f"plane {k}", np.array(n), np.array(p), 9000 + k) for k, (n, p) in enumerate(WALLS)),
    )


@pytest.fixture(scope="session")
def without_cameras(robot: Calibration) -> Calibration:
    """What is left of it where there is neither camera nor target."""
    gone = (*POSES, "board0")
    groups, columns = [], []
    for g in robot.groups:
        if g.sensor not in gone and g.columns:
            groups.append(dataclasses.replace(g, columns=tuple(range(len(columns), len(columns) + len(g.columns)))))
            columns += g.columns
    rig = {"sensors": {n: s for n, s in robot.rig["sensors"].items() if n not in gone}}
    return dataclasses.replace(
        robot,
        groups=tuple(groups),
        covariance=robot.covariance[np.ix_(columns, columns)],
        covariance_names=tuple(robot.covariance_names[k] for k in columns),
        null_space=np.zeros((len(columns), 0)),
        fits=tuple(f for f in robot.fits if f.sensor not in gone),
        residuals={key: r for key, r in robot.residuals.items() if key[0] not in gone},
        unobservable=(),
        rig=rig,
        cross_validation=None,
    )


def _points(rng: np.random.Generator) -> LidarResiduals:
    """Points of walls about the LiDAR, which is at the origin, with noise along the walls' normals."""
    n = 6000
    plane = np.arange(n, dtype=np.int32) % len(WALLS)
    normal, point = (np.array([wall[i] for wall in WALLS])[plane] for i in (0, 1))
    along = rng.uniform(-3.0, 3.0, (n, 3))
    flat = point + along - np.einsum("na,na,nb->nb", along, normal, normal)
    residual, first = 0.03 * rng.normal(size=n), 0.2 * rng.normal(size=n)
    world, first_world = (flat + r[:, None] * normal for r in (residual, first))
    seconds, sigma = np.sort(rng.uniform(0.0, 15.0, n)), np.full(n, 0.03)
    columns = (np.linalg.norm(world, axis=1), sigma, world, residual, first_world, first)
    return LidarResiduals("lidar0", 150, 90_000, 40_000, seconds, plane, *(x.astype(np.float32) for x in columns))
