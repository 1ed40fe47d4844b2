"""What a result keeps and says of LiDARs: points on planes, and what speaks against their stamps and planes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.assembly import motion_of
from icalib.estimate.problem.inputs import Inputs, origin_difference
from icalib.geometry.planes import plane_of
from icalib.motion.clocks import instants
from icalib.motion.factor import of_type
from icalib.motion.keyframe_placement import usable
from icalib.optim.state import State
from icalib.result import Plane, SensorFit
from icalib.result.excess import excess, times
from icalib.result.timeline import Timeline
from icalib.rig import Lidar, Rig
from icalib.sensors.lidar.binning import LidarNoise, in_world
from icalib.sensors.lidar.initialize.degeneracy import count_of, facing
from icalib.sensors.lidar.record import LidarResiduals
from icalib.sensors.lidar.residual import LidarFactor

MOST_POINTS = 200_000  # kept of all LiDARs together
FEWEST_FITTED = 4  # points of a plane
FEW_ON_PLANES = 0.2  # of the points
NEARLY_A_PERIOD = 0.15  # of the period
# Relative error of the times of points within a scan: 0.0015 where they are right, 0.06 and more where they are half or
# twice as long; and the number of standard deviations at which it is significant.
STRETCHED, CLEARLY = 0.03, 10.0
HALF_STEP_S = np.float32(2e-3)  # of a difference of residuals


def planes(inputs: Inputs, state: State) -> Iterator[Plane]:
    """Where the planes are."""
    clouds = inputs.clouds
    found = (state.values[key] for key in clouds.keys)
    for name, v, n in zip(clouds.names, found, clouds.points if clouds.count else (), strict=True):
        yield Plane(name, v[:3].copy(), v[3:].copy(), int(n))


def residuals(inputs: Inputs, found: Estimate, timeline: Timeline) -> Iterator[LidarResiduals]:
    """Of each LiDAR that takes part, evenly thinned."""
    if not inputs.clouds.count:
        return
    state = found.outcome.state
    now, first = motion_of(inputs, state), motion_of(inputs, inputs.guess or state)
    values = np.array([state.values[key] for key in inputs.clouds.keys])
    thinned = [_thinned(inputs, k, state) for k in range(len(inputs.rig.lidars))]
    before = [in_world(first, stream) for stream, _ in thinned]
    guessed = _fitted([(points, plane) for (points, _), (_, plane) in zip(before, thinned, strict=True)], values)
    for whole, (stream, plane), (first_world, seen_from) in zip(
        inputs.measurements.lidars, thinned, before, strict=True
    ):
        seconds = _seconds_of(stream, state)
        world, at = in_world(now, stream)
        residual, cosine = _on_planes(world, at, values[plane])
        first_residual, _ = _on_planes(first_world, seen_from, guessed[plane])
        yield LidarResiduals(
            stream.name,
            len(whole.stamps_ns),
            len(whole.xyz),
            _used(found, stream.name),
            timeline.shown(seconds, timeline.recording_of(seconds)),
            plane,
            np.linalg.norm(stream.xyz, axis=1),
            _sigma(found.judged.noise[stream.name], cosine),
            world,
            residual,
            first_world,
            first_residual,
        )


def _thinned(inputs: Inputs, index: int, state: State) -> tuple[LidarStream, np.ndarray]:
    """Fewer points of a LiDAR, all seen while the IMU was running, and the plane (N,) that each lies on."""
    assert inputs.imu is not None
    stream, plane = inputs.measurements.lidars[index], inputs.clouds.plane[index]
    own = np.flatnonzero(plane >= 0)
    own = own[:: max(1, -(-len(own) * len(inputs.rig.lidars) // MOST_POINTS))]
    one = _some_points(stream, own)
    running = usable(inputs.imu, _seconds_of(one, state), inputs.rig.settings.max_gap_s)
    return _some_points(one, np.flatnonzero(running)), plane[own[running]]


def _fitted(clouds: list[tuple[np.ndarray, np.ndarray]], values: np.ndarray) -> np.ndarray:
    """(P, 6) planes that fit points (N, 3) best, of which plane (N,) each lies on is known; where there are too few,
    and which side is up, as in `values` (P, 6)."""
    out = values.copy()
    for k in range(len(values)):
        own = np.concatenate([points[plane == k] for points, plane in clouds]).astype(np.float64)
        if len(own) >= FEWEST_FITTED:
            centre = own.mean(axis=0)
            normal = np.linalg.eigh(np.cov(own.T))[1][:, 0]
            out[k] = plane_of(np.copysign(1.0, normal @ values[k, :3]) * normal, centre)
    return out


def _some_points(stream: LidarStream, own: np.ndarray) -> LidarStream:
    """The points `own`, increasing, of all scans."""
    start = np.searchsorted(own, stream.start)
    columns = {name: getattr(stream, name)[own] for name in ("offset_s", "xyz", "plane")}
    return replace(stream, start=start, **columns)


def _seconds_of(stream: LidarStream, state: State) -> np.ndarray:
    """(N,) instants of the points, seconds on the joined clock of the body."""
    stamps = np.repeat(stream.seconds, np.diff(stream.start))
    return instants(stream, state.values, stamps) + stream.offset_s


def _on_planes(points: np.ndarray, seen_from: np.ndarray, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of points (N, 3) in the world the distance (N,) of each to its plane (N, 6), float32; cosine (N,) of the angle
    between its beam and the plane's normal."""
    normal, beam = planes[:, :3], points - seen_from
    residual = np.einsum("na,na->n", normal, points - planes[:, 3:])
    cosine = np.einsum("na,na->n", normal, beam) / np.linalg.norm(beam, axis=1)
    return residual.astype(np.float32), cosine


def _sigma(noise: LidarNoise, cosine: np.ndarray) -> np.ndarray:
    return np.sqrt(noise.sigma**2 + (noise.beam_sigma * cosine) ** 2).astype(np.float32)


def _used(found: Estimate, name: str) -> int:
    return sum(int(f.moments.count.sum()) for f in of_type(found.problem.factors, LidarFactor) if f.name == name)


def notes(inputs: Inputs, found: Estimate, timeline: Timeline) -> Iterator[str]:
    """How many points are in use, and their noise."""
    if not inputs.clouds.count:
        return
    ranging = [found.judged.noise[s.name] for s in inputs.rig.lidars]
    for lidar, stream, noise in zip(inputs.rig.lidars, inputs.measurements.lidars, ranging, strict=True):
        given = lidar.range_noise_m is not None
        size = f"{1e3 * noise.beam_sigma:.1f} mm along the beam, as the rig file has it"
        if not given:
            size = f"{1e3 * noise.sigma:.1f} mm from their planes, as residuals show it"
        yield (
            f"{_used(found, lidar.name)} of the {len(stream.xyz)} points of {lidar.name} lie on "
            f"{inputs.clouds.count} planes; noise {size}."
        )


def warnings(inputs: Inputs, found: Estimate) -> Iterator[str]:
    """Where few points lie on planes, planes face too few directions, or stamps are those of a scan's other end."""
    if not inputs.clouds.count:
        return
    yield from _sight_warnings(inputs, found)
    for index, (lidar, stream) in enumerate(zip(inputs.rig.lidars, inputs.measurements.lidars, strict=True)):
        stretch, std = _stretch(inputs, found, index)
        if abs(stretch) > max(STRETCHED, CLEARLY * std):
            yield (
                f"the times of points within a scan of {lidar.name} seem too {'short' if stretch > 0.0 else 'long'}, "
                "or in the wrong order: points lie off their planes in proportion to the motion. Check their unit, "
                "their origin and the sense of rotation, or set point_time in the rig file."
            )
        share = _used(found, lidar.name) / max(len(stream.xyz), 1)
        if share < FEW_ON_PLANES:
            yield (
                f"only {share:.1%} of the points of {lidar.name} lie on planes; there is little flat in sight, or the "
                "times of its points, their order within a scan, or its range_noise in the rig file are wrong."
            )
        own = found.outcome.state.values[lidar.name, "time_offset"] - origin_difference(inputs.measurements, stream)
        period = float(np.median(np.diff(stream.seconds)))
        offset = float(own[np.argmin(np.abs(np.abs(own) - period))])
        if abs(abs(offset) - period) < NEARLY_A_PERIOD * period:
            yield (
                f"the time_offset of {lidar.name}, {offset:+.4f} s, is about the period of its scans: its stamps may "
                "be those of the end of a scan while times of points count from its start, or the other way; see "
                "point_time."
            )


def _stretch(inputs: Inputs, found: Estimate, index: int) -> tuple[float, float]:
    """By which share of themselves the times of points within a scan look too short, and its standard deviation.

    A point that is taken at a wrong instant is off its plane by how fast it moves along the normal; a time offset takes
    up what all points of a scan have in common.
    """
    state = found.outcome.state
    motion, values = motion_of(inputs, state), np.array([state.values[key] for key in inputs.clouds.keys])
    stream, plane = _thinned(inputs, index, state)
    if len(plane) < FEWEST_FITTED:
        return 0.0, np.inf
    later, earlier = (
        _on_planes(*in_world(motion, replace(stream, offset_s=stream.offset_s + step)), values[plane])[0].astype(float)
        for step in (HALF_STEP_S, -HALF_STEP_S)
    )
    speed = (later - earlier) / (2.0 * float(HALF_STEP_S))
    by_stretch = speed * (stream.offset_s - stream.offset_s.mean(dtype=np.float64))
    residual = 0.5 * (later + earlier)
    information = max(float(by_stretch @ by_stretch), 1e-30)
    return -float(by_stretch @ residual) / information, float(residual.std()) / np.sqrt(information)


def _sight_warnings(inputs: Inputs, found: Estimate) -> Iterator[str]:
    """Where LiDARs alone show the motion, and not all of it."""
    if any(s.gives_motion for s in inputs.rig.mounted if not isinstance(s, Lidar)):
        return
    normals = np.array([found.outcome.state.values[key][:3] for key in inputs.clouds.keys])
    if count_of(facing(normals, inputs.clouds.points)) < 3:
        names = " and ".join(x.name for x in inputs.rig.lidars)
        yield (
            f"the planes that {names} saw face two directions only, as in a corridor: how it moved along both the IMU "
            "alone says. Do not trust the result if the solver did not converge; better record where walls and floor "
            "face three directions."
        )


def misfit(lidar: Lidar, f: SensorFit, is_noise: bool) -> str | None:
    """A sentence where points are farther from planes than the rig file states."""
    if excess(f) == 1.0 or lidar.range_noise_m is None:
        return None
    return (
        f"residuals of the points of {f.sensor} are {times(f)} larger than its range_noise predicts; leave it out, "
        "and it is estimated."
    )


def length(lidar: Lidar, rig: Rig) -> str | None:
    """What shows how long a metre is."""
    return f"the ranges of {lidar.name}"
