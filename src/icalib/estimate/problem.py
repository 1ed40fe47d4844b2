"""The least-squares problem of one pass, from rig and data: factors, layout, frames held, priors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.inputs import UNGUESSED_TRANSLATION_SIGMA_M, Inputs, origin_difference
from icalib.model.bodies import SHAPE_SIGMA_M, SIZE
from icalib.model.sensor_model import Pass, by_kind, model_of
from icalib.motion.factor import Factor, FactorKey, IndependentKeyframes, Residuals, Whitened, keyed
from icalib.motion.imu_data import ImuData, without_effects
from icalib.motion.poses import (
    MIDDLE,
    RECORDING_MARGIN_S,
    EstimatedMotion,
    assign_keyframes,
    distinct,
    first_keyframes,
    gravity_of,
    place_keyframes,
    poses_at,
)
from icalib.optim import arrowhead
from icalib.optim.arrowhead import (
    NO_DIRECTIONS,
    Piece,
    Prior,
    in_parallel,
    make_pieces,
    marginalise,
    marginalise_in_segments,
)
from icalib.optim.state import FURTHER_IMU_DIM, Block, Key, Layout, State
from icalib.rig import Parameter, Rig
from icalib.rig.scene import FRAME as SENSOR_FRAME
from icalib.rig.scene import FRAME_OFFSET, GRAVITY, LEVEL_FRAME, PLANE, SHAPE_LABELS, SHEET_MIDDLE, WORLD
from icalib.rig.scene import SIZE as SIZE_SPEC
from icalib.sensors.sensor import CLOCK_RATE, TIME_OFFSET, TRANSLATION

# The least-squares problem of one pass: sums of all factors and priors over the pieces of the chain (iCalib paper
# (15)).


# The least-squares problem of one pass, from rig and data, and its solution.


@runtime_checkable
class ChainFactor(Factor, Protocol):
    """Factor between successive keyframes: that of the IMU, or `IndependentKeyframes`, which links none. imu: readings
    that link keyframes, or None. kinds: columns of its residuals by kind. starts: first keyframe of each recording, not
    linked to the keyframe before it."""

    @property
    def imu(self) -> ImuData | None: ...

    @property
    def n_keyframes(self) -> int: ...

    @property
    def starts(self) -> tuple[int, ...]: ...

    @property
    def kinds(self) -> dict[str, slice]: ...

    def output(self) -> Whitened:
        """Empty rows (K - 1, 15), one per interval between keyframes."""
        ...

    def accumulate_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Adds the prior on the biases at each of `starts` in `piece`, except at its last keyframe. Returns half its
        chi^2."""
        ...


@runtime_checkable
class TrackFactor(Factor, Protocol):
    """Factor of points of the scene that many keyframes see, and that are eliminated with these."""

    def by_segment(self, ends: np.ndarray, of_column: np.ndarray) -> TrackFactor:
        """The same measurements, which depend on other columns in each segment. ends (G + 1,): keyframes that bound the
        segments; of_column (G, B + 1): column in place of each calibration column, and of -1."""
        ...


@dataclass(frozen=True)
class Problem:
    """Least-squares problem: minimise half the robust chi^2 of all factors and priors over a `State`. factors: one of
    them is the `ChainFactor`."""

    layout: Layout
    factors: dict[FactorKey, Factor]
    priors: tuple[Prior, ...]
    tolerance: np.ndarray  # (B,) differences that do not matter to a user: units of the calibration columns
    fixed_directions: np.ndarray = field(
        default_factory=lambda: NO_DIRECTIONS
    )  # (B, m) orthonormal directions of the calibration parameters, in tolerance units, that are fixed
    framed: bool = True  # whether the world frame is defined, as by a target; else first keyframes are fixed
    levelled: bool = True  # whether the direction of gravity is known

    @cached_property
    def chain(self) -> ChainFactor:
        return next(f for f in self.factors.values() if isinstance(f, ChainFactor))

    @property
    def n_keyframes(self) -> int:
        return self.chain.n_keyframes

    @cached_property
    def tracks(self) -> dict[FactorKey, TrackFactor]:
        """Factors that link keyframes that are not neighbours, so that segments of the chain are not independent."""
        return {key: f for key, f in self.factors.items() if isinstance(f, TrackFactor)}

    def without_tracks(self) -> Problem:
        """The same problem without these."""
        return replace(self, factors={key: f for key, f in self.factors.items() if key not in self.tracks})

    def replacing(self, factors: Sequence[Factor]) -> Problem:
        """The same problem with `factors` instead of those with the same keys; factors with new keys are added."""
        return replace(self, factors=self.factors | keyed(factors))

    def pieces(self, sums: bool = True) -> tuple[Piece, ...]:
        """Pieces of the chain, sums zero; without `sums`, for residuals only."""
        pieces = make_pieces(self.n_keyframes, self.layout.size if sums else None, self.layout.keyframe_dim)
        return tuple(self.attach(p, len(pieces) > 1) for p in pieces) if sums else pieces

    def zeros(self, first: int, last: int, n_columns: int = 0) -> Piece:
        """A piece between keyframes `first` and `last` with sums zero, and `n_columns` columns beside the calibration
        parameters."""
        return Piece.zeros(first, last, self.layout.size + n_columns, self.layout.keyframe_dim)

    def attach(self, piece: Piece, keep: bool = False) -> Piece:
        """The piece with workspace for parameters that factors eliminate; `keep`: it shares a keyframe with another
        piece."""
        for factor in self.factors.values():
            piece = factor.attach(piece, keep)
        return piece

    def without(self, priors: Sequence[Prior]) -> Problem:
        """The same problem without `priors`, which are compared by identity."""
        removed_ids = {id(p) for p in priors}
        return replace(self, priors=tuple(p for p in self.priors if id(p) not in removed_ids))

    def cut(self, state: State, keyframes: np.ndarray) -> Problem:
        """The same problem with factors cut at `keyframes` (n,). Only the chain then links keyframes on both sides of a
        cut."""
        ends = tuple(int(k) for k in keyframes)
        return self.replacing([f.cut(state, ends) for f in self.factors.values()])

    def solve(self, pieces: tuple[Piece, ...], damping: float = 0.0) -> arrowhead.Solution:
        """See `arrowhead.solve`; overwrites the pieces."""
        fixed, essential = self.fixed_directions, self.layout.essential
        return arrowhead.solve(pieces, self.n_keyframes, self.tolerance, damping, fixed, essential)

    def marginal(self, sums_of: Callable[[int, int], Piece]) -> np.ndarray:
        """System (B + 1, B + 1) of the calibration parameters and their gradient, all keyframes eliminated. sums_of:
        makes the sums between two keyframes. To bound memory, segments are eliminated in turn unless factors link
        distant keyframes."""
        if self.tracks:
            return marginalise(sums_of(0, self.n_keyframes - 1))
        return marginalise_in_segments(sums_of, self.n_keyframes)

    def sums_of(self, state: State, first: int, last: int) -> Piece:
        """Sums between keyframes `first` and `last`, with the true curvature of robust losses. Residuals are
        discarded."""
        piece = self.attach(self.zeros(first, last))
        for factor in self.factors.values():
            factor.accumulate(state, piece, factor.discarded_output(), curved=True)
        self.add_bias_prior(state, piece)
        for prior in self.priors if first == 0 else ():
            prior.accumulate(state, piece)
        self.hold_frames(state, piece)
        return piece

    def residuals(self) -> Residuals:
        """Empty arrays for `linearise` to fill, by factor."""
        return {key: factor.output() for key, factor in self.factors.items()}

    def reusable_output(self, at: Residuals) -> Residuals:
        """Arrays `at` to be overwritten, with new ones for factors that need another size."""
        return {key: factor.reusable_output(at[key]) for key, factor in self.factors.items()}

    def warm_started(self, at: Residuals) -> Problem:
        """The same problem, which starts the search for eliminated points of the scene from those of `at`."""
        return self.replacing([factor.warm_started(at[key]) for key, factor in self.factors.items()])

    def linearise(
        self, state: State, pieces: tuple[Piece, ...], out: Residuals, sums: bool = True, curved: bool = False
    ) -> float:
        """Computes the residuals `out` at `state`, and the normal equations in `pieces` unless `sums` is false. Returns
        half the robust chi^2. curved: use the true curvature of the robust loss, see `Factor.accumulate`."""
        return sum(in_parallel(lambda p: self._accumulate(state, p, out, sums, curved), pieces))

    def _accumulate(self, state: State, piece: Piece, out: Residuals, sums: bool, curved: bool) -> float:
        if sums:
            piece.clear()
        cost = self.add_measurements(state, piece, out, sums, curved) + self.add_bias_prior(state, piece, sums)
        if piece.first == 0:
            cost += sum(p.accumulate(state, piece, sums) for p in self.priors)
        if sums:
            self.hold_frames(state, piece)
        return cost

    def hold_frames(self, state: State, piece: Piece) -> None:
        """Fixes the gauge freedom of each recording's world frame, unless the problem is `framed`."""
        for keyframe in self.chain.starts if not self.framed else ():
            if piece.first <= keyframe < piece.last:
                hold_frame(state, piece, keyframe, self.levelled)

    def add_measurements(
        self, state: State, piece: Piece, out: Residuals, sums: bool = True, curved: bool = False
    ) -> float:
        """Adds all factors to `piece`; returns half their robust chi^2."""
        return sum(f.accumulate(state, piece, out[key], sums, curved) for key, f in self.factors.items())

    def add_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Adds the broad prior on the biases at each recording's first keyframe, centred on their values at the start
        of the pass. Returns half its chi^2."""
        return self.chain.accumulate_bias_prior(state, piece, sums)

    def piece_with_columns(self, state: State, first: int, last: int, n_columns: int, out: Residuals) -> Piece:
        """Sums of all factors between keyframes `first` and `last`, without the priors on calibration parameters and
        without their gradient. `n_columns` further columns beside the calibration parameters are zero, for gradients to
        be marginalised. Fills `out` with residuals."""
        size = self.layout.size
        narrow = self.attach(self.zeros(first, last))
        self.add_measurements(state, narrow, out)
        self.add_bias_prior(state, narrow)
        self.hold_frames(state, narrow)
        wide = self.zeros(first, last, n_columns)
        wide.side[:, :, :size], wide.calib[:size, :size] = narrow.side[:, :, :size], narrow.calib[:size, :size]
        features = None if narrow.features is None else narrow.features.widened(size + n_columns)
        return replace(narrow, side=wide.side, calib=wide.calib, features=features)


# Builds the `Problem` of one pass from rig, measurements and a state.


def _priors(inputs: Inputs) -> tuple[Prior, ...]:
    """All priors: on the shapes of target boards, on auxiliary parameters of sensors, and `stated_priors`.

    Auxiliary parameters get no verdict, such as the edge bloom of a camera. Their prior, and that of nuisances, is the
    default one, about zero, if the rig file has none.
    """
    layout = inputs.layout
    priors = [
        Prior(layout.block(b, "shape"), np.zeros(len(SHAPE_LABELS)), SHAPE_SIGMA_M) for b in inputs.bodies.bending
    ]
    for block in layout.free:
        stated, spec = inputs.stated(block), inputs.specs[block.key]
        is_open = stated is not None and stated.mode != "prior" and (spec.is_auxiliary or block.is_nuisance)
        if is_open or block.name == SHEET_MIDDLE.name:
            priors.append(Prior(block, np.zeros(block.size), np.full(block.size, spec.prior_sigma)))
    return (*priors, *stated_priors(inputs))


def stated_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """Priors on nuisance parameters, and priors of the rig file on calibrated parameters."""
    return (*_nuisance_priors(inputs), *given_priors(inputs))


def _nuisance_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """Priors on nuisance parameters: size of the target, gravity, IMU intrinsics, and scale of a pose sensor.
    `inputs.rig` holds default priors if the user's rig file states none. The shape of a target is no nuisance parameter
    here."""
    rig, one, priors = inputs.rig, np.ones(1), []
    of_scene = {
        SIZE: (one, (rig.target.size_sigma or SIZE_SPEC.prior_sigma) * one),  # score tests free an exact one
        (WORLD, GRAVITY.name): (rig.gravity * one, rig.gravity_sigma * one),
    }
    for block in inputs.layout.free:
        stated = inputs.stated(block)
        if block.key in of_scene:
            priors.append(Prior(block, *of_scene[block.key]))
        elif block.is_nuisance and stated is not None:
            priors += _given(block, stated)
    return tuple(priors)


def given_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """Priors of the rig file on calibrated parameters, which are not nuisance parameters."""
    priors = []
    for block in inputs.layout.free:
        stated = inputs.stated(block)
        if stated is None or block.is_nuisance:
            continue
        is_clock = block.name == TIME_OFFSET.name
        shift = origin_difference(inputs.measurements, inputs.stream(block.sensor)) if is_clock else 0.0
        priors += _given(block, stated, shift)
    return tuple(priors)


def _given(block: Block, parameter: Parameter, shift: float = 0.0) -> list[Prior]:
    """Prior of a block as the rig file states it, its mean moved by `shift`; empty if the file states none."""
    if parameter.mode != "prior" or parameter.value is None or parameter.sigma is None:
        return []
    value, sigma = parameter.value + shift, parameter.sigma
    if block.name == TIME_OFFSET.name:  # a clock that restarts: the same prior in each recording
        value, sigma = np.broadcast_to(value, block.size), np.broadcast_to(sigma, block.size)
    return [Prior(block, value, sigma)]


def keyframe_times(inputs: Inputs, values: Mapping[Key, np.ndarray]) -> dict[str, np.ndarray]:
    """Times at which keyframes are wanted, by sensor [s, body's clock since its first stamp]: those of the first kind
    that places any. If the rig assumes its motion and poses measure it, those of all kinds."""
    rig, times = inputs.rig, dict[str, np.ndarray]()
    every_kind = rig.assumes_motion and (rig.moves_by_poses or any(s.shows_planes for s in rig.mounted))
    for model, sensors in by_kind(rig.mounted):
        if every_kind or not times:
            times |= model.keyframe_times(sensors, rig, inputs.measurements.streams, values)
    return times


def resample(state: State, keyframes: np.ndarray, inputs: Inputs) -> State:
    """The same motion at the times `keyframes`, by integrating the IMU from the nearest old keyframe. Without an IMU
    the state is returned as it is."""
    if inputs.imu is None:
        return state
    motion = motion_of(inputs, state)
    near = assign_keyframes("inertial", state.seconds, keyframes, inputs.imu.forwards)
    poses = poses_at("inertial", keyframes, near, state, motion.imu, motion.gravity, False)
    starts, state = first_keyframes(inputs.imu, keyframes), with_further_imus(inputs, state)
    return State(
        keyframes, poses.rotation, poses.position, poses.velocity, state.bias[near].copy(), state.values, starts,
        state.further_imus[near],
    )  # fmt: skip


def begun(inputs: Inputs, state: State) -> State:
    """The state at which passes may begin: with the states of further IMUs, and the middle of each clock."""
    state, values = with_further_imus(inputs, state), dict(state.values)
    bodies = [(p.begin, 1e-9 * p.shift_ns, p.measurements.imu) for p in inputs.parts]
    moved = np.array([shift for _, shift, _ in bodies])
    edges = np.array([(begin, begin + float(np.ptp(imu.seconds))) for begin, _, imu in bodies if imu is not None])
    if not len(edges):
        return state
    recorded = edges - moved[:, None]  # a clock that does not restart drifts from one recording to the next
    whole = 0.5 * (recorded.min() + recorded.max()) + moved
    for sensor in inputs.sensors:
        if inputs.layout.has(sensor.name, CLOCK_RATE.name):
            offsets = values[sensor.name, TIME_OFFSET.name]
            values[sensor.name, MIDDLE] = (edges.mean(axis=1) if len(offsets) > 1 else whole) - offsets
    return replace(state, values=values)


def with_further_imus(inputs: Inputs, state: State) -> State:
    """The state with the states of all IMUs after the first, at zero if it has none: rows are linear in them."""
    n = FURTHER_IMU_DIM * len(inputs.layout.further_imus)
    if state.further_imus.shape[1] == n:
        return state
    return replace(state, further_imus=np.zeros((len(state.seconds), n)))


def keyframes_for(inputs: Inputs, times: Mapping[str, np.ndarray]) -> np.ndarray:
    """Keyframe times [s] for images or scans at `times`, one array per sensor. Raises EstimationError if clocks do not
    overlap."""
    settings, every = inputs.rig.settings, list(times.values())
    if inputs.imu is None:
        return distinct(np.sort(np.concatenate(every)))
    hosts = every[:1] if settings.keyframes == "first-camera" else every
    keyframes = place_keyframes(inputs.imu, hosts, settings.keyframe_spacing_s, settings.max_gap_s)
    counts = np.diff((*first_keyframes(inputs.imu, keyframes), len(keyframes)))
    if counts.min() < 3:
        where = f"{inputs.parts[int(np.argmin(counts))].name}: " if len(inputs.parts) > 1 else ""
        raise EstimationError(
            f"{where}fewer than 3 {_hosts(inputs.rig, list(times))} fall within the recording of {inputs.imu.name}; "
            "check that the clocks overlap, or the time_offset in the rig file."
        )
    return keyframes


def _hosts(rig: Rig, names: Sequence[str]) -> str:
    """The measurements of the first kind among the sensors `names`, as text."""
    first = rig.sensors[names[0]]
    return f"{first.readings} of {', '.join(n for n in names if rig.sensors[n].sensor_type == first.sensor_type)}"


def assemble(
    inputs: Inputs,
    state: State,
    noise: Mapping[str, Any],
    fixed_directions: np.ndarray = NO_DIRECTIONS,
    coarse: bool = False,
) -> Problem:
    """The problem at the keyframes of `state`, with everything that a pass freezes: assignment to keyframes,
    preintegration, and corrections of measurements that depend on the state.

    noise: by sensor, of the noise class of its kind. fixed_directions (B, m): directions of the calibration parameters
    that are fixed, see `Problem`. coarse: an early pass, see `Pass`.
    """
    rig, at = inputs.rig, pass_at(inputs, state, coarse)
    factors = (*_between_keyframes(inputs, at), *_measured(inputs, noise, at))
    return Problem(
        inputs.layout, keyed(factors), _priors(inputs), inputs.tolerance, fixed_directions,
        # framed: whether the world frame is defined; levelled: whether gravity is known to point down in it
        rig.has_target or rig.imu is None or (rig.assumes_motion and rig.moves_by_poses), not rig.assumes_motion,
    )  # fmt: skip


def motion_of(inputs: Inputs, state: State) -> EstimatedMotion:
    """Motion of the IMU between the keyframes of `state`."""
    assert inputs.imu is not None
    imu = without_effects(inputs.imu, state, state.bias[:, :3].mean(axis=0))
    return EstimatedMotion(state, imu, gravity_of(state, inputs.rig.gravity), inputs.rig.settings.max_gap_s)


def _measured(inputs: Inputs, noise: Mapping[str, Any], at: Pass) -> list[Factor]:
    """Factors of all sensors, kind by kind. Joint factors of several sensors are built concurrently in one separate
    thread, because LiDAR points already use the solver's threads."""
    factors_by_kind: list[tuple[list[Factor], Future[Sequence[Factor]]]] = []
    with ThreadPoolExecutor(1) as aside:
        for model, sensors in by_kind(inputs.sensors):
            sensor_factors: list[Factor] = []
            for s in sensors:
                measured = s, inputs.stream(s.name), noise[s.name], at
                sensor_factors += model.factors(*measured)
            factors_by_kind.append(
                (sensor_factors, aside.submit(model.joint_factors, sensors, sensor_factors, noise, at))
            )
        return [factor for sensor_factors, joint in factors_by_kind for factor in (*sensor_factors, *joint.result())]


def pass_at(inputs: Inputs, state: State, coarse: bool = False) -> Pass:
    """Data from which factors are built at `state`."""
    if inputs.imu is not None:
        motion, starts = motion_of(inputs, state), state.starts
    else:
        begins = [part.begin - RECORDING_MARGIN_S for part in inputs.parts[1:]]
        motion, starts = None, (0, *(int(k) for k in np.searchsorted(state.seconds, begins)))
    return Pass(
        inputs.rig, inputs.association, inputs.layout, state, motion, starts, inputs.measurements, inputs.motions,
        inputs.bodies, coarse,
    )  # fmt: skip


def _between_keyframes(inputs: Inputs, at: Pass) -> Iterable[Factor]:
    """The `ChainFactor`, which is that of the IMU if there is one."""
    if inputs.imu is None:
        return (IndependentKeyframes(inputs.rig.reference, len(at.state.seconds)),)
    sensor = inputs.sensor(inputs.imu.name)
    return model_of(sensor).factors(sensor, inputs.stream(sensor.name), sensor.noise, at)


def start_values(inputs: Inputs, guess_values: dict[Key, np.ndarray]) -> dict[Key, np.ndarray]:
    """Values of all blocks: the guess, completed by start values of parameters that are not guessed."""
    rig, values = inputs.rig, guess_values | {SIZE: np.ones(1), (WORLD, GRAVITY.name): np.full(1, inputs.rig.gravity)}
    for name in inputs.bodies.bending:
        values[name, "shape"] = np.zeros(len(SHAPE_LABELS))
    for reference in inputs.bodies.names[:1]:
        values[reference, "rotation"], values[reference, "translation"] = np.eye(3), np.zeros(3)
        values[reference, SHEET_MIDDLE.name] = np.zeros(2)
    for sensor in rig.sensors.values():
        for spec in sensor.specs():
            if spec.manifold == "nuisance" or spec.is_auxiliary or spec.starts_at_zero:  # none of these is guessed
                stated = getattr(sensor, spec.name).value
                values[sensor.name, spec.name] = np.zeros(spec.size) if stated is None else stated.copy()
    for sensor in rig.mounted:
        if (offset := values.get((sensor.name, TIME_OFFSET.name))) is not None:
            values[sensor.name, TIME_OFFSET.name] = np.broadcast_to(offset, inputs.clocks_of(sensor))
    return {key: np.ascontiguousarray(v, dtype=np.float64) for key, v in values.items()}


# Gauge freedom of the world frame in a rig without a target: the first keyframe is fixed.
#
# A target defines the world frame. Planes and points do not: moving everything, or rotating everything about gravity,
# changes no measurement.

# Names of blocks that are estimated in a world frame of which only gravity is known.
IN_THE_WORLD = (PLANE.name, *(spec.name for spec in (*SENSOR_FRAME, *LEVEL_FRAME, FRAME_OFFSET)))

# Information [1/m^2, 1/rad^2] along the gauge directions. Its value does not matter if all else is observable.
# Otherwise a step may move planes and sensors along a fixed direction, and compensate by a rotation of the world as far
# as this information allows. With a small value the solver then drifts.
FRAME_INFORMATION = 1e10


def hold_frame(
    state: State, piece: Piece, keyframe: int, levelled: bool, information: float = FRAME_INFORMATION
) -> None:
    """Adds information to `piece` that fixes the position of `keyframe` and its rotation about gravity. If gravity is
    unknown (`levelled` False), the whole rotation is fixed. The gradient is zero, because no measurement depends on
    these directions."""
    k, up = keyframe - piece.first, state.rotation[keyframe][2]
    piece.diagonal[k, 0:3, 0:3] += information * (np.outer(up, up) if levelled else np.eye(3))
    piece.diagonal[k, range(3, 6), range(3, 6)] += information


# Prior uncertainty of the initial guess, and Gaussian priors about the guess.
#
# The priors keep unobservable directions near the guess while the solver runs.


def guess_sigma(inputs: Inputs, state: State) -> np.ndarray:
    """(B,) prior standard deviations of the guess: as the rig file states them, else default ones. state: at which
    effects of one parameter on another are linearised."""
    sigma = np.zeros(inputs.layout.size)
    for b in inputs.layout.free:
        stated = inputs.stated(b)
        is_guessed = b.name != TRANSLATION.name or stated is None or stated.value is not None
        sigma[b.columns] = inputs.specs[b.key].prior_sigma if is_guessed else UNGUESSED_TRANSLATION_SIGMA_M
    for sensor in inputs.sensors:
        model_of(sensor).widen_guess_sigma(sensor, inputs.layout, state, sigma)
    for prior in stated_priors(inputs):
        sigma[prior.block.columns] = prior.sigma
    return sigma


def guess_priors(inputs: Inputs, guess: State, times: float = 1.0) -> tuple[Prior, ...]:
    """Priors about `guess` on all estimated parameters of sensors that have no other prior. Their standard deviation
    is `times` that of `guess_sigma`."""
    sigma = times * guess_sigma(inputs, guess)
    given = {p.block.key for p in stated_priors(inputs)}
    return tuple(
        Prior(b, guess.values[b.key], sigma[b.columns])
        for b in inputs.layout.free
        if inputs.is_sensor(b.sensor) and b.key not in given and not b.is_nuisance
    )
