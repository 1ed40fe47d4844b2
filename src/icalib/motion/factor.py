"""Interface of a factor: all measurements of one kind by one sensor."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from icalib.motion.imu_data import ImuData
from icalib.optim.arrowhead import Piece, in_parallel, make_pieces
from icalib.optim.state import State

FactorKey = tuple[str, str]  # sensor, and kind of measurement
FitKey = tuple[str, str]  # sensor, and kind of its residuals
Residuals = dict[FactorKey, Any]  # output of each factor's `accumulate` at a state
T = TypeVar("T")


class Squares(NamedTuple):
    """Residual statistics of one kind: number of measurements in use, and their chi^2 with the current robust
    weights."""

    n: int
    chi2: float


class RawSize(NamedTuple):
    """RMS of one kind of residual before whitening, and its unit; None and "" if not defined. rejected: number of
    outliers."""

    rms: float | None
    unit: str
    rejected: int = 0


@dataclass(frozen=True)
class ResidualRows:
    """Residuals (predicted - measured) of one kind by one sensor: n measurements with m columns each.

    seconds (n,): time of the measurement, or start of its interval, on the clock of the body since its first stamp.
    residual, sigma (n, m) in `unit`, SI or px; whitened (n, m): jointly if errors of columns correlate; root (n, m):
    square root of the robust weight, 0 for outliers. For rows that are defined only whitened, residual is whitened,
    sigma 1 and unit empty.
    """

    sensor: str
    kind: str
    unit: str
    seconds: np.ndarray
    residual: np.ndarray
    sigma: np.ndarray
    whitened: np.ndarray
    root: np.ndarray

    @property
    def weighted(self) -> np.ndarray:
        """(n, m) whitened residuals times the square roots of their robust weights."""
        return np.multiply(self.whitened, self.root, out=np.zeros_like(self.whitened), where=self.root > 0.0)


class StateDifference(NamedTuple):
    """A step from `start` to `end` that is `share` times the actual one, for difference quotients of residuals. The
    share is small enough for residuals to be linear."""

    start: State
    end: State
    share: float


class Factor(Protocol):
    """All measurements of one kind by one sensor. `accumulate` fills arrays of a class that the factor chooses.

    is_sparse: one keyframe alone has too few rows to determine the calibration. ties_distant_keyframes: rows share
    eliminated parameters, such as points of the scene, so that segments of the chain are not independent.
    """

    is_sparse: ClassVar[bool]
    ties_distant_keyframes: ClassVar[bool]

    @property
    def key(self) -> FactorKey: ...

    @property
    def name(self) -> str:
        """Name of the sensor."""
        ...

    def output(self) -> Any:
        """Empty arrays for `accumulate` to fill."""
        ...

    def accumulate(self, state: State, piece: Piece, out: Any, sums: bool = True, curved: bool = False) -> float:
        """Fills `out` for the measurements in `piece`, and adds them to its sums if `sums`. Returns half the robust
        chi^2.

        `curved`: J^T J uses the true curvature of the robust loss instead of its weights alone.
        """
        ...

    def squares(self, out: Any) -> dict[FitKey, Squares]:
        """Number and chi^2 of each kind of residual, with the current robust weights."""
        ...

    def sizes(self, out: Any) -> dict[FitKey, RawSize]:
        """RMS of each kind of residual before whitening, its unit, and the number of outliers."""
        ...

    def rows(self, out: Any, state: State) -> list[ResidualRows]:
        """Residuals of each kind. out: output of `accumulate` at `state`."""
        ...

    def dof_used(self, out: Any, along: StateDifference) -> dict[FitKey, float]:
        """|J x|^2 of each kind of residual for the step x, with `out` at its start. For draws x from the posterior, the
        mean is the number of degrees of freedom that the fit takes from these residuals."""
        ...

    def with_imu(self, imu: ImuData, state: State) -> Self:
        """The same measurements, with other IMU readings for the motion between keyframes. state: at whose biases
        readings are preintegrated."""
        ...

    def discarded_output(self) -> Any:
        """Output arrays for one piece, if they are not needed afterwards."""
        ...

    def reusable_output(self, out: Any) -> Any:
        """`out`, of this factor or of the one from which it was cut, as arrays to be overwritten."""
        ...

    def attach(self, piece: Piece, keep: bool) -> Piece:
        """The piece with workspace for the parameters that the factor eliminates; `keep`: a keyframe is shared with
        another piece."""
        ...

    def cut(self, state: State, keyframes: tuple[int, ...]) -> Self:
        """The same measurements, none of which depends on keyframes on both sides of one of `keyframes`."""
        ...

    def warm_started(self, out: Any) -> Self:
        """The same factor, which starts the search for its eliminated parameters from those of `out`."""
        ...


class FactorDefaults:
    """Defaults for factors that depend on neighbouring keyframes only, and have no eliminated parameters."""

    is_sparse: ClassVar[bool] = False
    ties_distant_keyframes: ClassVar[bool] = False

    def with_imu(self, imu: ImuData, state: State) -> Self:
        """See `Factor`; nothing is preintegrated."""
        del state
        factor: Any = self
        return replace(factor, imu=imu)

    def discarded_output(self) -> Any:
        """See `Factor`."""
        factor: Any = self
        return factor.output()

    def reusable_output(self, out: Any) -> Any:
        """See `Factor`."""
        return out

    def attach(self, piece: Piece, keep: bool) -> Piece:
        """See `Factor`."""
        del keep
        return piece

    def cut(self, state: State, keyframes: tuple[int, ...]) -> Self:
        """See `Factor`."""
        del state, keyframes
        return self

    def warm_started(self, out: Any) -> Self:
        """See `Factor`."""
        del out
        return self


@dataclass(frozen=True)
class Whitened:
    """Rows of a factor: residual (n, m), whitened, predicted - measured, and root (n, m), square root of each robust
    weight."""

    residual: np.ndarray
    root: np.ndarray

    @classmethod
    def empty(cls, n: int, m: int) -> Whitened:
        """Rows (n, m) to be filled."""
        return cls(np.zeros((n, m)), np.zeros((n, m)))

    @classmethod
    def without_loss(cls, n: int, m: int) -> Whitened:
        """Rows (n, m) to be filled, all weights 1."""
        return cls(np.zeros((n, m)), np.broadcast_to(1.0, (n, m)))


class _HasRows(Protocol):
    """Requirements of `RowFactor`. kinds: columns of its rows by kind of residual; units: by kind, SI."""

    units: ClassVar[Mapping[str, str]]

    @property
    def name(self) -> str: ...

    @property
    def kinds(self) -> dict[str, slice]: ...

    def accumulate(
        self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False
    ) -> float: ...

    def output(self) -> Whitened: ...

    def raw(self, out: Whitened) -> np.ndarray | None: ...

    def raw_sigma(self) -> np.ndarray: ...

    def times(self, state: State) -> np.ndarray: ...

    def count(self, out: Whitened, kind: str) -> int: ...

    def rms(self, out: Whitened, kind: str) -> tuple[float | None, str]: ...


class RowFactor(FactorDefaults):
    """A factor whose output is `Whitened` rows, with columns for each kind of residual."""

    is_sparse: ClassVar[bool] = True
    units: ClassVar[Mapping[str, str]] = {}

    def times(self, state: State) -> np.ndarray:
        """(n,) times of the rows, see `ResidualRows.seconds`."""
        raise NotImplementedError

    def raw(self, out: Whitened) -> np.ndarray | None:
        """(n, m) residuals before whitening; None if they are defined only whitened."""
        del out
        return None

    def raw_sigma(self) -> np.ndarray:
        """(n, m) standard deviations of `raw`."""
        raise NotImplementedError

    def rows(self: _HasRows, out: Whitened, state: State) -> list[ResidualRows]:
        """See `Factor`."""
        raw, seconds, residual_rows = self.raw(out), self.times(state) if self.kinds else np.zeros(0), []
        sigma = np.ones_like(out.residual) if raw is None else self.raw_sigma()
        for kind, c in self.kinds.items():
            white = out.residual[:, c]
            residual = white if raw is None else raw[:, c]
            unit = self.units.get(kind, "")
            residual_rows.append(
                ResidualRows(self.name, kind, unit, seconds, residual, sigma[:, c], white, out.root[:, c])
            )
        return residual_rows

    def rms(self: _HasRows, out: Whitened, kind: str) -> tuple[float | None, str]:
        """RMS of the residuals of `kind` before whitening, and its unit; None and "" if they are defined only
        whitened."""
        raw = self.raw(out)
        if raw is None:
            return None, ""
        residual = raw[:, self.kinds[kind]]
        return float(np.sqrt(np.mean(residual**2))) if residual.size else 0.0, self.units[kind]

    def count(self: _HasRows, out: Whitened, kind: str) -> int:
        """Number of scalar residuals of `kind` in use."""
        return out.residual[:, self.kinds[kind]].size

    def squares(self: _HasRows, out: Whitened) -> dict[FitKey, Squares]:
        """See `Factor`."""
        return {(self.name, k): Squares(self.count(out, k), chi2(out, r)) for k, r in self.kinds.items()}

    def sizes(self: _HasRows, out: Whitened) -> dict[FitKey, RawSize]:
        """See `Factor`."""
        return {(self.name, kind): RawSize(*self.rms(out, kind)) for kind in self.kinds}

    def dof_used(self: _HasRows, out: Whitened, along: StateDifference) -> dict[FitKey, float]:
        """See `Factor`."""
        slope = (output_at(self, along.end).residual - out.residual) / along.share * out.root
        return {(self.name, kind): float((slope[:, r] ** 2).sum()) for kind, r in self.kinds.items()}


def output_at(factor: Any, state: State) -> Any:
    """Output of a factor at `state`."""
    out = factor.output()
    pieces = make_pieces(len(state.seconds), None)
    in_parallel(lambda piece: factor.accumulate(state, piece, out, sums=False), pieces)
    return out


def chi2(out: Whitened, rows: slice) -> float:
    """chi^2 of the columns `rows`, with the current robust weights."""
    return float(((out.residual[:, rows] * out.root[:, rows]) ** 2).sum())


def keyed(factors: Iterable[Factor]) -> dict[FactorKey, Factor]:
    """Factors by sensor and kind of measurement, in order."""
    return {factor.key: factor for factor in factors}


def of_type(by_key: Mapping[FactorKey, Any], wanted: type[T]) -> tuple[T, ...]:
    """Factors (or outputs of factors) of the class `wanted`, in order."""
    return tuple(x for x in by_key.values() if isinstance(x, wanted))


def pairs_of(factors: Mapping[FactorKey, Factor], outputs: Residuals, wanted: type[T]) -> list[tuple[T, Any]]:
    """Factors of the class `wanted`, each with its output."""
    return [(f, outputs[key]) for key, f in factors.items() if isinstance(f, wanted)]
