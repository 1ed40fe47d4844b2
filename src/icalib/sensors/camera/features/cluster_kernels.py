"""Compiled gradients of clusters of the feature factor's observations, through points, poses and lenses."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.motion.sensor_pose import chain_width, fill_chain
from icalib.optim.rows import add_gradients
from icalib.sensors.camera.features.kernels import weighted_rows


@njit(cache=True, nogil=True)
def accumulate_clusters(X, seen, base, at, columns, seeing, loss, cluster, n_clusters, column, sums, side):
    """Of one camera's observations, whose points are at X (n, 3) in it: the gradient of each cluster, cluster (N,) of
    them, into columns `column` and on of the piece's sums and of side (T, 3, columns) of its features."""
    n_d = len(seeing.pars)
    A, G, error, D = np.zeros((10 + n_d, 2)), np.empty((6 + n_d, n_clusters)), np.empty(2), 9 + n_d
    A_imu, T = np.empty((6, 6)), np.empty((6, chain_width(at) + columns.shape[1] - n_d))
    for i in range(len(seen.start) - 1):
        G[:] = 0.0
        for n in range(seen.start[i], seen.start[i + 1]):
            if seen.track[n] < 0:
                continue
            root, _ = weighted_rows(i, n, X, seen, seeing, loss, at.R_sensor_world, error, A)
            if root == 0.0:
                continue
            for d in range(6 + n_d):
                G[d, cluster[n]] += A[d, 0] * A[D, 0] + A[d, 1] * A[D, 1]
            for a in range(3):
                by_point = A[D - 3 + a, 0] * A[D, 0] + A[D - 3 + a, 1] * A[D, 1]
                side[seen.track[n] - base.track, a, column + cluster[n]] += by_point
        fill_chain(i, at, A_imu, T)
        add_gradients(seen.keyframe[i], chain_width(at), G, T, columns[i], column, sums)
