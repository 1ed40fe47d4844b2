"""Statistics of the residuals after a fit: degrees of freedom, covariances from segments and from clusters, parameters
that change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.inputs import Inputs
from icalib.estimate.problem import FRAME_INFORMATION, IN_THE_WORLD, Problem, hold_frame
from icalib.estimate.solver import Outcome, posterior
from icalib.kinds import models
from icalib.model.sensor_model import Fit
from icalib.motion.factor import FactorKey, FitKey, RawSize, ResidualRows, Residuals, Squares, StateDifference
from icalib.optim.arrowhead import (
    Draw,
    Piece,
    Prior,
    in_parallel,
    marginalise,
    restricted_inverse,
    sums_of_priors,
    variance_of_priors,
)
from icalib.optim.state import State

# Degrees of freedom after the fit.

DRAW_STEP = 1e-3  # of a posterior draw: step of difference quotients, small enough to be linear


def fits(problem: Problem, outcome: Outcome) -> list[Fit]:
    """chi^2 and degrees of freedom after the fit, of each kind of residual of every sensor.

    A draw x from the posterior has the covariance H^-1. So |J_s x|^2 has the mean tr(J_s H^-1 J_s^T), the degrees of
    freedom that the fit takes from sensor s. J x is a difference quotient of the residuals.
    """
    spent: dict[FitKey, list[float]] = {}
    for draw in (outcome.draws or posterior(problem, outcome.state)).free:
        for key, value in _spent(problem, outcome, draw).items():
            spent.setdefault(key, []).append(value)
    squares = chi2_by_kind(problem, outcome.residuals)
    return [Fit(*key, n, n - float(np.mean(spent[key])), chi2) for key, (n, chi2) in squares.items()]


def chi2_by_kind(problem: Problem, at: Residuals) -> dict[FitKey, Squares]:
    """Number and chi^2 of each kind of residual of each sensor, with the current robust weights."""
    return {kind: squares for key, f in problem.factors.items() for kind, squares in f.squares(at[key]).items()}


def raw_sizes(problem: Problem, at: Residuals) -> dict[FitKey, RawSize]:
    """RMS of each kind of residual before whitening, its unit, and the number of outliers."""
    return {kind: size for key, f in problem.factors.items() for kind, size in f.sizes(at[key]).items()}


def rows_of(outcome: Outcome, sensor: str, kind: str) -> ResidualRows | None:
    """Residuals of one kind by one sensor; None if no factor has any."""
    for key, factor in outcome.problem.factors.items():
        for rows in factor.rows(outcome.residuals[key], outcome.state):
            if (rows.sensor, rows.kind) == (sensor, kind):
                return rows
    return None


def _spent(problem: Problem, outcome: Outcome, draw: Draw) -> dict[FitKey, float]:
    """|J_s x|^2 of each kind of residual of each sensor, for one draw x."""
    start, end = (outcome.state.retract(problem.layout, s * draw.chain, s * draw.calib) for s in (0.0, DRAW_STEP))
    along, at = StateDifference(start, end, DRAW_STEP), outcome.residuals
    return {kind: dof for key, f in problem.factors.items() for kind, dof in f.dof_used(at[key], along).items()}


# Independent segments of a recording: information and gradient of each on the calibration parameters, its keyframes
# eliminated.

MIN_SEGMENT_KEYFRAMES = 3  # between the ends of a segment
MIN_SEGMENTS_AT_REST = 4  # of poses at rest: the scatter of fewer is not informative
# Information [1/m^2, 1/rad^2] on the gauge of each segment, if segments share planes or the frame of a pose sensor.
# With FRAME_INFORMATION each segment would seem to measure where these are. If segments share nothing in the world,
# FRAME_INFORMATION is used, because so little would be lost in rounding.
LOOSE_FRAME_INFORMATION = 1e-3


class PieceGradient(NamedTuple):
    """Gradient of half the chi^2 of a segment. chain (n, D): of its keyframes from `first` on; calib (B,): of the
    calibration parameters. Or m columns of its information: chain (n, D, m), calib (B, m)."""

    first: int
    chain: np.ndarray
    calib: np.ndarray

    @classmethod
    def of(cls, piece: Piece, columns: int | np.ndarray = -1) -> PieceGradient:
        """The gradient in the sums of `piece`, before it is eliminated, or its `columns`."""
        return cls(piece.first, piece.side[:, :, columns].copy(), piece.calib[:-1, columns].copy())

    def add(self, piece: Piece, columns: int | np.ndarray) -> bool:
        """Adds the gradient to `columns` of `piece`. A keyframe that two pieces share counts in the earlier one, the
        calibration parameters in the piece of the segment's first keyframe. Returns whether it is this."""
        first = piece.first + (piece.first > 0)
        start, end = max(first, self.first), min(piece.last + 1, self.first + len(self.chain))
        if start < end:
            piece.side[start - piece.first : end - piece.first, :, columns] += self.chain[
                start - self.first : end - self.first
            ]
        if is_first := first <= self.first <= piece.last:
            piece.calib[: len(self.calib), columns] += self.calib
        return is_first


@dataclass(frozen=True)
class Segments:
    """Segments of `problem` at `state`; `of` cuts feature tracks at their ends. ends (G + 1,): keyframes that bound the
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
        if (parts := cls.between(problem, outcome.state, count)) is None:
            return None
        ends = parts.ends
        parts = replace(parts, problem=problem.cut(outcome.state, ends[:-1]))
        scratch = parts.problem.reusable_output(outcome.residuals)
        try:
            gradients, sums = zip(*in_parallel(lambda g: parts.alone(g, scratch), range(len(ends) - 1)), strict=True)
            joint = parts.together(gradients, scratch)
        except EstimationError:
            return None
        B = problem.layout.size
        return replace(parts, sums=np.array(sums), gradients=joint[:B, B:-1].T, information=joint[:B, :B])

    @classmethod
    def between(cls, problem: Problem, state: State, count: int) -> Segments | None:
        """As `of`, without sums, and with whole tracks."""
        count, fewest = _as_many_as_stand_alone(problem, count)
        if count < 2:
            return None
        ends = segment_ends(problem.chain.starts, problem.n_keyframes, count)
        if len(ends) < 3 or np.diff(ends).min() < fewest:
            return None
        return cls.at(problem, state, ends)

    @classmethod
    def at(cls, problem: Problem, state: State, ends: np.ndarray) -> Segments:
        """Segments bounded by the keyframes `ends` (G + 1,), without sums, and with whole tracks."""
        return cls(problem, state, ends, *[np.zeros(0)] * 3)

    @property
    def count(self) -> int:
        return len(self.ends) - 1

    def piece(self, g: int, scratch: Residuals) -> Piece:
        """Sums of segment `g`, its keyframes not yet eliminated; fills `scratch` with its residuals."""
        problem, state = self.problem, self.state
        first, last = (int(k) for k in self.ends[g : g + 2])
        piece = problem.attach(problem.zeros(first, last))
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

    def varying(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Information (n, n) and gradient (n,) of the B calibration parameters and, in each segment, of a further part
        of m of them, those with `columns`; n = B + G m. The joint trajectory is eliminated, priors are included."""
        problem, state, B, m = self.problem, self.state, self.problem.layout.size, len(columns)
        repeats, plain = B + np.arange(self.count * m).reshape(self.count, m), problem.without_tracks()
        scratch, n = problem.residuals(), B + self.count * m
        of_column = np.tile(np.append(np.arange(B), -1), (self.count, 1))
        of_column[:, columns] = repeats
        tracks = [(key, f.by_segment(self.ends, of_column)) for key, f in problem.tracks.items()]

        def columns_of(g: int) -> tuple[PieceGradient, PieceGradient]:
            piece = replace(self, problem=plain).piece(g, scratch)
            return PieceGradient.of(piece, columns), PieceGradient.of(piece)

        of_segments = in_parallel(columns_of, range(self.count))

        def piece_between(first: int, last: int) -> Piece:
            piece = plain.piece_with_columns(state, first, last, n - B, scratch)
            for part, (information, gradient) in zip(repeats, of_segments, strict=True):
                if information.add(piece, part):
                    piece.calib[np.ix_(part, part)] += information.calib[columns]
                    piece.calib[part, n] += gradient.calib[columns]
                gradient.add(piece, n)
            piece.side[:, :, columns] = piece.calib[columns] = piece.calib[:, columns] = 0.0  # all are in segments
            for key, factor in tracks:
                piece = factor.attach(piece, False)
                factor.accumulate(state, piece, scratch[key])
            return piece

        whole = problem.marginal(piece_between)
        whole = np.triu(whole) + np.triu(whole, 1).T
        whole[columns] = whole[repeats].sum(axis=0)
        whole[:, columns] = whole[:, repeats].sum(axis=1)
        information, gradient = whole[:-1, :-1], whole[:-1, -1]
        _, pull, known = sums_of_priors(problem.priors, state, B)
        information[:B, :B] += known
        gradient[:B] += pull
        return information, gradient

    @property
    def known(self) -> np.ndarray:
        """(G, B, B) information of each segment, with an equal share of what only the joint trajectory adds."""
        alone = self.sums[:, :-1, :-1]
        return alone + (self.information - alone.sum(axis=0)) / self.count

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


# Covariances from the scatter of segments.


def split_covariance(outcome: Outcome, parts: Segments) -> np.ndarray:
    """(B, B) covariance of the calibration parameters from the scatter of segments.

    The gradient b_g of segment g at the joint optimum, the joint trajectory marginalised, would be zero but for noise.
    With the joint information S, the scatter gives S^-1 (G / (G - 1) sum (b_g - b)(b_g - b)^T) S^-1, the block
    jackknife to first order.
    """
    b, n = parts.gradients, parts.count
    return n / (n - 1.0) * spread_covariance(parts.problem, outcome, b - b.mean(axis=0))


def split_expectation(outcome: Outcome, parts: Segments) -> np.ndarray:
    """(B,) expected variances of `split_covariance` for white noise.

    At the joint optimum the gradient of segment g has the covariance S_g - S_g S^-1 S_g, because a segment with much
    information pulls the optimum towards itself (leverage; Bell and McCaffrey 2002). S_g is the information of the
    segment alone, and an equal share of what only the joint trajectory adds. For equal segments these are the formal
    variances.
    """
    t, n = parts.problem.tolerance, parts.count
    inverse = restricted_inverse(outcome.information * t[:, None] * t, parts.problem.fixed_directions)
    known = parts.known * t[:, None] * t
    left = (known - known @ inverse @ known).sum(axis=0)
    return t**2 * n / (n - 1.0) * np.diag(inverse @ left @ inverse)


def spread_covariance(problem: Problem, outcome: Outcome, b: np.ndarray) -> np.ndarray:
    """S^-1 (sum b_g b_g^T) S^-1 for gradients b (G, B) and the information S of `outcome`; zero along fixed
    directions."""
    t = problem.tolerance
    inverse = restricted_inverse(outcome.information * t[:, None] * t, problem.fixed_directions)
    half = t[:, None] * (inverse @ (t[:, None] * b.T))
    return half @ half.T


# Cluster-robust covariances, for errors that correlate within clusters such as a region of the image or of the target.
#
# A lens that its model does not fit, or a target that is not as drawn, makes the same errors in all segments of a
# recording. The scatter over segments does not show them. The gradient of a cluster would be zero but for noise.
# Measurements in no cluster, such as those of the IMU, form one more cluster, unless the clusters are a sample (Liang
# and Zeger 1986).


@dataclass(frozen=True)
class ClusterCovariances:
    """Cluster-robust covariances (B, B). regions: one for each way to divide images or target into regions, such as
    image cells. tracks: for groups of feature tracks, None without tracks."""

    regions: list[np.ndarray]
    tracks: np.ndarray | None


def cluster_covariances(problem: Problem, outcome: Outcome) -> ClusterCovariances:
    """Cluster-robust (sandwich) covariances of the calibration parameters."""
    every = [c for model in models().values() for c in model.clusters(problem.factors)]
    gradients = _cluster_gradients(problem, outcome, [c.of_factor for c in every]) if every else []
    regions, tracks = [], None
    for clusters, b in zip(every, gradients, strict=True):
        if clusters.is_sample:
            centred = b - b.mean(axis=0)
            tracks = len(b) / (len(b) - 1.0) * spread_covariance(problem, outcome, centred)
        else:
            regions.append(spread_covariance(problem, outcome, np.vstack([b, -b.sum(axis=0)])))
    return ClusterCovariances(regions, tracks)


def _count(clusters: Mapping[FactorKey, Any]) -> int:
    """Number of clusters."""
    arrays = [a for labels in clusters.values() for a in (labels if isinstance(labels, list) else [labels])]
    return 1 + max(int(a.max(initial=-1)) for a in arrays)


def _cluster_gradients(
    problem: Problem, outcome: Outcome, kinds: Sequence[Mapping[FactorKey, Any]]
) -> list[np.ndarray]:
    """Gradient of each cluster, (clusters, B) for each of `kinds`; chain and points are marginalised.

    Each cluster gets a column beside the calibration parameters, with its gradient as the right-hand side. Eliminating
    the chain and the points then marginalises all gradients at once.
    """
    counts = [_count(kind) for kind in kinds]
    B, state, at = problem.layout.size, outcome.state, problem.reusable_output(outcome.residuals)
    starts = B + np.cumsum([0, *counts])

    def segment(first: int, last: int) -> Piece:
        piece = problem.piece_with_columns(state, first, last, sum(counts), at)
        for kind, n, column in zip(kinds, counts, starts[:-1].tolist(), strict=True):
            for key, cluster in kind.items():
                factor: Any = problem.factors[key]  # it has `accumulate_clusters`
                factor.accumulate_clusters(state, piece, at[key], cluster, n, column)
        return piece

    rest = problem.marginal(segment)
    return [rest[:B, a:b].T for a, b in pairwise(starts)]


# Weights of priors on nuisance parameters, if errors of measurements exceed the stated noise.
#
# With the right model and noise, least squares weights priors and measurements by their information. Errors of real
# measurements are correlated over time, and their covariance is F^2 times the formal one. F^2 comes from the block
# jackknife over segments of the recording. With formal weights, errors of measurements would move nuisance parameters
# too far. So the priors are multiplied by F^2 in one more solve (variance component of the measurements; Koch,
# Parameter Estimation and Hypothesis Testing in Linear Models, 1999, section 3.6). All standard deviations are then F
# times the formal ones, even of a parameter that only its prior determines.

MIN_INFLATION = 1.5  # below it, other weights of the priors would gain less than a tenth of a standard deviation
ROUNDING_OF_VARIANCE = 1e-9  # of a variance: rounding error, if priors contribute all of it
MAX_LEVERAGE = 4.0  # formal over expected variance: beyond it, one segment has nearly all information


def noise_variance(problem: Problem, outcome: Outcome) -> np.ndarray:
    """(B,) part of the formal variances that noise of the measurements contributes. Priors on nuisance parameters
    contribute the rest."""
    t = problem.tolerance
    inverse = t[:, None] * restricted_inverse(t[:, None] * outcome.information * t, problem.fixed_directions) * t
    whole = np.diag(inverse)
    return np.maximum(
        whole - variance_of_priors(inverse, nuisance_priors(problem), outcome.state), ROUNDING_OF_VARIANCE * whole
    )


def nuisance_priors(problem: Problem) -> list[Prior]:
    """The priors on nuisance parameters."""
    return [p for p in problem.priors if p.block.is_nuisance]


def spread_variance(outcome: Outcome, parts: Segments, white: np.ndarray) -> np.ndarray:
    """(B,) variances from the scatter over `parts`. white (B,): contribution of white noise to the formal variances."""
    spread, expected = np.diag(split_covariance(outcome, parts)), split_expectation(outcome, parts)
    return np.clip(white / np.maximum(expected, 1e-300), 1.0, MAX_LEVERAGE) * spread


def calibration_columns(inputs: Inputs) -> np.ndarray:
    """Calibration columns that matter to a user: of sensors, without nuisance and auxiliary parameters."""
    blocks = (b for b in inputs.layout.free if inputs.is_sensor(b.sensor) and not b.is_nuisance)
    return np.concatenate([np.arange(0), *(b.columns for b in blocks if not inputs.specs[b.key].is_auxiliary)])


def inflation(inputs: Inputs, outcome: Outcome) -> float:
    """F, RMS over `calibration_columns` of the ratio of empirical to formal standard deviation. 1 without priors on
    nuisance parameters, or if the recording cannot be divided."""
    problem, columns = outcome.problem, calibration_columns(inputs)
    if not nuisance_priors(problem) or not len(columns):
        return 1.0
    parts = Segments.of(problem, outcome, inputs.rig.settings.segments)
    if parts is None:
        return 1.0
    white = noise_variance(problem, outcome)
    ratio = spread_variance(outcome, parts, white) / white
    return float(np.sqrt(np.mean(ratio[columns])))


def with_priors_weighed(problem: Problem, factor: float) -> Problem:
    """The problem with the information of priors on nuisance parameters multiplied by `factor`^2."""
    priors = (replace(p, sigma=p.sigma / factor) if p.block.is_nuisance else p for p in problem.priors)
    return replace(problem, priors=tuple(priors))
