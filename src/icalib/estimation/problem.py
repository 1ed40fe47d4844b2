"""Where factors and solver meet: all measurements, as sums over the pieces of the chain (paper (15))."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

import numpy as np

from icalib.estimation.arrowhead import NOTHING, Piece, in_parallel, make_pieces
from icalib.estimation.corner_factor import CornerFactor, CornerOutput
from icalib.estimation.feature_factor import FeatureFactor, FeatureOutput, hold_frame
from icalib.estimation.imu_factor import ROWS
from icalib.estimation.prior_factor import Prior
from icalib.estimation.state import Layout, State


class ChainFactor(Protocol):
    """What ties the nodes together: an `ImuFactor`, or `FreeNodes`. kinds: rows of its residuals by name; starts: the
    first node of each recording, which nothing ties to the one before."""

    @property
    def name(self) -> str: ...

    @property
    def n_nodes(self) -> int: ...

    @property
    def starts(self) -> tuple[int, ...]: ...

    kinds: ClassVar[dict[str, slice]]

    def accumulate(
        self, state: State, piece: Piece, out: np.ndarray, sums: bool = True, noise: np.ndarray | None = None
    ) -> float:
        """Fills whitened residuals `out` (K - 1, 15) of `piece`, adds them to its sums; returns half the chi^2."""
        ...

    def accumulate_bias_prior(self, state: State, piece: Piece, sums: bool = True, met: bool = False) -> float:
        """Adds what keeps the biases of those `starts` defined that lie in `piece`, its last node aside (`met`: as if
        they were met); returns half its chi^2."""
        ...


@dataclass(frozen=True)
class Residuals:
    """What the factors left behind at a state: the chain's whitened residuals (K - 1, 15), the corners' by camera, the
    features'."""

    imu: np.ndarray
    corners: tuple[CornerOutput, ...]
    features: FeatureOutput | None = None


@dataclass(frozen=True)
class WhiteNoise:
    """A draw in place of all whitened residuals: of the chain (K - 1, 15), of corners (N, 2) and common errors
    (V, 2, m) by camera, of features (N, 2) by camera."""

    imu: np.ndarray
    corners: tuple[tuple[np.ndarray, np.ndarray], ...]
    features: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Problem:
    """Minimise half the sum of all squared, whitened, robust residuals over a `State`."""

    layout: Layout
    chain: ChainFactor
    cameras: tuple[CornerFactor, ...]
    priors: tuple[Prior, ...]
    tolerance: np.ndarray  # (B,) what a user would call the same number; scales the border
    held: np.ndarray = field(
        default_factory=lambda: NOTHING
    )  # (B, m) orthonormal directions of the border, in tolerance units, that stay
    features: FeatureFactor | None = None
    framed: bool = True  # a target says where the world's origin is; else nothing does, and it stays where it is

    @property
    def n_nodes(self) -> int:
        return self.chain.n_nodes

    def pieces(self) -> tuple[Piece, ...]:
        pieces = make_pieces(self.n_nodes, self.layout.size)
        return tuple(self.with_features(p, len(pieces) > 1) for p in pieces)

    def with_features(self, piece: Piece, keep: bool = False) -> Piece:
        """The piece with room for the features seen from its nodes; `keep`: another piece shares a node with it."""
        return piece if self.features is None else self.features.attach(piece, keep)

    def cut(self, state: State, nodes: np.ndarray) -> Problem:
        """The same problem, in which features end at `nodes`, so that pieces between these can stand alone."""
        if self.features is None:
            return self
        return replace(self, features=self.features.cut(state, tuple(int(k) for k in nodes)))

    def residuals(self) -> Residuals:
        """Empty arrays for `linearise` to fill."""
        corners = tuple(c.output() for c in self.cameras)
        features = None if self.features is None else self.features.output()
        return Residuals(np.zeros((self.n_nodes - 1, ROWS)), corners, features)

    def linearise(
        self, state: State, pieces: tuple[Piece, ...], out: Residuals, sums: bool = True, curved: bool = False
    ) -> float:
        """Fills `pieces` and `out` at `state`; returns half the robust chi^2. `curved`: see CornerFactor.accumulate."""
        return sum(in_parallel(lambda p: self._accumulate(state, p, out, sums, curved), pieces))

    def _accumulate(self, state: State, piece: Piece, out: Residuals, sums: bool, curved: bool) -> float:
        if sums:
            piece.clear()
        cost = self.add_measurements(state, piece, out, sums, curved) + self.add_bias_prior(state, piece, sums)
        if piece.first == 0:
            cost += sum(p.accumulate(state, piece, sums) for p in self.priors)
        if sums:
            self._hold_frames(state, piece)
        return cost

    def _hold_frames(self, state: State, piece: Piece) -> None:
        """Each recording's world stays where it is, if nothing says where that is."""
        for node in self.chain.starts if not self.framed else ():
            if piece.first <= node < piece.last:
                hold_frame(state, piece, node)

    def add_measurements(
        self, state: State, piece: Piece, out: Residuals, sums: bool = True, curved: bool = False
    ) -> float:
        """Adds IMU, corners and features in `piece`; returns half their robust chi^2."""
        cost = self.chain.accumulate(state, piece, out.imu, sums)
        for camera, corners in zip(self.cameras, out.corners, strict=True):
            cost += camera.accumulate(state, piece, corners, sums, curved)
        if self.features is not None and out.features is not None:
            cost += self.features.accumulate(state, piece, out.features, sums, curved)
        return cost

    def white_noise(self, rng: np.random.Generator) -> WhiteNoise:
        """A draw in place of all residuals but those of priors."""
        at = self.residuals()
        imu = rng.standard_normal(at.imu.shape)
        corners = [(rng.standard_normal(c.residual.shape), rng.standard_normal(c.shared.shape)) for c in at.corners]
        features = () if at.features is None else at.features.residual
        return WhiteNoise(imu, tuple(corners), tuple(rng.standard_normal(r.shape) for r in features))

    def add_noise(self, state: State, piece: Piece, noise: WhiteNoise, scratch: Residuals) -> None:
        """Fills `piece` with J^T J and J^T e for white e; priors are met."""
        piece.clear()
        self.chain.accumulate(state, piece, scratch.imu, noise=noise.imu)
        for camera, corners, own in zip(self.cameras, scratch.corners, noise.corners, strict=True):
            camera.accumulate(state, piece, corners, noise=own)
        if self.features is not None and scratch.features is not None:
            self.features.accumulate(state, piece, scratch.features, noise=noise.features)
        self.add_prior_information(piece, state)

    def add_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Adds the broad prior on the biases of recordings' first nodes, about those that the pass started from."""
        return self.chain.accumulate_bias_prior(state, piece, sums)

    def add_prior_information(self, piece: Piece, state: State) -> None:
        """Adds the priors as if they were met exactly: their information, no gradient."""
        for prior in self.priors if piece.first == 0 else ():
            prior.accumulate(state, piece, residual=np.zeros(len(prior.sigma)))
        self.chain.accumulate_bias_prior(state, piece, met=True)
        self._hold_frames(state, piece)

    @staticmethod
    def narrow(piece: Piece, n_border: int) -> Piece:
        """A piece over the same chain blocks with a border of its own, `n_border` wide."""
        own = Piece.zeros(piece.first, piece.last, n_border)
        return Piece(piece.first, piece.last, piece.diagonal, piece.upper, own.side, own.border)
