"""Assessment of LiDARs whose points lie on the target that cameras see, standing still or in motion."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.base.remark import Remark
from icalib.estimate.inputs import Inputs
from icalib.estimate.problem import pass_at
from icalib.observability.assessor import AssessedEstimate, Assessment
from icalib.optim.state import State, in_recording
from icalib.result.calibration import Plane
from icalib.rig import ParameterSpec
from icalib.sensors.lidar.board_factor import ON_BOARDS, BoardFactor, in_scene
from icalib.sensors.lidar.spec import RANGE_OFFSET
from icalib.sensors.lidar.stream import LidarResiduals, LidarStream

SEARCHED_SHARE = 0.5  # of the sheet's shorter side: edges of sheets of another size are looked for so far from theirs
WIDEST_BEAM_M = 0.025  # edges that wide beams shift by more are those of a larger sheet
SIGNIFICANT_SIGMAS = 2.0  # of a range offset: one in 20 by chance


def on_boards(a: AssessedEstimate) -> Assessment:
    """What results say of LiDARs at rest."""
    state = a.estimate.outcome.state
    return Assessment(
        planes=_sheets(a, state), residuals=_residuals(a, state), notes=_notes(a), warnings=wrong_sheets(a)
    )


def _factors(a: AssessedEstimate, kind: str = ON_BOARDS) -> list[BoardFactor]:
    return [f for f in a.estimate.problem.factors.values() if isinstance(f, BoardFactor) and f.kind == kind]


def _sheets(a: AssessedEstimate, state: State) -> Iterator[Plane]:
    """The sheets of the target, in the frame of its reference body, with their numbers of points."""
    R, p = a.inputs.bodies.poses(state.values)
    count = sum(np.bincount(f.points.body, minlength=len(R)) for f in _factors(a))
    for name, Rk, pk, n in zip(a.inputs.bodies.target.bodies, R, p, np.broadcast_to(count, len(R)), strict=True):
        yield Plane(name, Rk[:, 2].copy(), pk.copy(), int(n))


def _residuals(a: AssessedEstimate, state: State) -> Iterator[LidarResiduals]:
    """Distances of the points of each LiDAR from the sheets, at the estimate and at the initial guess."""
    for f in _factors(a):
        points, stream = f.points, a.inputs.measurements.streams[f.name]
        assert isinstance(stream, LidarStream)
        each = []
        for s in (state, a.inputs.guess or state):
            R, p = a.inputs.bodies.poses(s.values)
            world = in_scene(points.xyz, f.name, points.keyframe, s)
            each += [world, ((world - p[points.body]) * R[points.body, :, 2]).sum(axis=1)]
        seconds = f.times(state)
        world, residual, first_world, first_residual = (np.asarray(x, np.float32) for x in each)
        yield LidarResiduals(
            f.name,
            len(stream.stamps_ns),
            len(stream.xyz),
            len(points.xyz),
            a.timeline.on_result_clock(seconds, a.timeline.recording_of(seconds)),
            points.body.astype(np.int32),
            np.linalg.norm(points.xyz, axis=1).astype(np.float32),
            (f.sigma * np.abs(f.rows_of_points(slice(None), state, False)[1])).astype(np.float32),
            world,
            residual,
            first_world,
            first_residual,
        )


def _notes(a: AssessedEstimate) -> Iterator[Remark]:
    """Notes on the number of points on the target, and on ranges that are too long or too short."""
    for f in _factors(a):
        stops, all_stops = len(np.unique(f.points.keyframe)), f.n_keyframes
        size = f"{1e3 * f.noise.beam_sigma:.1f} mm along the beam, as the rig file has it"
        if a.inputs.sensor(f.name).range_noise_m is None:
            size = f"{1e3 * f.noise.sigma:.1f} mm from the target, as residuals show it"
        yield Remark(
            "lidar_points_on_target",
            f"{len(f.sigma)} points of {f.name} lie on the target, at {stops} of {all_stops} stops; noise {size}.",
        )
        yield from ranges_offset(a, f.name)


def ranges_offset(a: AssessedEstimate, lidar: str) -> Iterator[Remark]:
    """The note on ranges that are significantly too long or too short."""
    offset, sigma = _value(a, lidar, RANGE_OFFSET)
    if abs(offset) > max(SIGNIFICANT_SIGMAS * sigma, RANGE_OFFSET.prior_sigma / 10.0):
        yield Remark(
            "ranges_offset",
            f"{lidar} measures {1e3 * abs(offset):.0f} +- {1e3 * sigma:.2g} mm too "
            f"{'far' if offset > 0.0 else 'near'}; its extrinsics are those of corrected ranges, so correct the "
            "ranges where you use them, too.",
        )


def wrong_sheets(a: AssessedEstimate) -> Iterator[Remark]:
    """Warnings on edges of sheets that are elsewhere than `sheet` in the rig file says, at rest or in motion."""
    state, bodies, association = a.estimate.outcome.state, a.inputs.bodies, a.inputs.association
    at = pass_at(a.inputs, state)
    for k, lidar in enumerate(a.inputs.rig.lidars if bodies.used else ()):
        if not association.at_rest and not (association.sheets and association.points_on_sheets[k].any()):
            continue
        stream, noise = a.inputs.measurements.streams[lidar.name], a.estimate.measurement_model.noise[lidar.name]
        assert isinstance(stream, LidarStream)
        sides = np.diff(bodies.target.outlines[list(bodies.used)], axis=1)
        _, edges = BoardFactor.seen(stream, noise, at, SEARCHED_SHARE * float(sides.min()))
        growth = float(np.median(edges.off(state))) if len(edges.sigma) else 0.0
        if abs(growth) > WIDEST_BEAM_M:
            yield Remark(
                "sheet_size_wrong",
                f"{lidar.name} sees the edges of the target {1e3 * abs(growth):.0f} mm farther "
                f"{'out' if growth > 0.0 else 'in'} than `sheet` in the rig file says"
                f"{', or bright edges bleed' if growth > 0.0 else ''}; measure the sheet again, or leave `sheet` out.",
            )


def _value(a: AssessedEstimate, lidar: str, spec: ParameterSpec) -> tuple[float, float]:
    """Value and standard deviation of a number of the LiDAR; 0 and infinity if it is not estimated."""
    group = next((g for g in a.groups if (g.sensor, g.name) == (lidar, spec.name) and g.columns is not None), None)
    return (0.0, np.inf) if group is None else (float(group.value[0]), float(group.std[0]))


# In motion.


def sheet_planes(inputs: Inputs, state: State) -> Iterator[Plane]:
    """The sheet in each recording, with its number of points. Its numbers follow those of the planes."""
    association, bodies = inputs.association, inputs.bodies
    for k, r in enumerate(association.sheets):
        tilt = state.values[association.surfaces[association.count + k]]
        middle = np.append(bodies.target.outlines[bodies.used[0]].mean(axis=0), 0.0)
        points = association.points_on_sheets[:, k].sum()
        yield Plane(in_recording("sheet", r), tilt[:, 2].copy(), tilt @ middle, int(points))


def sheet_notes(a: AssessedEstimate) -> Iterator[Remark]:
    """The number of points on the sheet whose size the rig file gives."""
    association, bodies = a.inputs.association, a.inputs.bodies
    if not association.count or not bodies.used or not bodies.target.has_sheet[bodies.used[0]]:
        return
    for k, lidar in enumerate(a.inputs.rig.lidars):
        if points := association.points_on_sheets[k].sum():
            yield Remark(
                "lidar_points_on_sheet",
                f"{points} points of {lidar.name} lie on the target; its place is that in the images.",
            )
        else:
            yield Remark(
                "target_unseen_by_lidar",
                f"the target is not in the clouds of {lidar.name}, so that only planes of the scene calibrate it; hold "
                "the LiDAR so that it sees the target, too.",
            )
