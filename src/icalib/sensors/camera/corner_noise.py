"""Noise of corners, estimated from the residuals of a pass.

    sigma_n^2 = (base s_n)^2 + (exposure v_i)^2 + misfit^2      corner n of image i; v_i [px/s]: image speed (blur)
    shift     ~ N(0, tau^2), independent in u and v             that all corners of an image share
    delay     ~ N(0, jitter^2)                                  of a stamp; moves all corners along their image velocity

s_n is the detector's standard deviation of the corner over that of the median corner, 1 if the detector states none.
base and exposure come from medians, which are robust to outliers. tau and jitter come from the chi^2 of the shared
errors over post-fit degrees of freedom, pass by pass (variance components; Foerstner 1979), because poses absorb most
of the error. Jitter is modelled only if the stamps are, or were, uneven (`CornerStream.jitter_s`).

The misfit is the error of the lens model. Near the border of the image it is many times its RMS, and a robust loss
down-weights corners there. With other sensors this is wanted, because the border would bias their parameters. With
cameras alone the lens should fit the whole image, so a large misfit widens the robust loss by `WIDE_LOSS_FACTOR`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from icalib.data.measurements import CornerStream
from icalib.errors import EstimationError
from icalib.model.sensor_model import Fit
from icalib.optim.rows import grouped_quantiles, largest_normal, median_variance
from icalib.optim.state import State
from icalib.rig import Camera, Settings
from icalib.sensors.camera.corner_factor import CornerFactor, CornerNoise, CornerOutput

INITIAL_CORNER_NOISE_PX = 0.5  # per axis, in the first pass: typical residual with a rough lens
MIN_COMMON_ERROR_PX, MAX_COMMON_ERROR_PX = 1e-3, 5.0  # limits of tau: for finite weights, and against divergence
INITIAL_COMMON_ERROR_PX = 0.1  # tau in the first pass that models the common error
MAX_INITIAL_JITTER_S = 3e-3  # in the first pass that models jitter; larger scatter is a rate that changes
WIDE_JITTER = 3.0  # jitter of that pass over `CornerStream.jitter_s`: delays are then hardly pulled towards zero
SIGNIFICANT_JITTER_STD = 5.0  # standard deviations of chi^2 of the delays without jitter; below, there is none
MIN_CORNER_NOISE_PX = 0.005  # per axis: no detector is better; keeps weights finite where corners are exact
SPEED_BINS = 12  # bins of image speed, to which the motion blur is fitted
MIN_CORNERS_IN_BIN = 50  # with these the median variance has a relative error of a fifth
LARGE_MISFIT_RATIO = 0.5  # misfit over base noise, above which the misfit is large: a fifth of the total variance
# Factor on `loss_scale` if the misfit is large. In a test with stereo stills and 8 px of misfit near the border, it
# lowers the error of validation images from 0.29 px to 0.27 px. Without robust loss the error is 0.25 px, but the
# baseline changes by 0.15 mm more.
WIDE_LOSS_FACTOR = 2.5


@dataclass(frozen=True)
class NoiseModel:
    """Noise of the corners of one camera.

    base [px]: standard deviation of the median corner per axis; exposure [s]: blur per image speed; tau [px] and jitter
    [s]: standard deviations of an image's shift and delay, 0 if not modelled; jitter_std [s]: that of `jitter`; rate:
    correction of a clock whose stamps jitter, relative; misfit [px]: RMS error of the lens model. wide_loss: the
    threshold of the robust loss is `WIDE_LOSS_FACTOR` times the `loss_scale` of the rig file."""

    base: float
    exposure: float = 0.0
    tau: float = 0.0
    misfit: float = 0.0
    wide_loss: bool = False
    jitter: float = 0.0
    jitter_std: float = 0.0
    rate: float = 0.0

    def noise(
        self, stream: CornerStream, settings: Settings, speed: np.ndarray | None = None, flow: np.ndarray | None = None
    ) -> CornerNoise:
        """The noise of each corner of `stream`. speed (M,) px/s: image speed of each image; no motion blur if None.
        flow (N, 2) px/s: image velocity of each corner; no jitter if None."""
        blur = 0.0 if speed is None else self.exposure * speed[stream.image]
        sigma = np.hypot(np.hypot(self.base * stream.relative_sigma, blur), self.misfit)
        field, tau = np.zeros((len(stream.uv), 2, 0)), []
        if self.tau > 0.0:
            field, tau = np.tile(np.eye(2), (len(stream.uv), 1, 1)), [self.tau] * 2
        if self.jitter > 0.0 and flow is not None:
            field, tau = np.concatenate([field, flow[:, :, None]], axis=2), [*tau, self.jitter]
        scale = settings.loss_scale * (WIDE_LOSS_FACTOR if self.wide_loss else 1.0)
        return CornerNoise(sigma, np.array(tau), np.ascontiguousarray(field), settings.loss, scale)


def first_noise(camera: Camera) -> NoiseModel:
    """Corner noise of the first pass: the value of the rig file, or else `INITIAL_CORNER_NOISE_PX`."""
    return NoiseModel(camera.corner_noise_px or INITIAL_CORNER_NOISE_PX)


def image_speed(factor: CornerFactor, flow: np.ndarray) -> np.ndarray:
    """(M,) px/s: image speed of the target in each image, RMS over the corners in use; 0 without such corners.
    flow (N, 2) px/s: result of `image_flow`."""
    square = np.einsum("ni,ni->n", flow, flow)
    return np.sqrt(image_mean(factor.stream, square, factor.keep))


def image_flow(factor: CornerFactor, state: State) -> np.ndarray:
    """(N, 2) px/s: image velocity of each corner."""
    flow = np.empty_like(factor.stream.uv)
    for v0, v1 in factor.blocks():
        flow[factor.corners_of(v0, v1)] = _flow_of_views(factor, state, v0, v1)
    return flow


def _flow_of_views(factor: CornerFactor, state: State, v0: int, v1: int) -> np.ndarray:
    """(n, 2) px/s: image velocity of each corner of views v0..v1."""
    X, _ = factor.points_in_camera(state, v0, v1)
    image = factor.views.image[v0:v1]
    poses = factor.imu_poses(state, int(image[0]), int(image[-1]) + 1)
    R_ic, p_ic = state.values[factor.name, "rotation"], state.values[factor.name, "translation"]
    rate = poses.rate @ R_ic
    velocity = (np.einsum("nji,nj->ni", poses.rotation, poses.velocity) + np.cross(poses.rate, p_ic)) @ R_ic
    of_corner = np.repeat(image - image[0], np.diff(factor.views.start[v0 : v1 + 1]))
    params = factor.lens(state)
    _, _, J, _ = factor.model.project_with_jacobians(params, X)
    return np.einsum("nij,nj->ni", J, -np.cross(rate[of_corner], X) - velocity[of_corner])


def image_mean(stream: CornerStream, x: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """(M,) mean of x (N,) over the corners of each image that `keep` (N,) bool selects; 0 without such corners."""
    image, n = stream.image[keep], len(stream.stamps_ns)
    count = np.bincount(image, minlength=n)
    return np.bincount(image, x[keep], minlength=n) / np.maximum(count, 1)


@dataclass(frozen=True)
class ResidualNoise:
    """Noise estimated from the residuals of one camera: base [px] and exposure [s] as in `NoiseModel`; lens: misfit of
    the lens model."""

    base: float
    exposure: float
    lens: LensMisfit

    @property
    def lens_misfit_is_large(self) -> bool:
        """Whether the misfit justifies a wide robust loss and a search for a better camera model."""
        return self.lens.rms > LARGE_MISFIT_RATIO * self.base


def residual_noise(factor: CornerFactor, out: CornerOutput, settings: Settings, speed: np.ndarray) -> ResidualNoise:
    """Noise and misfit, estimated from the residuals `out` of a pass. speed (M,) px/s: result of `image_speed`.

    Only corners in use are considered; at least one is needed.
    """
    stream, used = factor.stream, out.root > 0.0
    error = factor.errors(out)
    lens = lens_misfit(stream, error, used)
    error -= lens.field
    relative = stream.relative_sigma[used].astype(np.float32)
    square = np.einsum("ni,ni->n", error, error)[used] / relative**2
    base, exposure = float(np.sqrt(median_variance(square))), 0.0
    if settings.blur_noise:
        base, exposure = _fit_blur(square, speed[stream.image][used] / relative)
    return ResidualNoise(max(base, MIN_CORNER_NOISE_PX), exposure, lens)


def estimate_noise(
    camera: Camera,
    settings: Settings,
    factor: CornerFactor,
    out: CornerOutput,
    speed: np.ndarray,
) -> tuple[NoiseModel, bool]:
    """Noise of the next pass, estimated from the residuals `out`, without shared errors, and whether the misfit of the
    lens model is large.

    A base noise in the rig file is kept, with zero misfit. speed (M,) px/s: result of `image_speed`. Raises
    EstimationError if the pass diverged, so that no corner is in use.
    """
    if not (out.root > 0.0).any():
        raise EstimationError(
            f"the estimate diverged, {camera.name} would see none of its corners; correct its rotation, "
            "translation, time_offset, intrinsics and distortion in the rig file, or remove them so that they "
            "are estimated."
        )
    estimate = residual_noise(factor, out, settings, speed)
    if camera.corner_noise_px is not None:
        return NoiseModel(camera.corner_noise_px, estimate.exposure), estimate.lens_misfit_is_large
    return NoiseModel(estimate.base, estimate.exposure, misfit=estimate.lens.rms), estimate.lens_misfit_is_large


def scale_shift(tau: float, fit: Fit) -> float:
    """tau [px] of the next pass: times the square root of its chi^2 over post-fit degrees of freedom."""
    return float(np.clip(tau * np.sqrt(fit.chi2 / max(fit.dof, 1.0)), MIN_COMMON_ERROR_PX, MAX_COMMON_ERROR_PX))


def from_middle(stream: CornerStream) -> np.ndarray:
    """(M,) s: stamps of the images since the mean stamp of their recording."""
    parts = np.split(stream.seconds, np.searchsorted(stream.stamps_ns, stream.joins_ns))
    return np.concatenate([part - part.mean() for part in parts if len(part)])


def with_jitter(
    model: NoiseModel, present: NoiseModel, factor: CornerFactor, out: CornerOutput, fit: Fit
) -> NoiseModel:
    """`model` with jitter and clock rate, estimated from the delays in the residuals `out` of a pass with the noise
    `present`. fit: statistics of these delays.

    A line through delays with jitter leaves a rate, to which independent delays would give too much certainty."""
    image, delay = factor.views.image, out.shared[:, -1]
    seconds = from_middle(factor.stream)[image]
    speed = image_speed(factor, factor.noise.field[:, :, -1])[image]
    line = np.polynomial.Polynomial.fit(seconds, delay, 1, w=speed)
    chi2 = float((((delay - line(seconds)) / present.jitter) ** 2).sum())
    jitter, std = scale_jitter(present.jitter, replace(fit, chi2=chi2))
    return replace(model, jitter=jitter, jitter_std=std, rate=present.rate + float(line.deriv()(0.0)))


def scale_jitter(jitter: float, fit: Fit) -> tuple[float, float]:
    """`jitter` [s] of the next pass, as `scale_shift`, and its standard deviation; zeros if it is not significant.

    Without jitter, the estimated delays are the noise of the estimate alone. With `dof` of the `count` delays observed,
    their chi^2 is then count q (1 - q) at most, with q = dof / count (Jensen's inequality).
    """
    dof = max(fit.dof, 1.0)
    share = min(dof / fit.count, 1.0)
    noise = dof * (1.0 - share) + SIGNIFICANT_JITTER_STD * np.sqrt(2.0 * dof) * (1.0 - share)
    if fit.chi2 <= noise:
        return 0.0, 0.0
    scaled = jitter * float(np.sqrt(fit.chi2 / dof))
    return scaled, scaled / float(np.sqrt(2.0 * dof))


def _fit_blur(square: np.ndarray, speed: np.ndarray) -> tuple[float, float]:
    """base [px] and exposure [s] from a line fitted to the median variances in bins of speed, variance over speed^2.

    The fit minimises relative errors. Exposure is 0 with fewer than three usable bins, or if the fit is not positive.
    square (n,) px^2: squared residuals, over the squared `relative_sigma`; speed (n,) px/s, over `relative_sigma`."""
    edges = np.quantile(speed, np.linspace(0.0, 1.0, SPEED_BINS + 1))
    which = np.clip(np.searchsorted(edges, speed, side="right") - 1, 0, SPEED_BINS - 1)
    bins = [k for k in range(SPEED_BINS) if (which == k).sum() >= MIN_CORNERS_IN_BIN]
    if len(bins) < 3:
        return float(np.sqrt(median_variance(square))), 0.0
    variance = np.array([median_variance(square[which == k]) for k in bins])
    v2 = np.array([np.mean(speed[which == k] ** 2) for k in bins])
    A = np.stack([1.0 / variance, v2 / variance], axis=1)
    (a, b), *_ = np.linalg.lstsq(A, np.ones(len(bins)), rcond=None)
    if b <= 0.0 or a <= 0.0:
        return float(np.sqrt(median_variance(square))), 0.0
    return float(np.sqrt(a)), float(np.sqrt(b))


# Rejects corners with large residuals, unless their neighbours in the image plane have similar ones.
#
# Misfit of the lens model causes large residuals near the border of the image. They are similar for neighbouring
# corners of all images, and decrease towards the middle. A gross outlier has no similar neighbours. So a corner with a
# large residual is only suspect. It is kept if a chain of neighbours with similar residuals leads from it to a corner
# that is not suspect.

N_NEIGHBOURS = 12  # nearest corners; with 24, small outliers near the border have similar neighbours by chance
# Corners without suspicion, among which neighbours are searched: one per 4 x 4 px of an image of 752 x 480 px. With
# fewer, neighbours are farther away; with more, the search needs more time and memory.
MAX_UNSUSPECT_CORNERS = 20_000
CORNERS_PER_TAG = 4  # corners of a tag in one image are no neighbours: a misidentified tag displaces all alike
SIMILAR_RATIO = 0.7  # largest difference of similar residuals over the suspect's; at 1, zero would be similar


def inliers(factor: CornerFactor, out: CornerOutput, settings: Settings) -> np.ndarray:
    """(N,) bool: corners that are not rejected. Corners outside the range of the lens model are rejected, too.

    A corner is suspect if its residual is longer than `outlier_min_px`, and longer than mean plus `outlier_std`
    standard deviations of normal errors. Lengths of normal errors have a Rayleigh distribution. Its scale follows from
    the median length of the image or of all images, whichever is larger. A suspect corner is rejected if it is
    `isolated`, or if the loss is `none`. All corners are kept if `outlier_std` is 0.
    """
    if settings.outlier_std <= 0.0:
        return np.ones(len(out.root), dtype=bool)
    used = np.flatnonzero((out.root > 0.0) | ~factor.keep)  # rejected corners are tested again: they may fit now
    kept = np.zeros(len(out.root), dtype=bool)
    kept[used] = ~rejected(factor, used, out.residual[used], settings)
    return kept


def rejected(factor: CornerFactor, rows: np.ndarray, residual: np.ndarray, settings: Settings) -> np.ndarray:
    """(n,) bool: outliers among the corners `rows` (n,) of the stream, with residuals (n, 2) [px]; see `inliers`."""
    if settings.outlier_std <= 0.0:
        return np.zeros(len(rows), dtype=bool)
    # Double precision: in gaps of the IMU, poses may project points to 1e20 px, and squares would overflow.
    residual = residual.astype(np.float64)
    stream, size = factor.stream, np.linalg.norm(residual, axis=1)
    image = stream.image[rows]
    usual = grouped_quantiles(size, image, len(stream.stamps_ns), 0.5)
    if len(size):
        usual = np.maximum(usual, np.median(size))
    limit = np.maximum(largest_normal(settings.outlier_std, 0.5) * usual, settings.outlier_min_px)
    suspect = size > limit[image]
    if settings.loss == "none" or not suspect.any():  # without robust loss, an outlier has unbounded influence
        return suspect
    some, number = _with_neighbours(suspect), factor.bodies.target.tag_number
    tag = image[some] * (1 + number.max(initial=0)) + number[stream.point[rows[some]]]
    suspect[some] = isolated(stream.uv[rows[some]], residual[some], suspect[some], tag)
    return suspect


def _with_neighbours(suspect: np.ndarray) -> np.ndarray:
    """(n,) sorted indices of all corners that are `suspect` (N,) bool, and of every k-th other corner, at most
    MAX_UNSUSPECT_CORNERS."""
    others = np.flatnonzero(~suspect)
    return np.union1d(np.flatnonzero(suspect), others[:: 1 + len(others) // MAX_UNSUSPECT_CORNERS])


def isolated(uv: np.ndarray, residual: np.ndarray, suspect: np.ndarray, tag: np.ndarray) -> np.ndarray:
    """(N,) bool: `suspect` (N,) corners without a chain of similar neighbours to a corner that is not suspect.

    uv, residual (N, 2) [px]: corners of all images together. tag (N,) int: a number for each tag in each image; corners
    with the same number share errors, and are no neighbours. Neighbours are the nearest corners in the image plane.
    """
    suspects = np.flatnonzero(suspect)
    if not len(suspects):
        return np.zeros(len(uv), dtype=bool)
    near = KDTree(uv).query(uv[suspects], min(N_NEIGHBOURS + CORNERS_PER_TAG, len(uv)))[1].reshape(len(suspects), -1)
    difference = np.linalg.norm(residual[near] - residual[suspects, None], axis=2)
    similar = difference < SIMILAR_RATIO * np.linalg.norm(residual[suspects], axis=1)[:, None]
    similar &= tag[near] != tag[suspects, None]
    # A graph with a vertex for each suspect corner; vertex 0 stands for all corners that are not suspect.
    vertex = np.zeros(len(uv), dtype=np.int64)
    vertex[suspects] = 1 + np.arange(len(suspects))
    row, column = np.nonzero(similar)
    ends = vertex[suspects][row], vertex[near[row, column]]
    graph = coo_array((np.ones(len(row)), ends), shape=(len(suspects) + 1, len(suspects) + 1))
    component = connected_components(graph, directed=False)[1]
    out = np.zeros(len(uv), dtype=bool)
    out[suspects[component[1:] != component[0]]] = True
    return out


# Misfit of the lens model: the part of the corner residuals that is a function of the image position alone.
#
# The residuals of a camera are averaged over cells of the image, in groups of consecutive images. Without misfit the
# means of two groups are independent, with mean zero. So the mean product over pairs of different groups estimates the
# squared misfit without bias (a U-statistic; Hoeffding 1948). Without misfit its variance is twice the sum of the
# squared products over ordered pairs. That holds even if cells of one group share an error, such as one of the pose.

# Columns and rows of cells in the bounding box of all corners. Smaller cells resolve finer misfit with more noise.
MISFIT_CELLS = (12, 8)
MAX_IMAGE_GROUPS = 200  # errors correlate between successive images, so groups must be long against the correlation
MIN_GROUPS_IN_CELL = 3  # groups with corners in a cell, below which the cell is left out
SIGNIFICANT_STD = 5.0  # standard deviations of the statistic under noise alone; a smaller misfit counts as zero


@dataclass(frozen=True)
class LensMisfit:
    """Misfit of one camera's lens model.

    rms [px]: RMS misfit per image axis over all corners, 0 if it is not significant. field (N, 2) [px]: mean residual,
    predicted - measured, in the cell of each corner; 0 in cells with too few groups.
    """

    rms: float
    field: np.ndarray


def lens_misfit(stream: CornerStream, residual: np.ndarray, used: np.ndarray) -> LensMisfit:
    """The misfit of one camera's lens model.

    residual (N, 2) [px]: predicted - measured; used (N,) bool: corners in use. The misfit is zero if it is not
    significant, or no corner is in use.
    """
    nothing = LensMisfit(0.0, np.zeros((len(used), 2), np.float32))
    if not used.any():
        return nothing
    cell, n, images = _cells(stream.uv, used), MISFIT_CELLS[0] * MISFIT_CELLS[1], len(stream.stamps_ns)
    group_of_image = np.arange(images) * min(images, MAX_IMAGE_GROUPS) // images
    n_groups = int(group_of_image[-1]) + 1
    key = (group_of_image * n).astype(np.int32)[stream.image[used]] + cell[used]
    count = np.bincount(key, minlength=n_groups * n).reshape(n_groups, n)
    means = np.stack([np.bincount(key, residual[used, k], n_groups * n) for k in range(2)], axis=1)
    means = means.reshape(n_groups, n, 2) / np.maximum(count, 1)[:, :, None]
    groups = (count > 0).sum(axis=0)
    enough = groups >= MIN_GROUPS_IN_CELL
    share = np.where(enough, count.sum(axis=0), 0.0)
    # products[a, b]: product of the means of groups a and b, summed over cells with their numbers of corners as
    # weights, over the number of pairs. Without misfit, off-diagonal entries have mean zero. The diagonal, which holds
    # the noise, is dropped.
    root = np.sqrt(share / max(share.sum(), 1.0) / np.maximum(groups * (groups - 1.0), 1.0))
    scaled = root[:, None] * means
    products = np.einsum("acx,bcx->ab", scaled, scaled, optimize=True)
    np.fill_diagonal(products, 0.0)
    square = float(products.sum())  # of both components together
    if not square > SIGNIFICANT_STD * np.sqrt(2.0 * float((products**2).sum())):
        return nothing
    mean = np.where(enough[:, None], means.sum(axis=0) / np.maximum(groups, 1)[:, None], 0.0)
    return LensMisfit(float(np.sqrt(0.5 * square)), mean.astype(np.float32)[cell])


def _cells(uv: np.ndarray, used: np.ndarray) -> np.ndarray:
    """(N,) int: cell of each corner uv (N, 2) px, in a grid over the bounding box of the `used` corners."""
    column, row = (_strips(uv[:, k], used, MISFIT_CELLS[k]) for k in range(2))
    return row * np.int16(MISFIT_CELLS[0]) + column


def _strips(x: np.ndarray, used: np.ndarray, count: int) -> np.ndarray:
    """(N,) int16 from 0 to `count` - 1: number of the interval of x (N,), when `count` equal ones span the `used` x."""
    used_x = x[used]
    low, size = used_x.min(), np.ptp(used_x) + 1e-9
    return np.clip((x - low) / size * count, 0, count - 1).astype(np.int16)
