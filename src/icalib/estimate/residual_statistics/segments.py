"""Independent segments of a recording: information and gradient of each on the calibration parameters, its keyframes
eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.problem.gauge import FRAME_INFORMATION, IN_THE_WORLD, hold_frame
from icalib.estimate.problem.outcome import Outcome
from icalib.estimate.problem.problem import Problem
from icalib.motion.factor import Residuals
from icalib.optim.arrowhead import Piece, in_parallel, marginalise
from icalib.optim.state import State

MIN_SEGMENT_KEYFRAMES = 3  # between the ends of a segment
MIN_SEGMENTS_AT_REST = 4  # of poses at rest: the scatter of fewer is not informative
# Information [1/m^2, 1/rad^2] on the gauge of each segment, if segments share planes or the frame of a pose sensor.
# With FRAME_INFORMATION each segment would seem to measure where these are. If segments share nothing in the world,
# FRAME_INFORMATION is used, because so little would be lost in rounding.
LOOSE_FRAME_INFORMATION = 1e-3


class PieceGradient(NamedTuple):
    """Gradient of half the chi^2 of a segment. chain (n, 15): of its keyframes from `first` on; calib (B,): of the
    calibration parameters."""

    first: int
    chain: np.ndarray
    calib: np.ndarray

    @classmethod
    def of(cls, piece: Piece) -> PieceGradient:
        """The gradient in the sums of `piece`, before it is eliminated."""
        return cls(piece.first, piece.side[:, :, -1].copy(), piece.calib[:-1, -1].copy())

    def add(self, piece: Piece, column: int) -> None:
        """Adds the gradient to `column` of `piece`. A keyframe that two pieces share counts in the earlier one, the
        calibration parameters in the piece of the segment's first keyframe."""
        first = piece.first + (piece.first > 0)
        start, end = max(first, self.first), min(piece.last + 1, self.first + len(self.chain))
        if start < end:
            piece.side[start - piece.first : end - piece.first, :, column] += self.chain[
                start - self.first : end - self.first
            ]
        if first <= self.first <= piece.last:
            piece.calib[: len(self.calib), column] += self.calib


@dataclass(frozen=True)
class Segments:
    """Segments of `problem` at `state`; feature tracks are cut at their ends. ends (G + 1,): keyframes that bound the
    segments.

    sums (G, B + 1, B + 1): information of each segment alone on the calibration parameters, its gradient in the last
    column. The trajectory of each segment is eliminated on its own. gradients (G, B), information (B, B): gradient of
    each segment and information of all, the joint trajectory eliminated. Priors have no part in any of them.
    """

    problem: Problem
    state: State
    ends: np.ndarray
    sums: np.ndarray
    gradients: np.ndarray
    information: np.ndarray

    @classmethod
    def of(cls, problem: Problem, outcome: Outcome, count: int) -> Segments | None:
        """About `count` segments of similar length, at least one per recording. None if they would be too short, or if
        one cannot be solved alone."""
        count, fewest = _as_many_as_stand_alone(problem, count)
        if count < 2:
            return None
        ends = segment_ends(problem.chain.starts, problem.n_keyframes, count)
        if len(ends) < 3 or np.diff(ends).min() < fewest:
            return None
        parts = cls(problem.cut(outcome.state, ends[:-1]), outcome.state, ends, *[np.zeros(0)] * 3)
        scratch = parts.problem.reusable_output(outcome.residuals)
        try:
            gradients, sums = zip(*in_parallel(lambda g: parts.alone(g, scratch), range(len(ends) - 1)), strict=True)
            joint = parts.together(gradients, scratch)
        except EstimationError:
            return None
        B = problem.layout.size
        return replace(parts, sums=np.array(sums), gradients=joint[:B, B:-1].T, information=joint[:B, :B])

    @property
    def count(self) -> int:
        return len(self.ends) - 1

    def piece(self, g: int, scratch: Residuals) -> Piece:
        """Sums of segment `g`, its keyframes not yet eliminated; fills `scratch` with its residuals."""
        problem, state = self.problem, self.state
        first, last = (int(k) for k in self.ends[g : g + 2])
        piece = problem.attach(Piece.zeros(first, last, problem.layout.size))
        problem.add_measurements(state, piece, scratch)
        problem.add_bias_prior(state, piece)
        if not problem.framed:
            shared = any(b.name in IN_THE_WORLD for b in problem.layout.blocks)
            hold_frame(state, piece, first, problem.levelled, LOOSE_FRAME_INFORMATION if shared else FRAME_INFORMATION)
        # Nothing links the first keyframe of a recording to the one before, and its images belong to the next segment.
        return piece.without_last() if last in problem.chain.starts else piece

    def alone(self, g: int, scratch: Residuals) -> tuple[PieceGradient, np.ndarray]:
        """Gradient of segment `g`, and its sums (B + 1, B + 1) with its keyframes eliminated."""
        piece = self.piece(g, scratch)
        return PieceGradient.of(piece), marginalise(piece)

    def together(self, gradients: Sequence[PieceGradient], scratch: Residuals) -> np.ndarray:
        """System (B + G + 1, B + G + 1) of the calibration parameters, the joint trajectory eliminated. Column B + g is
        the gradient of segment g.

        Gradients of eliminated points of the scene are zero, because each point is optimal for the current state.
        """

        def piece_between(first: int, last: int) -> Piece:
            piece = self.problem.piece_with_columns(self.state, first, last, len(gradients), scratch)
            for column, gradient in enumerate(gradients, self.problem.layout.size):
                gradient.add(piece, column)
            return piece

        return self.problem.marginal(piece_between)

    def cost(self, g: int, state: State, out: Residuals) -> float:
        """Half the robust chi^2 of segment `g` at `state`; fills `out` with its residuals."""
        piece = Piece.bare(int(self.ends[g]), int(self.ends[g + 1]))
        return self.problem.add_measurements(state, piece, out, sums=False) + self.problem.add_bias_prior(
            state, piece, sums=False
        )


def _as_many_as_stand_alone(problem: Problem, count: int) -> tuple[int, int]:
    """Number of segments for the wanted `count`, and least number of keyframes in each.

    Images that no factor links are independent: if there are few, each but the last is a segment.
    """
    if problem.chain.imu is not None:
        return min(count, (problem.n_keyframes - 1) // MIN_SEGMENT_KEYFRAMES), MIN_SEGMENT_KEYFRAMES
    others = [f for f in problem.factors.values() if f is not problem.chain]
    if any(f.is_sparse for f in others):  # poses at rest, of which there may be few
        fewer = min(count, problem.n_keyframes // MIN_SEGMENT_KEYFRAMES)
        return fewer if fewer >= MIN_SEGMENTS_AT_REST else 0, MIN_SEGMENT_KEYFRAMES
    few = count > 0 and problem.n_keyframes <= MIN_SEGMENT_KEYFRAMES * count
    return problem.n_keyframes - 1 if few else count, 1


def segment_ends(starts: tuple[int, ...], n_keyframes: int, segments: int) -> np.ndarray:
    """(segments + 1,) keyframes that bound segments, among them the start of each recording. With more recordings than
    `segments` there are more."""
    edges = np.array([*starts, n_keyframes - 1])
    counts = np.maximum(np.round(segments * np.diff(edges) / edges[-1]).astype(int), 1)
    pieces = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(edges[:-1], edges[1:], counts, strict=True)]
    return np.concatenate([*pieces, edges[-1:]]).astype(int)
