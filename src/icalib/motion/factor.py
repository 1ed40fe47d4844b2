"""Interface of a factor, and what factors share: residual rows, the chain rule by keyframes, sums in the equations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.motion.imu_data import ImuData
from icalib.optim.arrowhead import Piece, in_parallel, make_pieces
from icalib.optim.rows import LOSSES, Loss, Rows, accumulate_rows
from icalib.optim.state import KEYFRAME_DIM, POSE_DIM, State

# Interface of a factor: all measurements of one kind by one sensor.

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

    is_sparse: one keyframe alone has too few rows to determine the calibration.
    """

    is_sparse: ClassVar[bool]

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

    def with_imu(self, imu: ImuData, state: State) -> Self:
        """See `Factor`; nothing is preintegrated."""
        factor: Any = self
        return replace(factor, imu=imu)

    def discarded_output(self) -> Any:
        factor: Any = self
        return factor.output()

    def reusable_output(self, out: Any) -> Any:
        return out

    def attach(self, piece: Piece, keep: bool) -> Piece:
        return piece

    def cut(self, state: State, keyframes: tuple[int, ...]) -> Self:
        return self

    def warm_started(self, out: Any) -> Self:
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
        return None

    def raw_sigma(self) -> np.ndarray:
        """(n, m) standard deviations of `raw`."""
        raise NotImplementedError

    def rows(self: _HasRows, out: Whitened, state: State) -> list[ResidualRows]:
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
        return {(self.name, k): Squares(self.count(out, k), chi2(out, r)) for k, r in self.kinds.items()}

    def sizes(self: _HasRows, out: Whitened) -> dict[FitKey, RawSize]:
        return {(self.name, kind): RawSize(*self.rms(out, kind)) for kind in self.kinds}

    def dof_used(self: _HasRows, out: Whitened, along: StateDifference) -> dict[FitKey, float]:
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


# Replacement of the IMU factor in a rig without IMU: keyframes at image instants, with no term between them.

# information [1/rad^2, 1/m^2]: keeps a keyframe without measurements positive definite; too weak for other effects
WEAK_POSE_INFORMATION = 1e-9


@dataclass(frozen=True)
class IndependentKeyframes(RowFactor):
    """Chain factor without measurements: a little information keeps each keyframe positive definite. Velocity and
    biases, on which no measurement depends, are fixed."""

    name: str  # of the sensor that is the body frame
    n_keyframes: int

    @property
    def key(self) -> FactorKey:
        return self.name, "keyframes"

    @property
    def kinds(self) -> dict[str, slice]:
        """Empty: the factor has no residuals."""
        return {}

    @property
    def starts(self) -> tuple[int, ...]:
        """(0,): one chain for all recordings, because no term links neighbours."""
        return (0,)

    @property
    def imu(self) -> None:
        """None: no readings link keyframes."""
        return None

    def with_imu(self, imu: ImuData, state: State) -> IndependentKeyframes:
        """The same factor, as there is no IMU."""
        return self

    def output(self) -> Whitened:
        """Empty rows (K - 1, 15)."""
        return Whitened.without_loss(self.n_keyframes - 1, KEYFRAME_DIM)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """Adds information that keeps the keyframes of `piece` positive definite. Returns 0, its cost."""
        if sums:
            information = np.concatenate([np.full(POSE_DIM, WEAK_POSE_INFORMATION), np.ones(KEYFRAME_DIM - POSE_DIM)])
            piece.diagonal[:, range(KEYFRAME_DIM), range(KEYFRAME_DIM)] += information
        return 0.0

    def accumulate_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Returns 0, as there are no biases."""
        return 0.0


# Adds measurement rows between neighbouring keyframes to the normal equations.

# Rows whose Jacobians are computed at once: these fit the processor's cache.
ROWS_PER_CHUNK = 256


class Into(NamedTuple):
    """Target of `add_rows`: the arguments of `Factor.accumulate`."""

    piece: Piece
    out: Whitened
    sums: bool
    curved: bool


class RobustNoise(NamedTuple):
    """Noise of n measurements of m rows. whitening (n, m, m): lower triangular; name and scale of the robust loss of
    each whitened row."""

    whitening: np.ndarray
    loss: str
    loss_scale: float


def in_chunks(rows: slice) -> Iterator[slice]:
    """Slices of at most ROWS_PER_CHUNK rows that make up `rows`."""
    for start in range(rows.start, rows.stop, ROWS_PER_CHUNK):
        yield slice(start, min(start + ROWS_PER_CHUNK, rows.stop))


def rows_by_recording(
    keyframe: np.ndarray, starts: tuple[int, ...], n_keyframes: int, piece: Piece
) -> Iterator[tuple[int, slice]]:
    """Rows in `piece`, at most ROWS_PER_CHUNK at a time, each slice with the number of its recording.

    keyframe (n,), sorted: of each measurement; starts: first keyframe of each recording. Rows belong to intervals, so
    those at the last keyframe, n_keyframes - 1, go to the last interval.
    """
    edges = np.searchsorted(keyframe, (*starts, n_keyframes))
    low, high = np.searchsorted(np.minimum(keyframe, n_keyframes - 2), [piece.first, piece.last])
    for k in range(len(starts)):
        for some in in_chunks(slice(max(int(edges[k]), int(low)), min(int(edges[k + 1]), int(high)))):
            yield k, some


def add_rows(
    rows: Rows, chunk: slice, keyframe: np.ndarray, columns: np.ndarray, noise: RobustNoise, into: Into
) -> float:
    """Adds the rows `chunk` of a factor, each to the interval that begins at its `keyframe` (n,), and fills `into.out`.
    Returns half the robust chi^2. columns (c,): calibration columns of rows.J, -1 where fixed."""
    loss = Loss(LOSSES[noise.loss], noise.loss_scale, into.curved)
    return accumulate_rows(
        rows, keyframe, noise.whitening, loss, columns, into.piece.sums(into.sums), into.out.residual[chunk],
        into.out.root[chunk],
    )  # fmt: skip


# Residuals of poses that a sensor reports, with Jacobians by the pose of the sensor (`sensor_pose`) and by the
# reference frame.
#
# Rotation: e = Log(measured^T predicted). Position: predicted - measured, in the axes of the measurement. Rotations
# are perturbed on the right, so de = J_r^-1(e) d for a factor on the right of the prediction.


@dataclass(frozen=True)
class Extrinsics:
    """R_imu_sensor (3, 3), p_imu_sensor (3,) m; or the pose of a sensor in the frame of another one."""

    R: np.ndarray
    p: np.ndarray


@dataclass(frozen=True)
class Frame:
    """Pose of a reference frame: R_world_frame (3, 3), p_world_frame (3,) m."""

    R: np.ndarray
    p: np.ndarray


@dataclass(frozen=True)
class PoseResiduals:
    """n poses of 6 rows, rotation and position, not whitened. residual (n, 6); J_pose: (n, 6, 6) by the sensor's pose,
    for relative poses one for each end; J_frame (n, 6, 6 or 0): by R_world_frame, p_world_frame. Jacobians have length
    0 if not wanted."""

    residual: np.ndarray
    J_pose: tuple[np.ndarray, ...]
    J_frame: np.ndarray

    @classmethod
    def alone(cls, residual: np.ndarray) -> PoseResiduals:
        """Residuals (n, 6) without Jacobians."""
        nothing = np.zeros((0, 6, 6))
        return cls(residual, (nothing, nothing), nothing)


def absolute_residuals(
    R: np.ndarray, p: np.ndarray, frame: Frame, rotation: np.ndarray, position: np.ndarray, jacobians: bool = True
) -> PoseResiduals:
    """Residuals of measured poses R_frame_sensor `rotation` (n, 3, 3), p_frame_sensor `position` (n, 3). R (n, 3, 3), p
    (n, 3): predicted poses of the sensor in the world.

        Log(rotation^T R_world_frame^T R),  R_world_frame^T (p - p_world_frame) - position
    """
    n, predicted = len(R), frame.R.T @ R
    e = so3.log_many(np.ascontiguousarray(_t(rotation) @ predicted))
    x = (p - frame.p) @ frame.R
    residual = np.concatenate([e, x - position], axis=1)
    if not jacobians:
        return PoseResiduals.alone(residual)
    J = right_jacobians_inverse(e)
    J_pose, J_frame = np.zeros((n, 6, 6)), np.zeros((n, 6, 6))
    J_pose[:, :3, :3] = J
    J_pose[:, 3:, 3:] = predicted
    J_frame[:, :3, :3] = -J @ _t(predicted)
    J_frame[:, 3:, :3] = so3.hat_many(x)
    J_frame[:, 3:, 3:] = -frame.R.T
    return PoseResiduals(residual, (J_pose,), J_frame)


def relative_residuals(
    R: tuple[np.ndarray, np.ndarray],
    p: tuple[np.ndarray, np.ndarray],
    rotation: np.ndarray,
    position: np.ndarray,
    jacobians: bool = True,
) -> PoseResiduals:
    """Residuals of measured poses `rotation` (n, 3, 3), `position` (n, 3) of the sensor at the later instant relative
    to the earlier. R[0], p[0] and R[1], p[1]: predicted poses at both.

        Log(rotation^T Q), Q = R_0^T R_1,  R_0^T (p_1 - p_0) - position
    """
    n, Q = len(R[0]), _t(R[0]) @ R[1]
    e = so3.log_many(np.ascontiguousarray(_t(rotation) @ Q))
    x = np.einsum("nji,nj->ni", R[0], p[1] - p[0])
    residual = np.concatenate([e, x - position], axis=1)
    if not jacobians:
        return PoseResiduals.alone(residual)
    J = right_jacobians_inverse(e)
    before, after = np.zeros((n, 6, 6)), np.zeros((n, 6, 6))
    before[:, :3, :3] = -J @ _t(Q)
    before[:, 3:, :3] = so3.hat_many(x)
    before[:, 3:, 3:] = -np.eye(3)
    after[:, :3, :3] = J
    after[:, 3:, 3:] = Q
    return PoseResiduals(residual, (before, after), np.zeros((n, 6, 0)))


@njit(cache=True, nogil=True)
def right_jacobians_inverse(e: np.ndarray) -> np.ndarray:
    """Inverse right Jacobians (n, 3, 3) at rotation vectors e (n, 3) rad."""
    out = np.empty((len(e), 3, 3))
    for i in range(len(e)):
        out[i] = so3.right_jacobian_inverse(e[i])
    return out


def _t(R: np.ndarray) -> np.ndarray:
    """Transposed matrices (..., 3, 3)."""
    return np.swapaxes(R, -1, -2)
