"""Noise of corners, estimated from the residuals of a pass.

    sigma_n^2 = (base s_n)^2 + (exposure v_i)^2 + misfit^2      corner n of image i; v_i [px/s]: image speed (blur)
    shared    ~ N(0, tau_k^2), independent in u and v           coefficients of the error that an image's corners share

s_n is the detector's standard deviation of the corner over that of the median corner, 1 if the detector states none.
base and exposure come from medians, which are robust to outliers. tau comes from the chi^2 of the shared errors over
post-fit degrees of freedom, pass by pass (variance components; Foerstner 1979), because poses absorb most of the error.

The misfit is the error of the lens model. Near the border of the image it is many times its RMS, and a robust loss
down-weights corners there. With other sensors this is wanted, because the border would bias their parameters. With
cameras alone the lens should fit the whole image, so a large misfit widens the robust loss by `WIDE_LOSS_FACTOR`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.errors import EstimationError
from icalib.model.statistics import Fit
from icalib.optim.medians import median_variance
from icalib.optim.state import State
from icalib.rig import Camera, Settings
from icalib.sensors.camera.corner_factor import CornerFactor, CornerNoise, CornerOutput
from icalib.sensors.camera.corner_misfit import LensMisfit, lens_misfit

INITIAL_CORNER_NOISE_PX = 0.5  # per axis, in the first pass: typical residual with a rough lens
MIN_COMMON_ERROR_PX, MAX_COMMON_ERROR_PX = 1e-3, 5.0  # limits of tau: for finite weights, and against divergence
INITIAL_COMMON_ERROR_PX = 0.1  # tau in the first pass that models the common error
N_COMMON_ERRORS = 1  # number of functions of the common error: 1 is a shift; 3 would be an affine field
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

    base [px]: standard deviation of the median corner per axis; exposure [s]: blur per image speed; tau (m,) px:
    standard deviations of the common error, empty if it is not modelled; misfit [px]: RMS error of the lens model.
    wide_loss: the threshold of the robust loss is `WIDE_LOSS_FACTOR` times the `loss_scale` of the rig file."""

    base: float
    exposure: float = 0.0
    tau: tuple[float, ...] = ()
    misfit: float = 0.0
    wide_loss: bool = False

    def noise(
        self, stream: CornerStream, camera: Camera, settings: Settings, speed: np.ndarray | None = None
    ) -> CornerNoise:
        """The noise of each corner of `stream`. speed (M,) px/s: image speed of each image; no motion blur if None."""
        blur = 0.0 if speed is None else self.exposure * speed[stream.image]
        sigma = np.hypot(np.hypot(self.base * stream.relative_sigma, blur), self.misfit)
        field = np.ones((len(stream.uv), len(self.tau)))
        if len(self.tau) > 1:
            half = 0.5 * np.array(camera.resolution)
            x, y = ((stream.uv - half) / half[0]).T
            field[:] = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)[:, : len(self.tau)]
        scale = settings.loss_scale * (WIDE_LOSS_FACTOR if self.wide_loss else 1.0)
        return CornerNoise(sigma, np.array(self.tau), field, settings.loss, scale)


def first_noise(camera: Camera) -> NoiseModel:
    """Corner noise of the first pass: the value of the rig file, or else `INITIAL_CORNER_NOISE_PX`."""
    return NoiseModel(camera.corner_noise_px or INITIAL_CORNER_NOISE_PX)


def image_speed(factor: CornerFactor, state: State) -> np.ndarray:
    """(M,) px/s: image speed of the target in each image, RMS over the corners in use; 0 without such corners."""
    square = np.empty(len(factor.stream.uv))
    for v0, v1 in factor.blocks():
        square[factor.corners_of(v0, v1)] = _squared_flow(factor, state, v0, v1)
    return np.sqrt(image_mean(factor.stream, square, factor.keep))


def _squared_flow(factor: CornerFactor, state: State, v0: int, v1: int) -> np.ndarray:
    """(n,) (px/s)^2: squared image speed of each corner of views v0..v1."""
    X, _ = factor.points_in_camera(state, v0, v1)
    image = factor.views.image[v0:v1]
    poses = factor.imu_poses(state, int(image[0]), int(image[-1]) + 1)
    R_ic, p_ic = state.values[factor.name, "rotation"], state.values[factor.name, "translation"]
    rate = poses.rate @ R_ic
    velocity = (np.einsum("nji,nj->ni", poses.rotation, poses.velocity) + np.cross(poses.rate, p_ic)) @ R_ic
    of_corner = np.repeat(image - image[0], np.diff(factor.views.start[v0 : v1 + 1]))
    params = factor.lens(state)
    _, _, J, _ = factor.model.project_with_jacobians(params, X)
    return (np.einsum("nij,nj->ni", J, -np.cross(rate[of_corner], X) - velocity[of_corner]) ** 2).sum(axis=1)


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
    tau: tuple[float, ...],
) -> tuple[NoiseModel, bool]:
    """Noise of the next pass, estimated from the residuals `out`, and whether the misfit of the lens model is large.

    A base noise in the rig file is kept, with zero misfit. speed (M,) px/s: result of `image_speed`; tau: standard
    deviations of the common error. Raises EstimationError if the pass diverged, so that no corner is in use.
    """
    if not (out.root > 0.0).any():
        raise EstimationError(
            f"the estimate diverged, {camera.name} would see none of its corners; correct its rotation, "
            "translation, time_offset, intrinsics and distortion in the rig file, or remove them so that they "
            "are estimated."
        )
    estimate = residual_noise(factor, out, settings, speed)
    if camera.corner_noise_px is not None:
        return NoiseModel(camera.corner_noise_px, estimate.exposure, tau), estimate.lens_misfit_is_large
    return NoiseModel(estimate.base, estimate.exposure, tau, estimate.lens.rms), estimate.lens_misfit_is_large


def scale_common_errors(tau: tuple[float, ...], fits: list[Fit]) -> tuple[float, ...]:
    """tau (m,) px of the next pass: each times the square root of its chi^2 over post-fit degrees of freedom.

    fits: statistics of the camera's common errors, in the order of `tau`.
    """
    return tuple(
        float(np.clip(t * np.sqrt(f.chi2 / max(f.dof, 1.0)), MIN_COMMON_ERROR_PX, MAX_COMMON_ERROR_PX))
        for t, f in zip(tau, fits, strict=True)
    )


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
