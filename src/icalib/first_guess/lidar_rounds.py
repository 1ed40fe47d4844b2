"""Rounds of association and solve: from LiDARs about where they are to points on planes.

Cameras, or without any the first LiDAR itself, give the motion; every other LiDAR is placed on it. Then points are
associated with planes and everything is solved, again and again, each time with less allowed for what may be off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from icalib.errors import EstimationError
from icalib.estimation.assembly import (
    Inputs,
    host_times,
    motion_of,
    nodes_for,
    origin_difference,
    start_values,
    with_clouds,
)
from icalib.estimation.estimate import first_pass
from icalib.estimation.lidar_binning import in_world
from icalib.estimation.robot import FIRST_RANGE_M, MOUNT, Clouds, known_planes
from icalib.estimation.state import Key, State
from icalib.first_guess.align_camera import trusted
from icalib.first_guess.lidar import Held, lidar_and_motion, lidar_on_motion
from icalib.first_guess.lidar_planes import ROUNDS, associate, round_search
from icalib.geometry.planes import plane_of
from icalib.measurements import LidarStream
from icalib.rig import Camera, Lidar, PoseSensor, Wheels

NEAR_NODE_S = 0.15  # a scan of a LiDAR alone goes on so long after its node
NAMES = tuple(name for name, _, _ in MOUNT)


def given(inputs: Inputs, sensor: Camera | Lidar | Wheels | PoseSensor, names: Sequence[str]) -> dict[Key, np.ndarray]:
    """What the rig gives of a sensor, time offsets between clocks that start at their first stamps."""
    out: dict[Key, np.ndarray] = {}
    for name in names:
        value = getattr(sensor, name).value
        if value is not None:
            shift = origin_difference(inputs.measurements, inputs.stream(sensor.name)) if name == "time_offset" else 0.0
            out[sensor.name, name] = np.array(value, dtype=np.float64) + shift
    return out


def state_from_lidar(inputs: Inputs) -> State:
    """Where the solver starts where no camera shows the motion: the first LiDAR and the IMU do.

    Raises EstimationError where they do not.
    """
    assert inputs.imu is not None
    lidar, stream = inputs.rig.lidars[0], inputs.measurements.lidars[0]
    try:
        guess, motion = lidar_and_motion(inputs.imu, stream, inputs.rig.gravity, held_of(inputs, lidar))
    except EstimationError:
        known = held_of(inputs, lidar, guesses=True)
        if known.rotation is None or known.offset is None:
            raise
        # The motion shows too little; the rig file's guess stands in.
        guess, motion = lidar_and_motion(inputs.imu, stream, inputs.rig.gravity, known)
    values = start_values(inputs, guess.values(lidar.name) | given(inputs, lidar, NAMES))
    hosts = {(x.name, "time_offset"): values[lidar.name, "time_offset"] for x in inputs.rig.lidars}
    nodes = nodes_for(inputs, host_times(inputs, hosts)[:1])
    rotation, position, velocity = motion.at(nodes)
    return State(nodes, rotation, position, velocity, np.tile(motion.bias, (len(nodes), 1)), values)


def with_lidars(inputs: Inputs, state: State) -> tuple[Inputs, State]:
    """`inputs` with points of the LiDARs on planes, and `state`, which has the motion and a guess of all, with the
    planes, led on by the rounds. Raises EstimationError where there are no planes."""
    inputs = replace(while_known(inputs, state), guess=state)
    streams = inputs.measurements.lidars
    if any((s.plane >= 0).any() for s in streams):
        clouds = known_planes(streams)
        return with_clouds(inputs, clouds), replace(state, values=state.values | fitted_planes(inputs, state, clouds))
    before = None
    noise = max(x.range_noise_m or FIRST_RANGE_M for x in inputs.rig.lidars)
    for k in range(ROUNDS):
        before = associate(streams, motion_of(inputs, state), round_search(k, noise), before)
        inputs = with_clouds(inputs, before.clouds)
        state = replace(state, values=_without_planes(state) | before.values)
        if k < ROUNDS - 1:
            state = first_pass(inputs, state)
    return inputs, state


def _without_planes(state: State) -> dict[Key, np.ndarray]:
    return {key: value for key, value in state.values.items() if key[1] != "plane"}


def while_known(inputs: Inputs, state: State) -> Inputs:
    """`inputs` without points of scans that lie beyond the nodes of `state`: carried there by the IMU alone, they would
    count as if its readings had no noise. Raises EstimationError where none is left."""
    measured, lidars, notes = inputs.measurements, [], list(inputs.measurements.notes)
    for stream in measured.lidars:
        begin = stream.seconds + state.values[stream.name, "time_offset"][0]
        scan = np.repeat(np.arange(len(begin)), np.diff(stream.start))
        last = np.zeros(len(begin))
        np.maximum.at(last, scan, stream.offset_s)
        known = _near(state.seconds, begin) & _near(state.seconds, begin + last)
        if not known.any():
            raise EstimationError(
                f"{stream.name}: none of its scans falls within the recording of the other sensors; check that the "
                "clocks overlap, or the time_offset in the rig file."
            )
        if not known.all():
            notes.append(
                f"{np.count_nonzero(~known)} of {len(known)} scans of {stream.name} are left out: nothing else shows "
                "the motion then."
            )
        lidars.append(_points_of(stream, known[scan], scan))
    return replace(inputs, measurements=replace(measured, lidars=tuple(lidars), notes=tuple(notes)))


def _near(nodes: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n,) whether there is a node near each of the times (n,)."""
    k = np.clip(np.searchsorted(nodes, times), 1, len(nodes) - 1)
    return np.minimum(np.abs(times - nodes[k - 1]), np.abs(times - nodes[k])) < NEAR_NODE_S


def _points_of(stream: LidarStream, kept: np.ndarray, scan: np.ndarray) -> LidarStream:
    """The stream with the points in `kept` (N,) of `scan` (N,); its scans stay, if empty."""
    if kept.all():
        return stream
    count = np.bincount(scan[kept], minlength=len(stream.stamps_ns))
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return LidarStream(
        stream.name, stream.stamps_ns, start, stream.offset_s[kept], stream.xyz[kept], stream.plane[kept]
    )


def lidar_values(inputs: Inputs, state: State) -> dict[Key, np.ndarray]:
    """Of all LiDARs that `state` does not have, which has the motion: what the rig gives, or what their scans show.

    Raises EstimationError where neither does.
    """
    assert inputs.imu is not None
    out: dict[Key, np.ndarray] = {}
    for lidar, stream in zip(inputs.rig.lidars, inputs.measurements.lidars, strict=True):
        known = given(inputs, lidar, NAMES)
        if len(known) < len(NAMES) and (lidar.name, "rotation") not in state.values:
            found = lidar_on_motion(inputs.imu, stream, state, held_of(inputs, lidar))
            known = found.values(lidar.name) | known
        out |= known
    return out


def held_of(inputs: Inputs, lidar: Lidar | PoseSensor, guesses: bool = False) -> Held:
    """What the rig trusts of a LiDAR or a pose sensor, and with `guesses` what it guesses."""
    known = given(inputs, lidar, [name for name in NAMES if guesses or trusted(getattr(lidar, name)) is not None])
    offset = known.get((lidar.name, "time_offset"))
    return Held(
        known.get((lidar.name, "rotation")),
        known.get((lidar.name, "translation")),
        None if offset is None else float(offset[0]),
    )


def fitted_planes(inputs: Inputs, state: State, clouds: Clouds) -> dict[Key, np.ndarray]:
    """Values of the planes that fit the points best where `state` puts them."""
    motion, sums = motion_of(inputs, state), np.zeros((clouds.count, 4, 4))
    for stream, plane in zip(inputs.measurements.lidars, clouds.plane, strict=True):
        own, (points, _) = plane[plane >= 0], in_world(motion, stream)
        columns = [np.ones(len(own)), *points[plane >= 0].T.astype(np.float64)]
        for i in range(4):
            for j in range(i + 1):
                sums[:, i, j] += np.bincount(own, columns[i] * columns[j], clouds.count)
    out = {}
    for key, M in zip(clouds.keys, sums, strict=True):
        centre = M[1:, 0] / M[0, 0]
        spread = np.tril(M[1:, 1:]) / M[0, 0] - np.outer(centre, centre)
        out[key] = plane_of(np.linalg.eigh(spread, UPLO="L")[1][:, 0], centre)
    return out
