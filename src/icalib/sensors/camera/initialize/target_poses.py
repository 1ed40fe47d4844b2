"""Poses of cameras relative to a flat target, from the corners of each image, without an initial guess: homography,
then Gauss-Newton."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import CornerStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.small import solve_definite
from icalib.initialize.rate_correlation import SensorRates, max_rate_step
from icalib.initialize.smooth_trajectory import pairs_within

MAX_POSE_CORNERS = 48  # corners of an image that are used, at most; bounds the time
MIN_POSE_CORNERS = 6  # corners of a board that give a pose; fewer may be nearly collinear
MIN_RAY_COSINE = 0.15  # cosine of a ray to the optical axis: homographies need rays away from the image plane
MAX_POSE_RMS_PX = 3.0  # px: poses with a larger RMS error are rejected
POSE_HUBER_PX = 2.0  # px: width of Huber's loss
POSE_ITERATIONS = 5  # of Gauss-Newton
MIN_IMAGE_PAIRS = 20  # pairs of consecutive images that angular rates need
POSES_PER_BLOCK = 512  # poses computed at once: bounds the memory of rays and Jacobians


@dataclass(frozen=True)
class TargetPoses:
    """Camera poses in the board frame: R_board_cam (M, 3, 3), p_board_cam (M, 3) m; ok (M,) bool; rms_px (M,): RMS
    reprojection error; per_px (M,) m: RMS standard deviation of the position over its axes, if that of corners is a
    pixel."""

    rotation: np.ndarray
    position: np.ndarray
    ok: np.ndarray
    rms_px: np.ndarray
    per_px: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _homography(points, observed, centre, h):
    """Fills h (9,) = H with observed ~ H (point - centre, 1) and h33 = 1, by linear least squares (DLT). points (n, 3),
    observed (n, 3). Returns False if singular."""
    A, b, row = np.zeros((8, 8)), np.zeros(8), np.empty(8)
    for n in range(len(points)):
        x, y = points[n, 0] - centre[0], points[n, 1] - centre[1]
        for axis in range(2):
            m = observed[n, axis]
            o = 3 * axis
            for i in range(6):
                row[i] = 0.0
            row[o], row[o + 1], row[o + 2] = x, y, 1.0
            row[6], row[7] = -m * x, -m * y
            for i in range(8):
                b[i] += row[i] * m
                for j in range(i + 1):  # `solve_definite` takes the lower triangle
                    A[i, j] += row[i] * row[j]
    if not solve_definite(A, b):
        return False
    for i in range(8):
        h[i] = b[i]
    h[8] = 1.0
    return True


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _pose_from_homography(h, R, t):
    """Fills R_cam_board and t, the position in the camera of the homography's centre, from its columns scaled to equal
    length (Zhang 2000)."""
    n1 = np.sqrt(h[0] ** 2 + h[3] ** 2 + h[6] ** 2)
    n2 = np.sqrt(h[1] ** 2 + h[4] ** 2 + h[7] ** 2)
    s = 2.0 / (n1 + n2)
    a, b = np.empty(3), np.empty(3)
    for i in range(3):
        a[i], b[i], t[i] = h[3 * i] / n1, h[3 * i + 1] / n2, h[3 * i + 2] * s
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    for i in range(3):
        u, v = a[i] - 0.5 * dot * b[i], b[i] - 0.5 * dot * a[i]
        a[i], b[i] = u, v
    _normalise(a)
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    for i in range(3):
        b[i] -= dot * a[i]
    _normalise(b)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        R[i, 0], R[i, 1] = a[i], b[i]
        R[i, 2] = a[j] * b[k] - a[k] * b[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _normalise(v):
    """Scales v (3,) to unit length."""
    n = np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    for i in range(3):
        v[i] /= n


@njit(cache=True, nogil=True, error_model="numpy")
def _apply_step(turn, g, R, t):
    """R <- turn R, t <- turn t - g[3:]."""
    old, shift = R.copy(), t.copy()
    for i in range(3):
        t[i] = turn[i, 0] * shift[0] + turn[i, 1] * shift[1] + turn[i, 2] * shift[2] - g[3 + i]
        for j in range(3):
            R[i, j] = turn[i, 0] * old[0, j] + turn[i, 1] * old[1, j] + turn[i, 2] * old[2, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_corner(X, iz, density, r0, r1, w, J, H, g):
    """Adds the residuals r0, r1 [px] of a corner, with weight w, to the normal equations H (6, 6), lower triangle, and
    g (6,) of a left increment of the pose. X (3,): the corner in the camera, iz = 1 / X[2]. J (2, 6) is filled."""
    for k in range(2):
        a = density * iz if k == 0 else 0.0
        b = density * iz if k == 1 else 0.0
        c = -density * X[k] * iz * iz
        J[k, 0] = -b * X[2] + c * X[1]
        J[k, 1] = a * X[2] - c * X[0]
        J[k, 2] = -a * X[1] + b * X[0]
        J[k, 3], J[k, 4], J[k, 5] = a, b, c
    for i in range(6):
        g[i] += w * (J[0, i] * r0 + J[1, i] * r1)
        for j in range(i + 1):  # `solve_definite` takes the lower triangle
            H[i, j] += w * (J[0, i] * J[0, j] + J[1, i] * J[1, j])


@njit(cache=True, nogil=True, error_model="numpy")
def refine_pose(points, observed, R, t, rounds):
    """Gauss-Newton on R_cam_board and t with Huber weights. points (n, 3) m: corners on the board; observed (n, 3): x /
    z, y / z, and pixels per unit of these.

    Returns the RMS error [px] before the last step, with errors capped at 4 POSE_HUBER_PX; points behind the camera
    count as this much. Returns 1e9 if singular, or if fewer than 4 points are in front of the camera. Also returns
    `per_px` of `TargetPoses`.
    """
    rms, X, J, H, g = 1e9, np.empty(3), np.empty((2, 6)), np.empty((6, 6)), np.empty(6)
    for _ in range(rounds):
        H[:], g[:] = 0.0, 0.0
        total, behind = 0.0, 0
        for n in range(len(points)):
            for i in range(3):
                X[i] = R[i, 0] * points[n, 0] + R[i, 1] * points[n, 1] + R[i, 2] * points[n, 2] + t[i]
            if X[2] < 1e-6:
                behind += 1
                total += 16.0 * POSE_HUBER_PX * POSE_HUBER_PX
                continue
            iz, density = 1.0 / X[2], observed[n, 2]
            r0, r1 = density * (X[0] * iz - observed[n, 0]), density * (X[1] * iz - observed[n, 1])
            e = np.sqrt(r0 * r0 + r1 * r1)
            total += min(e, 4.0 * POSE_HUBER_PX) ** 2
            _add_corner(X, iz, density, r0, r1, 1.0 if e <= POSE_HUBER_PX else POSE_HUBER_PX / e, J, H, g)
        rms = np.sqrt(total / (2 * len(points)))
        if len(points) - behind < 4:
            return 1e9, 0.0
        if not solve_definite(H, g):
            return 1e9, 0.0
        _apply_step(so3.exp(-g[:3]), g, R, t)
    # The inverse of the Cholesky factor's last block L has the squares sum to the trace of the position's covariance.
    a, b, c = 1.0 / H[3, 3], 1.0 / H[4, 4], 1.0 / H[5, 5]
    d, e = -H[4, 3] * a * b, -H[5, 4] * b * c
    f = -(H[5, 3] * a + H[5, 4] * d) * c
    return rms, np.sqrt((a * a + b * b + c * c + d * d + e * e + f * f) / 3.0)


@njit(cache=True, nogil=True, error_model="numpy")
def select_corners(a, b, point, rays, density, good, target, points, observed):
    """Fills points (n, 3) and observed (n, 3), as `refine_pose` needs them, with good corners among a..b, evenly
    spread if there are more than n. Returns their number."""
    most, total = len(points), 0
    for n in range(a, b):
        total += good[n]
    count, passed, wanted = 0, 0, min(most, total)
    for n in range(a, b):
        if good[n]:
            if passed * wanted // max(total, 1) >= count and count < wanted:
                for k in range(3):
                    points[count, k] = target[point[n], k]
                observed[count, 0], observed[count, 1] = rays[n, 0] / rays[n, 2], rays[n, 1] / rays[n, 2]
                observed[count, 2] = density[n]
                count += 1
            passed += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def camera_in_target(R, t, rotation, position):
    """Inverts R_cam_target, p_cam_target to R_target_cam, p_target_cam."""
    for a in range(3):
        position[a] = -(R[0, a] * t[0] + R[1, a] * t[1] + R[2, a] * t[2])
        for b in range(3):
            rotation[a, b] = R[b, a]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _mirrored_pose(centre, R, t):
    """The second pose from which a flat target looks nearly alike: depths mirrored about the target's centre
    (Schweighofer and Pinz 2006)."""
    c, d = np.empty(3), np.empty(3)
    for i in range(3):
        c[i] = t[i] + R[i, 0] * centre[0] + R[i, 1] * centre[1]
        d[i] = c[i]
    _normalise(d)
    for j in range(2):
        along = 2.0 * (d[0] * R[0, j] + d[1] * R[1, j] + d[2] * R[2, j])
        for i in range(3):
            R[i, j] -= along * d[i]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        R[i, 2] = R[j, 0] * R[k, 1] - R[k, 0] * R[j, 1]
        t[i] = c[i] - R[i, 0] * centre[0] - R[i, 1] * centre[1]


@njit(cache=True, nogil=True, error_model="numpy")
def _poses_of_images(start, point, rays, density, good, target, fewest, rounds, rotation, position, rms, per_px):
    """Fills poses (n, 1 or 2, ...), RMS errors [px], and `per_px` of `TargetPoses`. If there are two, the mirrored
    solution is second."""
    R, t, h, centre = np.empty((3, 3)), np.empty(3), np.empty(9), np.empty(2)
    points, observed = np.empty((MAX_POSE_CORNERS, 3)), np.empty((MAX_POSE_CORNERS, 3))
    for i in range(len(start) - 1):
        rms[i] = 1e9
        count = select_corners(start[i], start[i + 1], point, rays, density, good, target, points, observed)
        if count < fewest[i]:
            continue
        for k in range(2):
            centre[k] = 0.0
            for n in range(count):
                centre[k] += points[n, k] / count
        if not _homography(points[:count], observed[:count], centre, h):
            continue
        _pose_from_homography(h, R, t)
        for k in range(3):
            t[k] -= R[k, 0] * centre[0] + R[k, 1] * centre[1]
        for turn in range(rms.shape[1]):
            if turn == 1:
                _mirrored_pose(centre, R, t)
            rms[i, turn], per_px[i, turn] = refine_pose(points[:count], observed[:count], R, t, rounds)
            if not rms[i, turn] < 1e9:  # corners on a line, or in one point
                rms[i, turn] = 1e9
                break
            camera_in_target(R, t, rotation[i, turn], position[i, turn])


@dataclass(frozen=True)
class FlatPoints:
    """Points (n, 3) m of flat bodies, each in its body's frame, and the fewest corners that give a pose."""

    points: np.ndarray
    fewest: int = MIN_POSE_CORNERS


def target_poses(stream: CornerStream, model: CameraModel, params: np.ndarray, target: FlatPoints) -> TargetPoses:
    """Poses of the camera in the frame of the one body that each image shows, from up to MAX_POSE_CORNERS
    corners each."""
    fewest = np.full(len(stream.stamps_ns), target.fewest)
    poses = flat_poses(stream, stream.start, fewest, model, params, target.points, 1)
    return TargetPoses(*(x[:, 0] for x in (poses.rotation, poses.position, poses.ok, poses.rms_px, poses.per_px)))


def camera_rates(stream: CornerStream, poses: TargetPoses) -> SensorRates:
    """Angular rates from consecutive good poses of a camera. Raises EstimationError if fewer than MIN_IMAGE_PAIRS pairs
    are close enough in time."""
    t = stream.seconds
    index = np.flatnonzero(poses.ok)
    if len(index) < 2:
        raise EstimationError(
            f"{stream.name}: the pose of the target was found in only {len(index)} of {len(t)} images; check "
            "the target, the camera model and the intrinsics in the rig file."
        )
    longest = max_rate_step(stream.name, t[index], "images of the target")
    a, b = pairs_within(t, index[:-1], index[1:], longest)
    if len(a) < MIN_IMAGE_PAIRS:
        raise EstimationError(
            f"{stream.name}: only {len(a)} pairs of consecutive images, at most {longest:.3g} s apart, show "
            f"the target, and {MIN_IMAGE_PAIRS} are needed; record for at least ten seconds."
        )
    turn = so3.log_many(np.ascontiguousarray(poses.rotation[a].transpose(0, 2, 1) @ poses.rotation[b]))
    return SensorRates(t[a], t[b], turn / (t[b] - t[a])[:, None], longest_step_s=longest)


def check_front_side(camera: str, poses: TargetPoses) -> None:
    """Raises EstimationError if most `poses` of the camera are behind the sheet of a flat body: a mirrored image looks
    like the sheet seen through its back."""
    behind = poses.position[poses.ok, 2] < 0.0
    if 2 * behind.sum() > len(behind):
        raise EstimationError(
            f"{camera} would see the target from behind, so its images or corners are mirrored; record them as "
            "the camera takes them, u to the right and v down, and check that the target was not printed "
            "mirrored."
        )


def flat_poses(
    stream: CornerStream,
    start: np.ndarray,
    fewest: np.ndarray,
    model: CameraModel,
    params: np.ndarray,
    target: np.ndarray,
    sides: int,
) -> TargetPoses:
    """Poses (n, sides, ...) of the camera in the frames of flat bodies. The corners start[i]:start[i + 1] belong to one
    body, and give a pose if there are at least `fewest` (n,). With sides = 2 the mirrored solution comes second: a
    small body far away looks alike from both poses."""
    n = len(start) - 1
    rotation, position = np.tile(np.eye(3), (n, sides, 1, 1)), np.zeros((n, sides, 3))
    rms, per_px = np.empty((n, sides)), np.zeros((n, sides))
    for a in range(0, n, POSES_PER_BLOCK):
        i = slice(a, min(a + POSES_PER_BLOCK, n))
        rows = slice(int(start[i.start]), int(start[i.stop]))
        rays, density, good = usable_rays(stream.uv[rows], model, params)
        _poses_of_images(
            start[i.start : i.stop + 1] - rows.start,
            stream.point[rows],
            rays,
            density,
            good,
            target,
            fewest[i],
            POSE_ITERATIONS,
            rotation[i],
            position[i],
            rms[i],
            per_px[i],
        )
    return TargetPoses(rotation, position, rms < MAX_POSE_RMS_PX, rms, per_px)


def usable_rays(uv: np.ndarray, model: CameraModel, params: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit rays (N, 3) of corners at uv (N, 2) px; pixels per unit of x / z and y / z at each (N,), the geometric mean
    over directions; and a mask (N,) of rays that are far enough from the image plane."""
    rays, valid = model.unproject(params, uv)
    good = valid & (rays[:, 2] > MIN_RAY_COSINE)
    J = model.project_with_jacobians(params, rays)[2]
    # Derivatives by x / z are z times those by x.
    density = np.abs(rays[:, 2]) * np.sqrt(np.abs(J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]))
    return rays, density, good & (density > 0.0)
