"""How large the errors of corners are, judged from what a pass leaves behind.

    sigma_i^2 = base^2 + (exposure v_i)^2      image i, whose corners move at v_i px/s: blur
    shared    ~ N(0, tau^2), u and v apart     a shift that all corners of an image have in common

Sizes come from medians, so that outliers have no say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.estimation.corner_factor import CornerFactor, CornerNoise, CornerOutput
from icalib.estimation.state import State
from icalib.measurements import CornerStream
from icalib.rig import Camera, Settings

FIRST_GUESS_PX = 0.5
SMALLEST_PX = 1e-3
SMALLEST_BASE_PX = 0.02
BINS = 12  # of image speed
MEDIAN_OF_SQUARE = 2.0 * np.log(2.0)  # median of chi^2 with two degrees of freedom
MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class NoiseModel:
    """One camera's corner noise: base [px], exposure [s], tau [px] (0: images share no error)."""

    base: float
    exposure: float = 0.0
    tau: float = 0.0

    def noise(self, stream: CornerStream, settings: Settings, speed: np.ndarray | None = None) -> CornerNoise:
        """What the corner factor needs; speed (M,) px/s of each image."""
        blur = 0.0 if speed is None else self.exposure * speed
        sigma = np.hypot(self.base, np.broadcast_to(blur, stream.stamps_ns.shape))
        m = 1 if self.tau > 0.0 else 0
        field = np.ones((len(stream.uv), m))
        return CornerNoise(sigma, np.full(m, self.tau), field, settings.loss, settings.loss_scale)


def first_noise(camera: Camera) -> NoiseModel:
    """Before anything is known: what the rig file says, or half a pixel."""
    return NoiseModel(camera.corner_noise_px or FIRST_GUESS_PX)


def image_speed(factor: CornerFactor, state: State) -> np.ndarray:
    """(M,) px/s, RMS over the corners of each image."""
    X, _ = factor.points_in_camera(state)
    poses, _, _ = factor.camera_poses(state)
    R_ic, p_ic = state.values[factor.name, "rotation"], state.values[factor.name, "translation"]
    rate = poses.rate @ R_ic
    velocity = (np.einsum("nji,nj->ni", poses.rotation, poses.velocity) + np.cross(poses.rate, p_ic)) @ R_ic
    image = factor.stream.image
    params = np.concatenate([state.values[factor.name, "intrinsics"], state.values[factor.name, "distortion"]])
    _, _, J, _ = factor.model.project_with_jacobians(params, X)
    flow = np.einsum("nij,nj->ni", J, -np.cross(rate[image], X) - velocity[image])
    return np.sqrt(image_mean(factor.stream, (flow**2).sum(axis=1), factor.keep))


def image_mean(stream: CornerStream, x: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """(M,) mean of x (N,) over the kept corners of each image, 0 where there are none."""
    image, n = stream.image[keep], len(stream.stamps_ns)
    count = np.bincount(image, minlength=n)
    return np.bincount(image, x[keep], minlength=n) / np.maximum(count, 1)


def estimate_noise(
    camera: Camera, settings: Settings, factor: CornerFactor, out: CornerOutput, speed: np.ndarray
) -> NoiseModel:
    """The noise that the residuals of a pass show. A size given in the rig file is kept."""
    stream, used = factor.stream, out.root > 0.0
    error = out.residual + (factor.noise.field[:, None, :] * out.shared[stream.image]).sum(axis=2)
    square = (error**2).sum(axis=1)
    if camera.corner_noise_px is not None:
        base, exposure = camera.corner_noise_px, 0.0
        if settings.blur_noise:
            _, exposure = _fit_blur(square[used], speed[stream.image][used])
    elif settings.blur_noise:
        base, exposure = _fit_blur(square[used], speed[stream.image][used])
    else:
        base, exposure = np.sqrt(np.median(square[used]) / MEDIAN_OF_SQUARE), 0.0
    tau = _shared_size(factor, out, used, np.hypot(base, exposure * speed)) if settings.common_error else 0.0
    return NoiseModel(max(float(base), SMALLEST_BASE_PX), float(exposure), tau)


def _fit_blur(square: np.ndarray, speed: np.ndarray) -> tuple[float, float]:
    """base, exposure from squared errors (n,) and image speeds (n,), each bin of speeds with relative weight."""
    edges = np.quantile(speed, np.linspace(0.0, 1.0, BINS + 1))
    which = np.clip(np.searchsorted(edges, speed, side="right") - 1, 0, BINS - 1)
    bins = [k for k in range(BINS) if (which == k).sum() >= 50]
    if len(bins) < 3:
        return float(np.sqrt(np.median(square) / MEDIAN_OF_SQUARE)), 0.0
    variance = np.array([np.median(square[which == k]) for k in bins]) / MEDIAN_OF_SQUARE
    v2 = np.array([np.mean(speed[which == k] ** 2) for k in bins])
    A = np.stack([1.0 / variance, v2 / variance], axis=1)
    (a, b), *_ = np.linalg.lstsq(A, np.ones(len(bins)), rcond=None)
    if b <= 0.0 or a <= 0.0:
        return float(np.sqrt(np.median(square) / MEDIAN_OF_SQUARE)), 0.0
    return float(np.sqrt(a)), float(np.sqrt(b))


def _shared_size(factor: CornerFactor, out: CornerOutput, used: np.ndarray, sigma: np.ndarray) -> float:
    """tau [px] from the spread of the images' mean residuals beyond what independent corners leave."""
    stream = factor.stream
    count = np.bincount(stream.image[used], minlength=len(stream.stamps_ns))
    seen = count > 0
    means = np.stack([image_mean(stream, out.residual[:, k], used)[seen] for k in range(2)])
    spread = MAD_TO_SIGMA * np.median(np.abs(means - np.median(means, axis=1, keepdims=True)))
    own = np.median(sigma[seen] ** 2 / count[seen])
    return float(max(np.sqrt(max(spread**2 - own, 0.0)), SMALLEST_PX))
