"""What an estimate leaves of points on planes, of wheels and of pose sensors, and what there is to say about it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.assembly import motion_of
from icalib.estimate.problem.inputs import Inputs, origin_difference
from icalib.geometry.planes import plane_of
from icalib.initialize.lidar.lidar_sight import count_of, facing
from icalib.motion.clocks import instants
from icalib.motion.factor import Whitened, of_type
from icalib.motion.nodes import usable
from icalib.optim.state import State
from icalib.result import Plane, RowResiduals, SensorFit
from icalib.result.excess import excess, times
from icalib.result.timeline import Timeline
from icalib.rig import PoseSensor, Rig, Wheels
from icalib.sensors.lidar.lidar_binning import LidarNoise, in_world
from icalib.sensors.lidar.record import LidarResiduals
from icalib.sensors.lidar.residual import LidarFactor
from icalib.sensors.pose.residual import AbsolutePoseFactor, PoseNoise, RelativePosesFactor
from icalib.sensors.wheels.ground_factor import HEIGHT, TILT, GroundFactor
from icalib.sensors.wheels.residual import IncrementFactor, RelativePoseFactor

MOST_POINTS = 200_000  # kept of all LiDARs together
FEWEST_FITTED = 4
FEW_ON_PLANES = 0.2  # of the points
NEARLY_A_PERIOD = 0.15  # of the period
# Of the times of points within a scan: by how much they may look stretched, against 0.0015 where they are right, 0.06
# and more where they are half or twice as long; and in how many standard deviations it must show.
STRETCHED, CLEARLY = 0.03, 10.0
HALF_STEP_S = np.float32(2e-3)  # of a difference of residuals
# Correlations of residuals of poses with their neighbours. Of white noise between poses, steps have -0.5.
CORRELATED, ALTERNATING = 0.5, 0.35
CLIP = 4.0  # standard deviations
LABELS = {"wheels": ("left", "right"), "lateral slip": ("lateral",), "vertical slip": ("vertical",)} | {
    "yaw": ("yaw",),
    "path": ("forward", "lateral"),
    "speed": ("speed",),
    "wheel": ("wheel",),
    "steering": ("steering",),
}


def planes(inputs: Inputs, state: State) -> tuple[Plane, ...]:
    """Where the planes are."""
    clouds = inputs.clouds
    found = (state.values[key] for key in clouds.keys)
    return tuple(
        Plane(name, v[:3].copy(), v[3:].copy(), int(n))
        for name, v, n in zip(clouds.names, found, clouds.points if clouds.count else (), strict=True)
    )


def lidar_residuals(inputs: Inputs, found: Estimate, timeline: Timeline) -> tuple[LidarResiduals, ...]:
    """Of each LiDAR that takes part, evenly thinned."""
    if not inputs.clouds.count:
        return ()
    state = found.outcome.state
    now, first = motion_of(inputs, state), motion_of(inputs, inputs.guess or state)
    values = np.array([state.values[key] for key in inputs.clouds.keys])
    thinned = [_thinned(inputs, k, state) for k in range(len(inputs.rig.lidars))]
    before = [in_world(first, stream) for stream, _ in thinned]
    guessed = _fitted([(points, plane) for (points, _), (_, plane) in zip(before, thinned, strict=True)], values)
    out = []
    for whole, (stream, plane), (first_world, seen_from) in zip(
        inputs.measurements.lidars, thinned, before, strict=True
    ):
        seconds = _seconds_of(stream, state)
        world, at = in_world(now, stream)
        residual, cosine = _on_planes(world, at, values[plane])
        first_residual, _ = _on_planes(first_world, seen_from, guessed[plane])
        out.append(
            LidarResiduals(
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
        )
    return tuple(out)


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


def wheel_residuals(inputs: Inputs, found: Estimate, timeline: Timeline) -> tuple[RowResiduals, ...]:
    """Of each set of wheels."""
    out = []
    for key, factor in found.problem.factors.items():
        if not isinstance(factor, IncrementFactor | RelativePoseFactor):
            continue
        rows = found.outcome.residuals[key]
        seconds = instants(inputs.stream(factor.name), found.outcome.state.values)[factor.intervals.first]
        residual = np.linalg.solve(factor.whitening, rows.residual[:, :, None])[:, :, 0]
        labels = [(label, factor.units[kind]) for kind in factor.kinds for label in LABELS[kind]]
        names, units = zip(*labels, strict=True)
        shown = timeline.shown(seconds, timeline.recording_of(seconds))
        out.append(RowResiduals(factor.name, "increments", names, units, shown, residual, rows.residual.copy()))
    return tuple(out)


def pose_residuals(inputs: Inputs, found: Estimate, timeline: Timeline) -> tuple[RowResiduals, ...]:
    """Of each pose sensor."""
    out = []
    labels = tuple(f"{kind} {axis}" for kind in ("rotation", "position") for axis in "xyz")
    for factor, rows in _pose_factors(found):
        seconds = instants(inputs.stream(factor.name), found.outcome.state.values, factor.instants)
        shown = timeline.shown(seconds, timeline.recording_of(seconds))
        units = ("rad",) * 3 + ("m",) * 3
        whitened = rows.residual.copy()
        out.append(RowResiduals(factor.name, "poses", labels, units, shown, whitened * factor.sigma, whitened))
    return tuple(out)


def robot_notes(inputs: Inputs, found: Estimate) -> Iterator[str]:
    """How much of LiDARs and pose sensors is in use, and their noise."""
    counts = {f.name: f.count(out, "rotation") // 3 for f, out in _pose_factors(found)}
    posing = [found.judged.noise[s.name] for s in inputs.rig.poses]
    for sensor, stream, noise in zip(inputs.rig.poses, inputs.measurements.poses, posing, strict=True):
        what = "poses" if sensor.kind == "absolute" else "steps"
        count = f"{counts[sensor.name]} {what} from {len(stream.stamps_ns)} poses"
        yield f"{count} of {sensor.name}; {_noise(sensor, noise)}."
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


def _pose_factors(found: Estimate) -> list[tuple[AbsolutePoseFactor | RelativePosesFactor, Whitened]]:
    pairs = [(f, found.outcome.residuals[key]) for key, f in found.problem.factors.items()]
    return [(f, out) for f, out in pairs if isinstance(f, AbsolutePoseFactor | RelativePosesFactor)]


def _noise(sensor: PoseSensor, noise: PoseNoise) -> str:
    root = "" if sensor.kind == "absolute" else "/sqrt(s)"
    turn = f"{np.rad2deg(noise.rotation):.3g} deg{root} {_source(sensor.rotation_noise)}"
    return f"noise {turn}, {1e3 * noise.position:.3g} mm{root} {_source(sensor.position_noise)}"


def _source(given: float | None) -> str:
    return "as residuals show it" if given is None else "as the rig file has it"


def pose_warnings(residuals: tuple[RowResiduals, ...], rig: Rig) -> Iterator[str]:
    """Where residuals of poses follow one another, which noise does not."""
    kinds = {s.name: s.kind for s in rig.poses}
    for r in residuals:
        for what, own in (("rotation", r.whitened[:, :3]), ("position", r.whitened[:, 3:])):
            correlation = neighbours(own)
            if kinds[r.sensor] == "absolute" and correlation > CORRELATED:
                yield (
                    f"the {what} residuals of {r.sensor} follow one another (correlation {correlation:.2f} from pose "
                    "to pose): its poses are filtered, or drift, so all looks better known than it is; trust the "
                    "empirical factor, or try kind: relative, which lets poses drift."
                )
            if kinds[r.sensor] == "relative" and correlation < -ALTERNATING:
                yield (
                    f"the {what} residuals of {r.sensor} alternate (correlation {correlation:.2f} from step to step), "
                    "as those of poses that are noisy but do not drift; try kind: absolute."
                )


def neighbours(rows: np.ndarray) -> float:
    """Correlation of rows (n, 3) with the ones before, large ones clipped; 0 where there are none."""
    clipped = np.clip(rows, -CLIP, CLIP)
    return float((clipped[1:] * clipped[:-1]).sum() / max((clipped**2).sum(), 1e-30))


def ground_warnings(found: Estimate) -> Iterator[str]:
    """Where wheels are said to stand on a floor that is not seen."""
    for factor in of_type(found.problem.factors, GroundFactor):
        if not len(factor.nodes):
            yield (
                f"none of the planes that LiDARs see is a floor (nearly level and below the IMU), so the ground of "
                f"{factor.name} counts for nothing; see that a LiDAR sees it, or write plane: level."
            )


def lidar_warnings(inputs: Inputs, found: Estimate) -> Iterator[str]:
    """Where few points lie on planes, planes face too few directions, none is the floor that it must be, or stamps are
    those of a scan's other end."""
    yield from _sight_warnings(inputs, found)
    yield from ground_warnings(found)
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
    if inputs.rig.cameras or inputs.rig.poses:
        return
    normals = np.array([found.outcome.state.values[key][:3] for key in inputs.clouds.keys])
    if count_of(facing(normals, inputs.clouds.points)) < 3:
        names = " and ".join(x.name for x in inputs.rig.lidars)
        yield (
            f"the planes that {names} saw face two directions only, as in a corridor: how it moved along both the IMU "
            "alone says. Do not trust the result if the solver did not converge; better record where walls and floor "
            "face three directions."
        )


def robot_misfit(rig: Rig, f: SensorFit, is_noise: bool) -> str | None:
    """A sentence where points, poses or wheels leave more than the rig file states. is_noise: residuals are white, and
    constant over the recording; only then another size of the noise is advised."""
    if excess(f) == 1.0:
        return None
    wheels = {w.name: w for w in rig.wheels}
    if f.sensor in {x.name for x in rig.lidars if x.range_noise_m is not None}:
        return (
            f"residuals of the points of {f.sensor} are {times(f)} larger than its range_noise predicts; leave it out, "
            "and it is estimated."
        )
    if f.sensor in {x.name for x in rig.poses}:
        advice = "leave it out, and it is estimated" if is_noise else UNKNOWN
        return f"{f.kind} residuals of {f.sensor} are {times(f)} larger than its stated noise predicts; {advice}."
    return _wheel_words(f, wheels[f.sensor], is_noise) if f.sensor in wheels else None


UNKNOWN = "they are no white noise, and the cause is unknown: check its clock and mount, and record again, slower"
# Of rows of wheels: what they are, the field of the rig file that says how far off they may be, and its unit.
_ROWS = {
    "wheels": ("wheel angles", "wheel_noise", "rad/sqrt(s)"),
    "wheel": ("wheel angles", "wheel_noise", "rad/sqrt(s)"),
    "speed": ("speeds", "speed_noise", "m/sqrt(s)"),
    "yaw": ("yaw rates", "yaw_noise", "rad/sqrt(s)"),
    "steering": ("steering angles", "steering_noise", "rad/sqrt(Hz)"),
    "lateral slip": ("lateral slip", "lateral_slip", "m/sqrt(s)"),
    "vertical slip": ("vertical slip", "vertical_slip", "m/sqrt(s)"),
}


def _wheel_words(f: SensorFit, wheels: Wheels, is_noise: bool) -> str:
    if f.kind in (TILT, HEIGHT):
        field = "tilt_noise" if f.kind == TILT else "bump_noise"
        what = "tilts against" if f.kind == TILT else "moves up and down over"
        return (
            f"{wheels.name} {what} its ground {times(f)} more than {field} predicts, as on ramps or where the ground "
            "is another plane; take ground out, or that part of the recording."
        )
    relative = f.kind == "yaw" and wheels.kind == "pair"  # the paper's relative poses have a yaw, too
    what, field, unit = _ROWS.get("" if relative else f.kind, (f.kind, "", ""))
    words = f"{what} residuals of {wheels.name} are {times(f)} larger than {field or 'its noise'} predicts"
    if not is_noise:
        return f"{words}, and are no white noise, as where wheels skid; take such parts out, or drive slower."
    if not field:
        return f"{words}; use factor: increments."
    return f"{words}; write {field}: {excess(f) * getattr(wheels, field):.2g} ({unit}) and calibrate again."
