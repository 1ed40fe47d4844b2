"""Assessment of LiDARs in a result: residuals of points on planes, notes, and warnings about stamps, point times and
planes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import LidarStream
from icalib.detection.planes import count_directions, normal_shares
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs, origin_difference
from icalib.estimate.problem import motion_of
from icalib.geometry.planes import plane_of
from icalib.motion.factor import of_type
from icalib.motion.poses import instants, usable
from icalib.observability.assessor import AssessedEstimate, Assessment, Assessor, Cause, Remedy
from icalib.observability.prior_sensitivity import EFFECT_SIGMAS
from icalib.optim.state import State, plane_value
from icalib.result import Plane, SensorFit
from icalib.result.calibration import Timeline
from icalib.result.quantities import excess, times
from icalib.rig import Lidar, ParameterSpec, Rig
from icalib.sensors.lidar.assess.boards import on_boards, ranges_offset, sheet_notes, sheet_planes, wrong_sheets
from icalib.sensors.lidar.binning import LidarNoise, in_world
from icalib.sensors.lidar.patch_factor import PatchFactor
from icalib.sensors.lidar.residual import RINGS_SEEN, LidarFactor, true_points
from icalib.sensors.lidar.spec import OF_RINGS, RANGE_OFFSET, RANGE_SCALE
from icalib.sensors.lidar.stream import LidarResiduals

MAX_KEPT_POINTS = 200_000  # of all LiDARs together that a result saves: some 10 MB
MIN_FITTED_POINTS = 4  # a plane has 3 unknowns; fewer points leave no residual
MIN_SHARE_ON_PLANES = 0.2  # of all points; a smaller share means few flat surfaces or misplaced points
PERIOD_TOLERANCE = 0.15  # of the scan period; a time offset that near to a period means stamps at the wrong scan end
# Relative error of the times of points within a scan: 0.0015 for correct times, 0.06 and more for times that are half
# or twice as long.
MAX_TIME_STRETCH = 0.03
SIGNIFICANT_STRETCH = 10.0  # standard deviations: residuals of points in one scan are correlated
HALF_STEP_S = np.float32(2e-3)  # half the step of the central difference of residuals by time


def assess(a: AssessedEstimate) -> Assessment:
    """What results say of this kind of sensor."""
    if a.inputs.association.at_rest:
        if a.inputs.rig.has_target:
            return replace(on_boards(a), causes=range_causes(a))
        return Assessment(notes=_notes_on_patches(a))
    return Assessment(
        planes=planes(a.inputs, a.estimate.outcome.state),
        residuals=residuals(a.inputs, a.estimate, a.timeline),
        notes=chain(notes(a.inputs, a.estimate, a.timeline), sheet_notes(a), range_notes(a), ring_notes(a)),
        warnings=chain(warnings(a.inputs, a.estimate), wrong_sheets(a)),
        causes=chain(range_causes(a), ring_causes(a)),
    )


def range_causes(a: AssessedEstimate) -> Iterator[Cause]:
    """A cause for each LiDAR whose ranges have another scale than all other lengths, or an offset. Beside a target a
    scale may be that of the target, whose size is wrong."""
    for e in a.effects:
        if e.spec not in (RANGE_OFFSET, RANGE_SCALE) or not e.differs:
            continue
        field = f"{e.spec.name}: {{prior: 0, sigma: {e.prior_sigma:.2g}}} for {e.sensor}."
        advice, remedy = f"Write {field}", Remedy(e.amended)
        if a.inputs.rig.has_target and e.spec is RANGE_SCALE:
            advice, remedy = (
                f"Measure the target and correct its size in the rig file. If it is right: write {field}",
                None,
            )
        off, than = _off(e.spec, float(e.value[0]), float(e.std[0])), "other sensors say"
        than = than if e.spec is RANGE_SCALE else "walls show that are seen at a slant"
        sentence = f"ranges of {e.sensor} are {off} than {than}. {advice}"
        yield Cause(Remark("ranges_contradict", sentence), e.gain, e.moves > 1.0, remedy=remedy)


def _off(spec: ParameterSpec, value: float, std: float) -> str:
    """How much too long or short ranges are."""
    unit, times = ("%", 100.0) if spec is RANGE_SCALE else spec.display_unit
    return f"{times * abs(value):.2g} +- {times * std:.2g} {unit} {'longer' if value > 0.0 else 'shorter'}"


def range_notes(a: AssessedEstimate) -> Iterator[Remark]:
    """Notes on each LiDAR whose ranges have an offset or a scale of their own in the result."""
    for lidar in a.inputs.rig.lidars:
        yield from ranges_offset(a, lidar.name)
    for g in a.groups:
        if g.name == RANGE_SCALE.name and g.columns is not None and abs(g.value[0]) > EFFECT_SIGMAS * g.std[0]:
            yield Remark(
                "range_scale_estimated",
                f"ranges of {g.sensor} are {_off(RANGE_SCALE, float(g.value[0]), float(g.std[0]))} than true ones, "
                f"which the estimate includes; divide them by {1.0 + g.value[0]:.5g} where you use them, too.",
            )


def ring_causes(a: AssessedEstimate) -> Iterator[Cause]:
    """A cause for each LiDAR whose rings have other elevations, offsets or azimuths than it reports."""
    for e in a.effects:
        if e.spec in OF_RINGS and e.differs:
            off, advice = _rings_off(e.sensor, e.spec, e.value, e.std), f"Write {e.spec.name}: free for {e.sensor}."
            sentence = f"{off}, as its points lie off their planes ring by ring. {advice}"
            yield Cause(Remark("ring_errors_left_out", sentence), e.gain, e.moves > 1.0, remedy=Remedy(e.amended))


def ring_notes(a: AssessedEstimate) -> Iterator[Remark]:
    """Notes on each LiDAR whose rings have errors of their own in the result."""
    specs = {spec.name: spec for spec in OF_RINGS}
    for g in a.groups:
        if g.name in specs and g.columns is not None and (abs(g.value) > EFFECT_SIGMAS * g.std).any():
            low, high = np.rad2deg(a.estimate.outcome.state.values[g.sensor, RINGS_SEEN][:2])
            yield Remark(
                "ring_errors_estimated",
                f"{_rings_off(g.sensor, specs[g.name], g.value, g.std)}, which the estimate includes; correct points "
                f"by {g.name} of the result where you use them, too: 16 bands evenly from {low:.2f} to {high:.2f} deg.",
            )


def _rings_off(lidar: str, spec: ParameterSpec, value: np.ndarray, std: np.ndarray) -> str:
    """How much numbers (K,) of rings with standard deviations (K,) are off."""
    rms, (unit, times) = np.sqrt(np.mean(value**2)), spec.display_unit
    largest, error = np.abs(value).max(), np.linalg.norm(value * std) / (len(value) * rms)
    sizes = f"{times * largest:.2g} {unit} (RMS {times * rms:.2g} +- {times * error:.1g} {unit})"
    return f"{spec.name.replace('_', ' ')} of {lidar} are off by up to {sizes}"


def planes(inputs: Inputs, state: State) -> Iterator[Plane]:
    """The estimated planes, with their numbers of points."""
    association = inputs.association
    values = (state.values[key] for key in association.keys)
    points = association.points if association.count else ()
    for name, v, n in zip(association.names, values, points, strict=True):
        yield Plane(name, v[:3].copy(), v[3:].copy(), int(n))
    yield from sheet_planes(inputs, state)


def residuals(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[LidarResiduals]:
    """Residuals of each LiDAR at the estimate and at the initial guess, evenly thinned; none without planes."""
    if not inputs.association.count:
        return
    state = estimate.outcome.state
    now, guess = motion_of(inputs, state), motion_of(inputs, inputs.guess or state)
    values = np.array([plane_value(state.values[key]) for key in inputs.association.surfaces])
    thinned = [_thinned(inputs, k, state) for k in range(len(inputs.rig.lidars))]
    before = [in_world(guess, stream) for stream, _ in thinned]
    first_planes = _fitted_planes(
        [(points, plane) for (points, _), (_, plane) in zip(before, thinned, strict=True)], values
    )
    for recorded, (stream, plane), (first_world, first_origin) in zip(
        inputs.measurements.lidars, thinned, before, strict=True
    ):
        seconds = _seconds_of(stream, state)
        world, at = in_world(now, stream)
        residual, cosine = _on_planes(world, at, values[plane])
        first_residual, _ = _on_planes(first_world, first_origin, first_planes[plane])
        yield LidarResiduals(
            stream.name,
            len(recorded.stamps_ns),
            len(recorded.xyz),
            _used(estimate, stream.name),
            timeline.on_result_clock(seconds, timeline.recording_of(seconds)),
            plane,
            np.linalg.norm(stream.xyz, axis=1),
            _sigma(estimate.measurement_model.noise[stream.name], cosine),
            world,
            residual,
            first_world,
            first_residual,
        )


def _thinned(inputs: Inputs, index: int, state: State) -> tuple[LidarStream, np.ndarray]:
    """Points of a LiDAR on planes while the IMU was running, evenly thinned, with corrected ranges; and the plane (N,)
    of each."""
    assert inputs.imu is not None
    stream, plane = inputs.measurements.lidars[index], inputs.association.plane[index]
    points = np.flatnonzero(plane >= 0)
    points = points[:: max(1, -(-len(points) * len(inputs.rig.lidars) // MAX_KEPT_POINTS))]
    one = stream.numbered(points)
    running = usable(inputs.imu, _seconds_of(one, state), inputs.rig.settings.max_gap_s)
    return true_points(one.numbered(np.flatnonzero(running)), state), plane[points[running]]


def _fitted_planes(clouds: list[tuple[np.ndarray, np.ndarray]], values: np.ndarray) -> np.ndarray:
    """Planes (P, 6), normal and point, fitted to `clouds`: pairs of points (N, 3) and the plane number (N,) of each.

    `values` (P, 6) gives the sign of the normals, and the planes with too few points.
    """
    out = values.copy()
    for k in range(len(values)):
        on_plane = np.concatenate([points[plane == k] for points, plane in clouds]).astype(np.float64)
        if len(on_plane) >= MIN_FITTED_POINTS:
            centre = on_plane.mean(axis=0)
            normal = np.linalg.eigh(np.cov(on_plane.T))[1][:, 0]
            out[k] = plane_of(np.copysign(1.0, normal @ values[k, :3]) * normal, centre)
    return out


def _seconds_of(stream: LidarStream, state: State) -> np.ndarray:
    """(N,) instants of the points on the IMU's clock, all recordings joined [s]."""
    stamps = np.repeat(stream.seconds, np.diff(stream.start))
    return instants(stream, state.values, stamps) + stream.offset_s


def _on_planes(points: np.ndarray, origin: np.ndarray, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (N,) [m], float32, of points (N, 3) in the world from their planes (N, 6); and cosines (N,) of
    the angle between the beam, from origin (N, 3), and the normal."""
    normal, beam = planes[:, :3], points - origin
    residual = np.einsum("na,na->n", normal, points - planes[:, 3:])
    cosine = np.einsum("na,na->n", normal, beam) / np.linalg.norm(beam, axis=1)
    return residual.astype(np.float32), cosine


def _sigma(noise: LidarNoise, cosine: np.ndarray) -> np.ndarray:
    """(N,) standard deviations [m] of distances from planes, given the cosines of incidence."""
    return np.sqrt(noise.sigma**2 + (noise.beam_sigma * cosine) ** 2).astype(np.float32)


def _used(estimate: Estimate, name: str) -> int:
    """Number of points of LiDAR `name` in the estimate."""
    return sum(int(f.moments.count.sum()) for f in of_type(estimate.problem.factors, LidarFactor) if f.name == name)


def notes(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[Remark]:
    """Notes on the number of points used and their noise."""
    if not inputs.association.count:
        return
    ranging = [estimate.measurement_model.noise[s.name] for s in inputs.rig.lidars]
    for lidar, stream, noise in zip(inputs.rig.lidars, inputs.measurements.lidars, ranging, strict=True):
        given = lidar.range_noise_m is not None
        size = f"{1e3 * noise.beam_sigma:.1f} mm along the beam, as the rig file has it"
        if not given:
            size = f"{1e3 * noise.sigma:.1f} mm from their planes, as residuals show it"
        yield Remark(
            "lidar_points_used",
            f"{_used(estimate, lidar.name)} of the {len(stream.xyz)} points of {lidar.name} lie on "
            f"{inputs.association.count} planes; noise {size}.",
        )


def warnings(inputs: Inputs, estimate: Estimate) -> Iterator[Remark]:
    """Warnings: degenerate scene, wrong point times, few points on planes, stamps at the wrong end of a scan."""
    if not inputs.association.count:
        return
    yield from _degeneracy_warnings(inputs, estimate)
    for index, (lidar, stream) in enumerate(zip(inputs.rig.lidars, inputs.measurements.lidars, strict=True)):
        stretch, std = _time_stretch(inputs, estimate, index)
        if abs(stretch) > max(MAX_TIME_STRETCH, SIGNIFICANT_STRETCH * std):
            yield Remark(
                "scan_times_wrong",
                f"the times of points within a scan of {lidar.name} seem too {'short' if stretch > 0.0 else 'long'}, "
                "or in the wrong order: points lie off their planes in proportion to the motion. Check their unit, "
                "their origin and the sense of rotation, or set point_time in the rig file.",
            )
        share = _used(estimate, lidar.name) / max(len(stream.xyz), 1)
        if share < MIN_SHARE_ON_PLANES:
            yield Remark(
                "few_lidar_points_on_planes",
                f"only {share:.1%} of the points of {lidar.name} lie on planes; the scene has few flat surfaces, or "
                "the times of its points, their order within a scan, or its range_noise in the rig file are wrong.",
            )
        offsets = estimate.outcome.state.values[lidar.name, "time_offset"]
        offsets = offsets - origin_difference(inputs.measurements, stream)
        period = float(np.median(np.diff(stream.seconds)))
        offset = float(offsets[np.argmin(np.abs(np.abs(offsets) - period))])
        if abs(abs(offset) - period) < PERIOD_TOLERANCE * period:
            yield Remark(
                "stamps_at_scan_end",
                f"the time_offset of {lidar.name}, {offset:+.4f} s, is about the period of its scans: its stamps may "
                "be those of the end of a scan while times of points count from its start, or the other way; see "
                "point_time.",
            )


def _time_stretch(inputs: Inputs, estimate: Estimate, index: int) -> tuple[float, float]:
    """Relative error of point times within a scan, positive if they are too short, and its standard deviation.

    A point taken at a wrong instant is off its plane by the time error times its speed along the normal. The mean over
    a scan is removed, as a time offset absorbs it.
    """
    state = estimate.outcome.state
    motion = motion_of(inputs, state)
    values = np.array([plane_value(state.values[key]) for key in inputs.association.surfaces])
    stream, plane = _thinned(inputs, index, state)
    if len(plane) < MIN_FITTED_POINTS:
        return 0.0, np.inf
    later, earlier = (
        _on_planes(*in_world(motion, replace(stream, offset_s=stream.offset_s + step)), values[plane])[0].astype(float)
        for step in (HALF_STEP_S, -HALF_STEP_S)
    )
    speed = (later - earlier) / (2.0 * float(HALF_STEP_S))
    J_stretch = speed * (stream.offset_s - stream.offset_s.mean(dtype=np.float64))
    residual = 0.5 * (later + earlier)
    information = max(float(J_stretch @ J_stretch), 1e-30)
    return -float(J_stretch @ residual) / information, float(residual.std()) / np.sqrt(information)


def _degeneracy_warnings(inputs: Inputs, estimate: Estimate) -> Iterator[Remark]:
    """A warning if LiDARs alone give the motion, and their planes face fewer than three directions."""
    if any(s.gives_motion for s in inputs.rig.mounted if not isinstance(s, Lidar)):
        return
    normals = np.array([estimate.outcome.state.values[key][:3] for key in inputs.association.keys])
    if count_directions(normal_shares(normals, inputs.association.points)) < 3:
        names = " and ".join(x.name for x in inputs.rig.lidars)
        source = "the assumption of smooth motion" if inputs.rig.assumes_motion else "the IMU"
        yield Remark(
            "scene_like_corridor",
            f"the planes that {names} saw face two directions only, as in a corridor: only {source} constrains the "
            "motion along both. Do not trust the result if the solver did not converge; better record where walls and "
            "floor face three directions.",
        )


def _notes_on_patches(a: AssessedEstimate) -> Iterator[Remark]:
    """A note on the patches that each LiDAR sees, and how flat they are."""
    for f in of_type(a.estimate.problem.factors, PatchFactor):
        seen = np.unique(np.stack([f.points.patch, f.points.lidar]), axis=1)[1]
        counts = ", ".join(f"{n} by {name}" for name, n in zip(f.names, np.bincount(seen).tolist(), strict=True))
        stops = len(np.unique(f.points.keyframe))
        yield Remark(
            "lidar_surfaces_shared",
            f"LiDARs share {len(f.points.keyframe)} surfaces at {stops} {'stop' if stops == 1 else 'stops'}, seen "
            f"{counts}; points scatter {1e3 * f.patches.point_sigma:.1f} mm about them, and they deviate "
            f"{1e3 * f.noise.flatness:.1f} mm from planes.",
        )


def misfit(lidar: Lidar, f: SensorFit, is_noise: bool) -> Remark | None:
    """A sentence if points are farther from planes than the stated range noise predicts, else None."""
    if excess(f) == 1.0 or lidar.range_noise_m is None:
        return None
    return Remark(
        "range_noise_understated",
        f"residuals of the points of {f.sensor} are {times(f)} larger than its range_noise predicts; leave it out, "
        "and it is estimated.",
    )


def length(lidar: Lidar, rig: Rig) -> str | None:
    """The source of the scale, as text for messages."""
    return f"the ranges of {lidar.name}"


ASSESSOR = Assessor(assess, misfit, length=length)
