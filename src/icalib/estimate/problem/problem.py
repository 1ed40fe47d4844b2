"""Where factors and solver meet: all measurements, as sums over the pieces of the chain (paper (15))."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

import numpy as np

from icalib.estimate.problem.gauge import hold_frame
from icalib.motion.factor import SensorFactor, Whitened
from icalib.optim.arrowhead import Piece, in_parallel, make_pieces, marginalise, marginalise_in_segments
from icalib.optim.border import NOTHING
from icalib.optim.prior_factor import Prior
from icalib.optim.state import Layout, State
from icalib.sensors.camera.corner_factor import CornerFactor, CornerOutput
from icalib.sensors.camera.features.feature_factor import FeatureFactor, FeatureOutput
from icalib.sensors.imu.residual import ROWS


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

    def accumulate(self, state: State, piece: Piece, out: np.ndarray, sums: bool = True) -> float:
        """Fills whitened residuals `out` (K - 1, 15) of `piece`, adds them to its sums; returns half the chi^2."""
        ...

    def accumulate_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Adds what keeps the biases of those `starts` defined that lie in `piece`, its last node aside; returns half
        its chi^2."""
        ...


@dataclass(frozen=True)
class Residuals:
    """What the factors left behind at a state: the chain's whitened residuals (K - 1, 15), the corners' by camera, the
    features'."""

    imu: np.ndarray
    corners: tuple[CornerOutput, ...]
    features: FeatureOutput | None = None
    sensors: tuple[Whitened, ...] = ()  # but for the cameras


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
    sensors: tuple[SensorFactor, ...] = ()  # but for the cameras
    framed: bool = True  # a target says where the world's origin is; else nothing does, and it stays where it is
    levelled: bool = True  # gravity says which way is up

    @property
    def n_nodes(self) -> int:
        return self.chain.n_nodes

    def pieces(self, sums: bool = True) -> tuple[Piece, ...]:
        """The chain in pieces; without `sums`, only residuals can be asked for."""
        pieces = make_pieces(self.n_nodes, self.layout.size if sums else None)
        return tuple(self.with_features(p, len(pieces) > 1) for p in pieces) if sums else pieces

    def with_features(self, piece: Piece, keep: bool = False) -> Piece:
        """The piece with room for the features seen from its nodes; `keep`: another piece shares a node with it."""
        return piece if self.features is None else self.features.attach(piece, keep)

    def without(self, priors: Sequence[Prior]) -> Problem:
        """The same problem, in which `priors` of it count no more."""
        gone = {id(p) for p in priors}
        return replace(self, priors=tuple(p for p in self.priors if id(p) not in gone))

    def cut(self, state: State, nodes: np.ndarray) -> Problem:
        """The same problem, in which features end at `nodes`, so that pieces between these can stand alone."""
        if self.features is None:
            return self
        return replace(self, features=self.features.cut(state, tuple(int(k) for k in nodes)))

    def marginal(self, sums_of: Callable[[int, int], Piece]) -> np.ndarray:
        """Border (B + 1, B + 1) of `sums_of` from one node to another, all nodes eliminated: a segment at a time, but
        where features tie distant nodes."""
        if self.features is not None:
            return marginalise(sums_of(0, self.n_nodes - 1))
        return marginalise_in_segments(sums_of, self.n_nodes)

    def sums_of(self, state: State, first: int, last: int) -> Piece:
        """The sums between two nodes alone, with the true curvature of robust losses; residuals are not kept."""
        piece = self.with_features(Piece.zeros(first, last, self.layout.size))
        self.chain.accumulate(state, piece, np.zeros((self.n_nodes - 1, ROWS)))
        for camera in self.cameras:
            camera.accumulate(state, piece, None, curved=True)
        if self.features is not None:
            self.features.accumulate(state, piece, self.features.output(), curved=True)
        for sensor in self.sensors:
            sensor.accumulate(state, piece, sensor.output(), curved=True)
        self.add_bias_prior(state, piece)
        for prior in self.priors if first == 0 else ():
            prior.accumulate(state, piece)
        self.hold_frames(state, piece)
        return piece

    def residuals(self) -> Residuals:
        """Empty arrays for `linearise` to fill."""
        corners = tuple(c.output() for c in self.cameras)
        features = None if self.features is None else self.features.output()
        sensors = tuple(s.output() for s in self.sensors)
        return Residuals(np.zeros((self.n_nodes - 1, ROWS)), corners, features, sensors)

    def scratch(self, at: Residuals) -> Residuals:
        """`at`, to be filled once more, with room for features of this problem's own."""
        return replace(at, features=None if self.features is None else self.features.output())

    def settled(self, at: Residuals) -> Problem:
        """The same problem, points of the scene first looked for where they were at `at`."""
        if self.features is None or at.features is None:
            return self
        return replace(self, features=self.features.settled(at.features))

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
            self.hold_frames(state, piece)
        return cost

    def hold_frames(self, state: State, piece: Piece) -> None:
        """Each recording's world stays where it is, if nothing says where that is."""
        for node in self.chain.starts if not self.framed else ():
            if piece.first <= node < piece.last:
                hold_frame(state, piece, node, self.levelled)

    def add_measurements(
        self, state: State, piece: Piece, out: Residuals, sums: bool = True, curved: bool = False
    ) -> float:
        """Adds IMU, corners, features and other sensors in `piece`; returns half their robust chi^2."""
        cost = self.chain.accumulate(state, piece, out.imu, sums)
        for camera, corners in zip(self.cameras, out.corners, strict=True):
            cost += camera.accumulate(state, piece, corners, sums, curved)
        if self.features is not None and out.features is not None:
            cost += self.features.accumulate(state, piece, out.features, sums, curved)
        for sensor, rows in zip(self.sensors, out.sensors, strict=True):
            cost += sensor.accumulate(state, piece, rows, sums, curved)
        return cost

    def add_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Adds the broad prior on the biases of recordings' first nodes, about those that the pass started from."""
        return self.chain.accumulate_bias_prior(state, piece, sums)

    @staticmethod
    def narrow(piece: Piece, n_border: int) -> Piece:
        """A piece over the same chain blocks with a border of its own, `n_border` wide."""
        own = Piece.zeros(piece.first, piece.last, n_border)
        return Piece(piece.first, piece.last, piece.diagonal, piece.upper, own.side, own.border)
