"""Compiled gradients of clusters of track observations: by points, camera poses and lens parameters."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.motion.sensor_pose import chain_width, fill_chain
from icalib.optim.rows import add_gradients
from icalib.sensors.camera.features.kernels import weighted_rows


@njit(cache=True, nogil=True)
def accumulate_clusters(X, observed, base, poses, columns, projection, loss, cluster, n_clusters, column, sums, side):
    """Adds the gradient of each cluster of one camera's observations to the columns from `column` on.

    Gradients by poses and calibration are added to `sums`, gradients by points to side (T, 3, columns). X (n, 3) m:
    points in the camera frame; cluster (N,): index of the cluster of each observation, from 0 to n_clusters - 1."""
    n_d = len(projection.pars)
    J_rows, G, error, D = np.zeros((10 + n_d, 2)), np.empty((6 + n_d, n_clusters)), np.empty(2), 9 + n_d
    J_imu, J_chain = np.empty((6, 6)), np.empty((6, chain_width(poses) + columns.shape[1] - n_d))
    for i in range(len(observed.start) - 1):
        G[:] = 0.0
        for n in range(observed.start[i], observed.start[i + 1]):
            if observed.track[n] < 0:
                continue
            root, _ = weighted_rows(i, n, X, observed, projection, loss, poses.R_sensor_world, error, J_rows)
            if root == 0.0:
                continue
            for d in range(6 + n_d):
                G[d, cluster[n]] += J_rows[d, 0] * J_rows[D, 0] + J_rows[d, 1] * J_rows[D, 1]
            for a in range(3):
                by_point = J_rows[D - 3 + a, 0] * J_rows[D, 0] + J_rows[D - 3 + a, 1] * J_rows[D, 1]
                side[observed.track[n] - base.track, a, column + cluster[n]] += by_point
        fill_chain(i, poses, J_imu, J_chain)
        add_gradients(observed.keyframe[i], chain_width(poses), G, J_chain, columns[i], column, sums)
