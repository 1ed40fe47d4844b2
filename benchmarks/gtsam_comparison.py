"""The same least-squares problem by icalib and by GTSAM: time, and how far apart the extrinsics come out.

Both: keyframes at the images of cam0, preintegrated IMU with bias walks, direction of gravity and both extrinsics
estimated, intrinsics and time offsets fixed (offsets 0: cameras and IMU share a clock), no robust loss, no corner
rejected, the same noise and the same first state.

GTSAM's projection factor with the extrinsics as a variable, ProjectionFactorPPP of gtsam_unstable, wants each target
point to be a variable too; a tight prior fixes them. That costs GTSAM time: `linearise_once`, the part of an iteration
that the points hardly slow, bounds from below what a factor with fixed points would take.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator

import gtsam
import gtsam_unstable
import numpy as np
from gtsam.symbol_shorthand import B, L, T, V, X

from icalib.data.measurements import CornerStream, ImuStream, Measurements
from icalib.estimate.estimate import Estimate, estimate
from icalib.estimate.inputs import Inputs, inputs_for
from icalib.optim.state import State
from icalib.rig import Rig
from icalib.sensors.camera.initialize import initial_state
from icalib.sensors.camera.initialize.target_with_imu import initial_guess
from icalib.sensors.parameter import fixed

SECONDS = 20.0  # of the recording, from its first image on
POINT_SIGMA_M = 1e-6
GRAVITY_KEY = gtsam.symbol("g", 0)


def compare(rig: Rig, measurements: Measurements) -> Iterator[tuple[str, float, str]]:
    """(name, value, unit) of each figure; `rig` has the plain model with fixed intrinsics."""
    rig, measurements = _like_for_like(rig), excerpt(measurements, SECONDS)
    inputs = inputs_for(rig, [measurements])
    state = initial_state(inputs, initial_guess(rig, measurements))
    estimate(inputs, state)
    started = time.perf_counter()
    ours = estimate(inputs, state)
    covariance = np.linalg.inv(ours.outcome.information)
    seconds = time.perf_counter() - started

    laps = [time.perf_counter()]
    graph, values = build(inputs, state)
    laps.append(time.perf_counter())
    iterations, theirs, ordering = optimised(graph, values, len(rig.cameras))
    laps.append(time.perf_counter())
    theirs_covariance = extrinsics_covariance(graph, theirs, ordering, len(rig.cameras))
    laps.append(time.perf_counter())
    graph.linearize(theirs)
    laps.append(time.perf_counter())
    yield "recording", SECONDS, "s"
    yield "corners", sum(len(c.uv) for c in measurements.cameras), "1"
    yield "icalib_time", seconds, "s"
    yield "icalib_iterations", len(ours.steps), "1"
    for name, lap in zip(("build", "solve", "covariance", "linearise_once"), np.diff(laps).tolist(), strict=True):
        yield f"{name}_time", lap, "s"
    yield "iterations", iterations, "1"
    yield "time_over_icalib_time", (laps[3] - laps[0]) / seconds, "1"
    yield from _differences("euler.", inputs, ours, covariance, theirs, theirs_covariance)
    _, theirs, _ = optimised(*build(inputs, state, half_turn=True), len(rig.cameras))
    yield from _differences("half_turn.", inputs, ours, covariance, theirs, theirs_covariance)


def _like_for_like(rig: Rig) -> Rig:
    cameras = tuple(dataclasses.replace(c, time_offset=fixed([0.0])) for c in rig.cameras)
    return rig.with_(cameras=cameras, settings=dataclasses.replace(rig.settings, loss="none", outlier_std=0.0))


def excerpt(measurements: Measurements, seconds: float) -> Measurements:
    """The first `seconds`: all instants at which the IMU runs and every camera has an image, and the IMU's readings."""
    common = measurements.cameras[0].stamps_ns
    for camera in measurements.cameras[1:]:
        common = np.intersect1d(common, camera.stamps_ns)
    imu = measurements.imu
    common = common[(common >= imu.stamps_ns[0]) & (common <= imu.stamps_ns[-1])]
    common = common[common <= common[0] + round(seconds * 1e9)]

    def some(s: CornerStream) -> CornerStream:
        chosen = np.isin(s.stamps_ns, common)
        corners = np.repeat(chosen, np.diff(s.start))
        start = np.concatenate([[0], np.cumsum(np.diff(s.start)[chosen])])
        return CornerStream(s.name, s.stamps_ns[chosen], start, s.point[corners], s.uv[corners])

    i = np.searchsorted(imu.stamps_ns, common[0], "right") - 1
    j = np.searchsorted(imu.stamps_ns, common[-1], "left") + 1
    part = ImuStream(imu.name, imu.stamps_ns[i:j], imu.gyro[i:j], imu.accel[i:j])
    return Measurements.of_streams(part, *(some(s) for s in measurements.cameras))


def build(inputs: Inputs, state: State, half_turn: bool = False) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The graph and its first values; GTSAM's world is the target's frame, so gravity's direction is a variable.

    half_turn: see `_add_imu`.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    R_wb = state.values["board0", "tilt"]
    values.insert(GRAVITY_KEY, gtsam.Unit3(R_wb.T @ [0.0, 0.0, -1.0]))
    for k in range(len(state.seconds)):
        pose = gtsam.Pose3(gtsam.Rot3(R_wb.T @ state.rotation[k]), R_wb.T @ state.position[k])
        values.insert(X(k), pose)
        values.insert(V(k), R_wb.T @ state.velocity[k])
        values.insert(B(k), gtsam.imuBias.ConstantBias(state.bias[k, 3:], state.bias[k, :3]))
    _add_imu(graph, inputs, state, half_turn)
    points = inputs.rig.target.points
    tight = gtsam.noiseModel.Isotropic.Sigma(3, POINT_SIGMA_M)
    for j in np.unique(np.concatenate([s.point for s in inputs.measurements.cameras])).tolist():
        values.insert(L(j), points[j])
        graph.add(gtsam.PriorFactorPoint3(L(j), points[j], tight))
    for c in range(len(inputs.rig.cameras)):
        _add_camera(graph, values, inputs, state, c)
    return graph, values


def _add_imu(graph: gtsam.NonlinearFactorGraph, inputs: Inputs, state: State, half_turn: bool) -> None:
    """GTSAM turns the specific force of a step by the attitude at the step's start (Euler), off by half of the turn in
    5 ms; `half_turn` turns the force by that half beforehand, to show what of the difference this is."""
    noise, gravity, imu = inputs.rig.imu.noise, inputs.rig.gravity, inputs.imu
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity)
    params.setGyroscopeCovariance(noise.gyro**2 * np.eye(3))
    params.setAccelerometerCovariance(noise.accel**2 * np.eye(3))
    params.setBiasOmegaCovariance(noise.gyro_walk**2 * np.eye(3))
    params.setBiasAccCovariance(noise.accel_walk**2 * np.eye(3))
    params.setIntegrationCovariance(1e-12 * np.eye(3))
    bias = gtsam.imuBias.ConstantBias(state.bias[0, 3:], state.bias[0, :3])
    for k, (a, b) in enumerate(zip(state.seconds[:-1], state.seconds[1:], strict=True)):
        inner = imu.seconds[(imu.seconds > a + 1e-6) & (imu.seconds < b - 1e-6)]
        edges = np.concatenate([[a], inner, [b]])
        middle = 0.5 * (edges[:-1] + edges[1:])  # readings change linearly between stamps: their mean over each step
        accel, gyro = (
            np.stack([np.interp(middle, imu.seconds, u[:, i]) for i in range(3)], axis=1) for u in (imu.accel, imu.gyro)
        )
        dt = np.diff(edges)
        if half_turn:
            turns = 0.5 * dt[:, None] * (gyro - bias.gyroscope())
            force = zip(turns, accel - bias.accelerometer(), strict=True)
            accel = np.stack([gtsam.Rot3.Expmap(h).rotate(f) for h, f in force]) + bias.accelerometer()
        increments = gtsam.PreintegratedCombinedMeasurements(params, bias)
        for f, w, step in zip(accel, gyro, dt.tolist(), strict=True):
            increments.integrateMeasurement(f, w, step)
        keys = X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), GRAVITY_KEY
        graph.add(gtsam.CombinedImuFactorWithGravityDirection(*keys, increments, gravity))


def _add_camera(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, inputs: Inputs, state: State, c: int) -> None:
    camera, stream = inputs.rig.cameras[c], inputs.measurements.cameras[c]
    fx, fy, cx, cy = state.values[camera.name, "intrinsics"]
    calibration = gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, *state.values[camera.name, "distortion"])
    values.insert(
        T(c), gtsam.Pose3(gtsam.Rot3(state.values[camera.name, "rotation"]), state.values[camera.name, "translation"])
    )
    assert camera.corner_noise_px is not None
    noise = gtsam.noiseModel.Isotropic.Sigma(2, camera.corner_noise_px)
    times = stream.seconds + state.values[camera.name, "time_offset"][0]
    keyframe = np.searchsorted(state.seconds, times - 1e-3)[stream.image].tolist()
    for k, j, uv in zip(keyframe, stream.point.tolist(), stream.uv, strict=True):
        graph.add(gtsam_unstable.ProjectionFactorPPPCal3DS2(uv, noise, X(k), T(c), L(j), calibration))


def optimised(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, cameras: int):
    """Iterations, the values found, and the ordering of the elimination, which ends with the extrinsics."""
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-9)
    params.setAbsoluteErrorTol(5e-4)  # as icalib: half the chi^2 falls by less
    last = gtsam.KeyVector([T(c) for c in range(cameras)])
    ordering = gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, last, False)
    params.setOrdering(ordering)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    solution = optimizer.optimize()
    return optimizer.iterations(), solution, ordering


def extrinsics_covariance(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering, cameras: int
) -> list[np.ndarray]:
    """(6, 6) of each camera. By eliminating all else: gtsam.Marginals gives the same in four times the time."""
    others, extrinsics = gtsam.Ordering(), gtsam.Ordering()
    for i in range(ordering.size() - cameras):
        others.push_back(ordering.at(i))
    for c in range(cameras):
        extrinsics.push_back(T(c))
    _, rest = graph.linearize(values).eliminatePartialMultifrontal(others)
    covariance = np.linalg.inv(rest.hessian(extrinsics)[0])
    return [covariance[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] for c in range(cameras)]


def _differences(
    variant: str,
    inputs: Inputs,
    ours: Estimate,
    covariance: np.ndarray,
    theirs: gtsam.Values,
    theirs_covariance: list[np.ndarray],
) -> Iterator[tuple[str, float, str]]:
    """Angle and distance between the two extrinsics, and the ratio of their formal standard deviations."""
    v = ours.outcome.state.values
    for c, camera in enumerate(inputs.rig.cameras):
        pose = theirs.atPose3(T(c))
        turn = gtsam.Rot3.Logmap(gtsam.Rot3(v[camera.name, "rotation"].T @ pose.rotation().matrix()))
        move = pose.translation() - v[camera.name, "translation"]
        yield f"{variant}{camera.name}_rotation_difference", float(np.rad2deg(np.linalg.norm(turn))), "deg"
        yield f"{variant}{camera.name}_translation_difference", 1e3 * float(np.linalg.norm(move)), "mm"
        columns = np.concatenate([inputs.layout.columns(camera.name, n) for n in ("rotation", "translation")])
        sigma = np.sqrt(np.diag(covariance)[columns])
        in_sigmas = np.abs(np.concatenate([turn, move])) / sigma
        yield f"{variant}{camera.name}_difference_over_sigma_max", in_sigmas.max(), "1"
        # GTSAM perturbs the translation along the camera's axes, icalib along the IMU's.
        A = np.eye(6)
        A[3:, 3:] = pose.rotation().matrix()
        ratio = sigma / np.sqrt(np.diag(A @ theirs_covariance[c] @ A.T))
        yield f"{variant}{camera.name}_sigma_over_gtsam_sigma_min", ratio.min(), "1"
        yield f"{variant}{camera.name}_sigma_over_gtsam_sigma_max", ratio.max(), "1"
