"""How large the errors of corners are, judged from what a pass leaves behind.

    sigma_n^2 = (base s_n)^2 + (exposure v_i)^2 + misfit^2   corner n of image i, whose corners move at v_i px/s: blur
    shared    ~ N(0, tau_k^2), u and v apart   an error that the corners of an image have in common: a shift, a tilt

s_n is the detector's standard deviation of the corner over that of the median corner, 1 where it states none. Sizes
of single corners come from medians, so that outliers have no say. Those of the common errors come from their chi^2 over
post-fit degrees of freedom, pass by pass (Foerstner's variance components): the poses soak most of them up.

The misfit is what the model of the lens cannot follow. It is many times its RMS near the border of the image, which a
robust loss takes for outliers. With other sensors that is as well, for the border would pull their parameters. With
cameras alone the lens is to leave little over the whole image, and the loss bends `LATER` where the misfit is large.
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

FIRST_GUESS_PX = 0.5
SMALLEST_PX, LARGEST_PX = 1e-3, 5.0
FIRST_TAU_PX = 0.1
COMMON_ERRORS = 1
MIN_CORNER_NOISE_PX = 0.005  # no detector does better; keeps weights finite where corners are exact
BINS = 12  # of image speed
LARGE_MISFIT = 0.5  # times the noise: a fifth of the variance
# Times the `loss_scale`. On stereo stills whose lenses leave 8 px near the border it takes the error of images that
# were left out from 0.29 px to 0.27 px. No robust loss at all leaves 0.25 px, but moves the baseline by 0.15 mm more.
LATER = 2.5


@dataclass(frozen=True)
class NoiseModel:
    """One camera's corner noise: base [px] of its median corner, exposure [s], tau (m,) [px] (empty: images share no
    error), misfit of the lens [px]. later: the loss bends at `LATER` times the `loss_scale` of the rig file."""

    base: float
    exposure: float = 0.0
    tau: tuple[float, ...] = ()
    misfit: float = 0.0
    later: bool = False

    def noise(
        self, stream: CornerStream, camera: Camera, settings: Settings, speed: np.ndarray | None = None
    ) -> CornerNoise:
        """What the corner factor needs; speed (M,) px/s of each image."""
        blur = 0.0 if speed is None else self.exposure * speed[stream.image]
        sigma = np.hypot(np.hypot(self.base * stream.relative_sigma, blur), self.misfit)
        field = np.ones((len(stream.uv), len(self.tau)))
        if len(self.tau) > 1:
            half = 0.5 * np.array(camera.resolution)
            x, y = ((stream.uv - half) / half[0]).T
            field[:] = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)[:, : len(self.tau)]
        scale = settings.loss_scale * (LATER if self.later else 1.0)
        return CornerNoise(sigma, np.array(self.tau), field, settings.loss, scale)


def first_noise(camera: Camera) -> NoiseModel:
    """Before anything is known: what the rig file says, or half a pixel."""
    return NoiseModel(camera.corner_noise_px or FIRST_GUESS_PX)


def image_speed(factor: CornerFactor, state: State) -> np.ndarray:
    """(M,) px/s, RMS over the corners of each image."""
    square = np.empty(len(factor.stream.uv))
    for v0, v1 in factor.blocks():
        square[factor.corners_of(v0, v1)] = _squared_flow(factor, state, v0, v1)
    return np.sqrt(image_mean(factor.stream, square, factor.keep))


def _squared_flow(factor: CornerFactor, state: State, v0: int, v1: int) -> np.ndarray:
    """(n,) squared speed in the image of the corners of views v0..v1."""
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
    """(M,) mean of x (N,) over the kept corners of each image, 0 where there are none."""
    image, n = stream.image[keep], len(stream.stamps_ns)
    count = np.bincount(image, minlength=n)
    return np.bincount(image, x[keep], minlength=n) / np.maximum(count, 1)


@dataclass(frozen=True)
class ResidualNoise:
    """What the residuals of one camera show: base [px] of its median corner and exposure [s] as in `NoiseModel`, and
    the misfit of the lens."""

    base: float
    exposure: float
    lens: LensMisfit

    @property
    def lens_misfit_is_large(self) -> bool:
        """The one test for the later robust loss and for the warning that names another camera model."""
        return self.lens.rms > LARGE_MISFIT * self.base


def residual_noise(factor: CornerFactor, out: CornerOutput, settings: Settings, speed: np.ndarray) -> ResidualNoise:
    """The noise and misfit that the residuals of a pass show; speed (M,) px/s as of `image_speed`.

    Only corners that take part count; there must be one.
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
    """The noise that the residuals of a pass show, with `tau` for its common errors; whether the lens misfit is large.

    A size given in the rig file is kept. Raises EstimationError where the pass led so far away that no corner is in
    front of the camera.
    """
    if not (out.root > 0.0).any():
        raise EstimationError(
            f"the estimate diverged, {camera.name} would see none of its corners; correct its rotation, "
            "translation, time_offset, intrinsics and distortion in the rig file, or remove them so that they "
            "are estimated."
        )
    shown = residual_noise(factor, out, settings, speed)
    if camera.corner_noise_px is not None:
        return NoiseModel(camera.corner_noise_px, shown.exposure, tau), shown.lens_misfit_is_large
    return NoiseModel(shown.base, shown.exposure, tau, shown.lens.rms), shown.lens_misfit_is_large


def scale_common_errors(tau: tuple[float, ...], fits: list[Fit]) -> tuple[float, ...]:
    """tau of the next pass: each times the square root of its chi^2 over post-fit degrees of freedom.

    fits: those of one camera's common errors, in order.
    """
    return tuple(
        float(np.clip(t * np.sqrt(f.chi2 / max(f.dof, 1.0)), SMALLEST_PX, LARGEST_PX))
        for t, f in zip(tau, fits, strict=True)
    )


def _fit_blur(square: np.ndarray, speed: np.ndarray) -> tuple[float, float]:
    """base, exposure from squared errors (n,) and image speeds (n,), both over the corners' relative standard
    deviations, each bin of speeds with relative weight."""
    edges = np.quantile(speed, np.linspace(0.0, 1.0, BINS + 1))
    which = np.clip(np.searchsorted(edges, speed, side="right") - 1, 0, BINS - 1)
    bins = [k for k in range(BINS) if (which == k).sum() >= 50]
    if len(bins) < 3:
        return float(np.sqrt(median_variance(square))), 0.0
    variance = np.array([median_variance(square[which == k]) for k in bins])
    v2 = np.array([np.mean(speed[which == k] ** 2) for k in bins])
    A = np.stack([1.0 / variance, v2 / variance], axis=1)
    (a, b), *_ = np.linalg.lstsq(A, np.ones(len(bins)), rcond=None)
    if b <= 0.0 or a <= 0.0:
        return float(np.sqrt(median_variance(square))), 0.0
    return float(np.sqrt(a)), float(np.sqrt(b))
