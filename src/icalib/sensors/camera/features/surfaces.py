"""Points of the scene that lie on planes of the LiDARs: what ties cameras to LiDARs where the motion does not.

A point P of a track and the plane (n, q) that it lies on give one row

    n . (P - q)                          over points_on_planes_m [m]

What a surface has of relief is the same however often it is looked at, and much the same nearby: all points of one
patch of a plane together have the weight of one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.planes import tangents
from icalib.geometry.small import solve_definite
from icalib.optim.arrowhead import Piece
from icalib.optim.front_plan import FeatureSums
from icalib.optim.planes import Planes
from icalib.optim.robust_weights import Loss, weight
from icalib.optim.state import Key
from icalib.sensors.camera.features.kernels import Points

ON_PLANES = "points on planes"  # the kind of these rows
CELL_M = 0.25  # a plane ends where no LiDAR saw it, to a cell
PATCH_M = 1.0  # within which a surface is off its plane by much the same
GATE = 3.0  # standard deviations that a point may be off
REACH_M = 0.5  # from a plane to points that may lie on it: cameras and LiDARs may be that far apart before
VAGUE_M = 0.1  # a point that is less certain across a plane lies on none
FEWEST, LEAST_SHARE = 20, 0.4  # of the points that may lie on a plane: as many must agree on how far off they are
FIRST_NOISE_M = 0.05  # at least, while all is only about where it is
MOST_CELLS = 1 << 20  # from the point of a plane to its end


class OnPlanes(NamedTuple):
    """Of each track: plane (T,) its index, -1: on none; sigma (T,) m; weight (T,) which part it is of all on its
    patch."""

    plane: np.ndarray
    sigma: np.ndarray
    weight: np.ndarray

    @classmethod
    def none(cls, n: int) -> OnPlanes:
        return cls(np.full(n, -1), np.ones(n), np.ones(n))

    def of(self, tracks: slice) -> OnPlanes:
        return OnPlanes(*(a[tracks] for a in self))


NOWHERE = OnPlanes.none(0)


class Distances(NamedTuple):
    """Of each track from its plane: residual (T,) m; root (T,), square root of its weight over sigma, 0 where it is on
    none; share (T,) of the point's three degrees of freedom that this row pays for."""

    residual: np.ndarray
    root: np.ndarray
    share: np.ndarray

    @classmethod
    def zeros(cls, n: int) -> Distances:
        return cls(np.zeros(n), np.zeros(n), np.zeros(n))

    def of(self, tracks: slice) -> Distances:
        return Distances(*(a[tracks] for a in self))


@dataclass(frozen=True)
class Surfaces:
    """The planes as LiDARs see them, everything frozen that a pass freezes. keys (P,): where their values stand in a
    state; plane (P, 6) where they were, recording (P,) that each belongs to; cells: where LiDARs saw them, see
    `_codes`; noise [m], how far points are off them."""

    keys: tuple[Key, ...]
    plane: np.ndarray
    recording: np.ndarray
    cells: np.ndarray
    noise: float

    @classmethod
    def seen(
        cls,
        keys: tuple[Key, ...],
        recording: np.ndarray,
        plane: np.ndarray,
        clouds: Iterable[tuple[np.ndarray, np.ndarray]],
        noise: float,
        coarse: bool,
    ) -> Surfaces:
        """`plane` (P, 6): where the planes are; `clouds`: of each LiDAR points (n, 3) in the world, and on which plane
        (n,) each lies; `coarse`: all is only about where it is."""
        codes = [np.zeros(0, dtype=np.int64)]
        for xyz, of_points in clouds:
            codes.append(_with_neighbours(np.unique(_codes(plane, of_points.astype(np.int64), xyz))))
        cells = np.unique(np.concatenate(codes))
        return cls(keys, plane, recording, cells, max(noise, FIRST_NOISE_M) if coarse else noise)

    def under(self, points: np.ndarray, information: np.ndarray, recording: np.ndarray) -> OnPlanes:
        """The plane that each of the points (n, 3), in the world of its `recording` (n,), lies on, none where it may
        lie on several; information (n, 3, 3) of the points [1/m^2].

        What a motion leaves open keeps cameras and LiDARs apart by any distance. So points are those of a plane not
        where they are close to it, but where they are as far off it as most that could be on it.
        """
        normal = self.plane[:, :3]
        off = points @ normal.T - np.einsum("pa,pa->p", normal, self.plane[:, 3:])
        across = np.einsum("pa,nab,pb->np", normal, np.linalg.pinv(information, hermitian=True), normal)
        may = (np.abs(off) < REACH_M) & (across < VAGUE_M**2) & (recording[:, None] == self.recording)
        i, k = np.nonzero(may)
        may[i, k] = np.isin(_codes(self.plane, k, points[i]), self.cells)
        lies = np.zeros_like(may)
        for k in np.flatnonzero(may.sum(axis=0) >= FEWEST):
            own = np.flatnonzero(may[:, k])
            lies[own, k] = most_alike(off[own, k], np.sqrt(across[own, k] + self.noise**2))
        plane = np.where(lies.sum(axis=1) == 1, lies.argmax(axis=1), -1)
        on, part = np.flatnonzero(plane >= 0), np.ones(len(points))
        patches = _codes(self.plane, plane[on], points[on], PATCH_M)
        _, patch, count = np.unique(patches, return_inverse=True, return_counts=True)
        part[on] = 1.0 / count[patch]
        return OnPlanes(plane, self.noise / np.sqrt(part), part)


def most_alike(off: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(n,) bool: those of `off` (n,), each known to `sigma` (n,), that agree on one value; none where these are few, or
    a small share of all."""
    ends = np.concatenate([off - GATE * sigma, off + GATE * sigma])
    order = np.argsort(ends, kind="stable")
    count = np.cumsum(np.where(order < len(off), 1, -1))
    best = ends[order[np.argmax(count)]]
    alike = np.abs(off - best) <= GATE * sigma
    centre = np.average(off[alike], weights=sigma[alike] ** -2)
    alike = np.abs(off - centre) <= GATE * sigma
    return alike & (alike.sum() >= max(FEWEST, LEAST_SHARE * len(off)))


def _codes(plane: np.ndarray, which: np.ndarray, xyz: np.ndarray, size: float = CELL_M) -> np.ndarray:
    """(n,) the cell, so large [m], of each point (n, 3) on its plane `which` (n,), one number for all three indices."""
    across = np.array([tangents(np.ascontiguousarray(v[:3])) for v in plane])
    cell = np.einsum("nta,na->nt", across[which], xyz - plane[which, 3:]) / size
    i, j = np.clip(np.floor(cell), 1 - MOST_CELLS, MOST_CELLS - 2).astype(np.int64).T + MOST_CELLS
    return (which * (2 * MOST_CELLS) + i) * (2 * MOST_CELLS) + j


def _with_neighbours(codes: np.ndarray) -> np.ndarray:
    """Cells and those around them: lines of a few lasers are far apart."""
    steps = [a * 2 * MOST_CELLS + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
    return np.unique(np.concatenate([codes + s for s in steps]))


@njit(cache=True, nogil=True)
def add_planes_to_points(on, planes, loss, points):
    """Adds what the plane says of each point that still moves, with the true curvature of the loss."""
    for t in range(len(on.plane)):
        q = on.plane[t]
        if q < 0 or not points.moves[t]:
            continue
        n, e = planes.normal[q], _distance(planes, q, points.trial[t])
        w, cost, curvature = weight(loss.kind, loss.scale, (e / on.sigma[t]) ** 2)
        w /= on.sigma[t] ** 2
        points.trial_cost[t] += cost
        for a in range(3):
            points.trial_b[t, a] += w * e * n[a]
            for k in range(3):
                points.trial_A[t, a, k] += w * curvature * n[a] * n[k]


@njit(cache=True, nogil=True)
def _distance(planes, q, point):
    e = 0.0
    for a in range(3):
        e += planes.normal[q, a] * (point[a] - planes.point[q, a])
    return e


@njit(cache=True, nogil=True)
def _accumulate(on, planes, loss, xyz, A, features, calib, out):
    """Fills `out`, and adds the rows to the sums of the features and of the calibration parameters, where there are
    any. Returns half the robust chi^2."""
    total, j, M, d = 0.0, np.empty(3), np.empty((3, 3)), np.empty(3)
    n_b = calib.shape[0] - 1
    for t in range(len(on.plane)):
        q = on.plane[t]
        out.residual[t] = out.root[t] = out.share[t] = 0.0
        if q < 0:
            continue
        n, e = planes.normal[q], _distance(planes, q, xyz[t])
        w, cost, curvature = weight(loss.kind, loss.scale, (e / on.sigma[t]) ** 2)
        w /= on.sigma[t] ** 2
        total += cost
        out.residual[t], out.root[t] = e, np.sqrt(w)
        M[:], d[:] = A[t], n
        out.share[t] = w * (d @ n) if solve_definite(M, d) else 0.0
        if n_b < 0:
            continue
        j[0] = j[1] = 0.0
        for a in range(3):
            j[0] += planes.tangents[q, 0, a] * (xyz[t, a] - planes.point[q, a])
            j[1] += planes.tangents[q, 1, a] * (xyz[t, a] - planes.point[q, a])
        j[2] = -1.0
        along = w * curvature if loss.curved else w
        for a in range(3):
            features.side[t, a, n_b] += w * e * n[a]
            for k in range(3):
                features.own[t, a, k] += along * n[a] * n[k]
        for r in range(3):
            c = planes.columns[q, r]
            if c < 0:
                continue
            for a in range(3):
                features.side[t, a, c] += along * n[a] * j[r]
            for s in range(3):
                if planes.columns[q, s] >= 0:
                    calib[c, planes.columns[q, s]] += along * j[r] * j[s]
            calib[c, n_b] += w * e * j[r]
            calib[n_b, c] += w * e * j[r]
    return total


def add_points_on_planes(
    on: OnPlanes, planes: Planes, loss: Loss, points: Points, features: FeatureSums, piece: Piece, out: Distances
) -> float:
    """The rows of tracks where their points rest: into `out`, and where these are wanted into the sums of `features`
    and of the calibration parameters of `piece`. Returns half the robust chi^2."""
    calib = piece.calib if len(features.own) else np.zeros((0, 0))
    return _accumulate(on, planes, loss, points.xyz, points.A, features, calib, out)
