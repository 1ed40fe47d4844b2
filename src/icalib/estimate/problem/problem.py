"""The least-squares problem of one pass: sums of all factors and priors over the pieces of the chain (iCalib paper
(15))."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np

from icalib.estimate.problem.gauge import hold_frame
from icalib.motion.factor import Factor, FactorKey, Residuals, Whitened, keyed
from icalib.motion.imu_data import ImuData
from icalib.optim import arrowhead
from icalib.optim.arrowhead import Piece, in_parallel, make_pieces, marginalise, marginalise_in_segments
from icalib.optim.calib_block import NO_DIRECTIONS
from icalib.optim.prior_factor import Prior
from icalib.optim.state import Layout, State


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
    def ties_distant_keyframes(self) -> bool:
        """Whether a factor links keyframes that are not neighbours, so that segments of the chain are not
        independent."""
        return any(f.ties_distant_keyframes for f in self.factors.values())

    def replacing(self, factors: Sequence[Factor]) -> Problem:
        """The same problem with `factors` instead of those with the same keys; factors with new keys are added."""
        return replace(self, factors=self.factors | keyed(factors))

    def pieces(self, sums: bool = True) -> tuple[Piece, ...]:
        """Pieces of the chain, sums zero; without `sums`, for residuals only."""
        pieces = make_pieces(self.n_keyframes, self.layout.size if sums else None)
        return tuple(self.attach(p, len(pieces) > 1) for p in pieces) if sums else pieces

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
        if self.ties_distant_keyframes:
            return marginalise(sums_of(0, self.n_keyframes - 1))
        return marginalise_in_segments(sums_of, self.n_keyframes)

    def sums_of(self, state: State, first: int, last: int) -> Piece:
        """Sums between keyframes `first` and `last`, with the true curvature of robust losses. Residuals are
        discarded."""
        piece = self.attach(Piece.zeros(first, last, self.layout.size))
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
        narrow = self.attach(Piece.zeros(first, last, size))
        self.add_measurements(state, narrow, out)
        self.add_bias_prior(state, narrow)
        self.hold_frames(state, narrow)
        wide = Piece.zeros(first, last, size + n_columns)
        wide.side[:, :, :size], wide.calib[:size, :size] = narrow.side[:, :, :size], narrow.calib[:size, :size]
        features = None if narrow.features is None else narrow.features.widened(size + n_columns)
        return replace(narrow, side=wide.side, calib=wide.calib, features=features)
