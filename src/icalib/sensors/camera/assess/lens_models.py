"""Warns if the camera model of the rig file does not follow the lens, and names a model that does.

Models are compared by cross-validation. Each model is fitted to half of the images, with poses and board shape free,
and tested on the other half, in which only poses are fitted. Both halves see the places of the image where the misfit
is. All models use the same detected corners: a corner is rejected only if no model explains it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry.cameras import CAMERA_MODELS, camera_model
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.cameras.convert import Adjusted, ImagePoints, adjust, initial_parameters
from icalib.motion.factor import pairs_of
from icalib.observability.cause import Cause
from icalib.optim.state import State
from icalib.rig import Settings
from icalib.sensors.camera.circle_centres import with_circle_centres
from icalib.sensors.camera.corner_factor import CornerFactor, CornerOutput
from icalib.sensors.camera.corner_noise import (
    LARGE_MISFIT_RATIO,
    ResidualNoise,
    image_flow,
    image_speed,
    residual_noise,
)
from icalib.sensors.camera.corner_outliers import rejected
from icalib.sensors.camera.spec import LENS, Camera

MOST_IMAGES = 40  # images of a comparison, half of them for the test; the computing time is proportional
FEWEST_IMAGES = 4  # in each half; with fewer no model is fitted
FEWEST_CORNERS = 8  # in an image; its pose takes up six of their 16 coordinates
EXPLAINED = 0.5  # least share of the misfit's variance that a model must remove to be named
SIGN_TEST_SIGMAS = 3.0  # least deviation of the number of images that another model fits better from half of them
NO_BETTER_MODEL = ", and no other camera model follows them clearly better"
CHECK_IMAGES = "; check that the images are as the camera took them, and that the target is as the rig file says."
REGIONS = (
    ("top left corner", "top edge", "top right corner"),
    ("left edge", "centre", "right edge"),
    ("bottom left corner", "bottom edge", "bottom right corner"),
)  # thirds of the image, row by row


@dataclass(frozen=True)
class _Trial:
    """A camera model, adjusted to the `fitted` images, and its fit to the M `tested` images."""

    model: CameraModel
    fitted: Adjusted
    tested: Adjusted

    @property
    def residuals(self) -> np.ndarray:
        """(N, 2) px: residuals of all corners, first of the fitted and then of the test images."""
        return np.concatenate([self.fitted.residual, self.tested.residual])

    @property
    def squared_error(self) -> np.ndarray:
        """(M,) px^2: sum of squared residuals over the used corners of each test image."""
        points, square = self.tested.points, (self.tested.residual**2).sum(axis=1)
        return points.sum_by_image(np.where(points.used, square, 0.0))

    @property
    def corners(self) -> int:
        """Number of used corners in all test images."""
        return int(self.tested.points.used.sum())

    @property
    def rms(self) -> float:
        """RMS residual of one coordinate over the test images [px]."""
        return float(np.sqrt(0.5 * self.squared_error.sum() / self.corners))


def wrong_models(inputs: Inputs, estimate: Estimate) -> Iterator[Cause]:
    """A cause for each camera whose estimated lens leaves a large misfit (`ResidualNoise`).

    Its sentence names a model that is clearly better. If none is, there is a cause only if the misfit exceeds the
    noise.
    """
    state, streams = estimate.outcome.state, inputs.measurements.cameras
    pairs = pairs_of(estimate.problem.factors, estimate.outcome.residuals, CornerFactor)
    for camera, (factor, out), stream in zip(inputs.rig.cameras, pairs, streams, strict=True):
        if camera.distortion.mode == "fixed" or not (out.root > 0.0).any():
            continue
        speed = image_speed(factor, image_flow(factor, state))
        noise = residual_noise(factor, out, inputs.rig.settings, speed)
        if not noise.lens_misfit_is_large:
            continue
        gain = 2.0 * float(np.count_nonzero(out.root)) * (noise.lens.rms / noise.base) ** 2
        current, best = compare_models(replace(factor, stream=stream), out, state, inputs.rig.settings, noise)
        largest = float(np.linalg.norm(noise.lens.field, axis=1).max())
        misfit = (
            f"the corners of {camera.name} are off by up to {largest:.2g} px, alike at the same place in all images, "
            f"most at the {worst_regions(stream.uv, noise.lens.field, camera.resolution)}"
        )
        if best is not None and current is not None:
            yield Cause(_named_model(misfit, current, best, camera), gain)
        elif noise.lens.rms > noise.base:
            yield Cause(f"{misfit}{NO_BETTER_MODEL if current is not None else ''}{CHECK_IMAGES}", gain)


def worst_regions(uv: np.ndarray, field: np.ndarray, resolution: tuple[int, int]) -> str:
    """Names of the fewest of nine image regions whose mean squared misfits are half of the sum of all nine.
    uv (N, 2) px: corners; field (N, 2) px: their misfit; resolution: width and height [px]."""
    column, row = np.clip(3.0 * uv / resolution, 0, 2).astype(int).T
    region = 3 * row + column
    square = np.bincount(region, (field**2).sum(axis=1), 9) / np.maximum(np.bincount(region, minlength=9), 1)
    order = np.argsort(-square)
    count = int(np.searchsorted(square[order].cumsum(), 0.5 * square.sum())) + 1
    return " and ".join(REGIONS[k // 3][k % 3] for k in order[:count])


def _named_model(misfit: str, current: _Trial, best: _Trial, camera: Camera) -> str:
    """The sentence about a `misfit` that the model `best` explains."""
    old = " and ".join(name for name in LENS if getattr(camera, name).value is not None)
    remove = f", and remove {old}, of {current.model.name}" if old else ""  # another model has other numbers
    return (
        f"{misfit}: {current.model.name} does not follow this lens. In images that had no part in the fit it leaves "
        f"{current.rms:.2g} px, {best.model.name} {best.rms:.2g} px; write `model: {best.model.name}`{remove}."
    )


def compare_models(
    factor: CornerFactor, out: CornerOutput, state: State, settings: Settings, noise: ResidualNoise
) -> tuple[_Trial | None, _Trial | None]:
    """The camera's model, and the model with fewest parameters that is clearly better. `factor` has all detected
    corners, `noise` their noise and misfit.

    The first is None if there are too few images, or if the camera's model cannot be fitted to them. The second is None
    if no model explains half of the misfit.
    """
    halves = _halves(with_circle_centres(factor, state), out, state, noise.lens.field)
    if halves is None:
        return None, None
    rows, fitted, tested = halves
    params = factor.lens(state)
    models = [factor.model, *(camera_model(name) for name in CAMERA_MODELS if name != factor.model.name)]
    starts = [params, *(initial_parameters(m, factor.model, params, fitted) for m in models[1:])]
    pairs = [(m, start) for m, start in zip(models, starts, strict=True) if start is not None]
    first = [fit for model, start in pairs if (fit := _cross_validated(model, start, fitted, tested)) is not None]
    if not first:
        return None, None
    # Corners that the camera's model rejects may fit another model, so outliers are those of the best model at each
    # corner.
    residuals = np.array([fit.residuals for fit in first])
    nearest = np.argmin((residuals**2).sum(axis=2), axis=0)
    used = ~rejected(factor, rows, residuals[nearest, np.arange(len(rows))], settings)
    second = [again for fit in first if (again := _again(fit, used)) is not None]
    current = next((fit for fit in second if fit.model is factor.model), None)
    if current is None:
        return None, None
    better = [fit for fit in second if _beats(fit, current, EXPLAINED * noise.lens.rms**2)]
    least = min(better, key=lambda fit: fit.rms, default=current)
    equal = [fit for fit in better if not _beats(least, fit, (LARGE_MISFIT_RATIO * noise.base) ** 2)]
    return current, min(equal, key=lambda fit: len(fit.model.parameter_names), default=None)


def _beats(fit: _Trial, other: _Trial, variance: float) -> bool:
    """Whether `fit` leaves less misfit than `other`: by more than `variance` [px^2], and in more images than chance
    explains (sign test)."""
    better, n = int((fit.squared_error < other.squared_error).sum()), len(fit.squared_error)
    # If both models are equally good, `better` has mean n / 2 and standard deviation sqrt(n) / 2. The variance alone
    # may depend on a few images.
    by_chance = better - 0.5 * n < 0.5 * SIGN_TEST_SIGMAS * np.sqrt(n)
    return other.rms**2 - fit.rms**2 > variance and not by_chance


def _cross_validated(model: CameraModel, params: np.ndarray, fitted: ImagePoints, tested: ImagePoints) -> _Trial | None:
    """The model, adjusted from `params` (P,) to the images `fitted` and tested on the images `tested`. None if an image
    does not determine its pose."""
    with suppress(np.linalg.LinAlgError):
        fit = adjust(model, params, fitted)
        return _Trial(model, fit, adjust(model, fit.params, tested, fit.shape))
    return None


def _again(fit: _Trial, used: np.ndarray) -> _Trial | None:
    """The trial, repeated from its parameters with the corners `used` (N,) bool: those of the fitted, then of the test
    images."""
    n = len(fit.fitted.residual)
    fitted, tested = replace(fit.fitted.points, used=used[:n]), replace(fit.tested.points, used=used[n:])
    return _cross_validated(fit.model, fit.fitted.params, fitted, tested)


def _halves(
    factor: CornerFactor, out: CornerOutput, state: State, field: np.ndarray
) -> tuple[np.ndarray, ImagePoints, ImagePoints] | None:
    """At most `MOST_IMAGES` images, spread over the recording: half of them for the fit, the rest for the test.

    The recording is cut into as many parts, and the image of each part is taken whose corners lie where the misfit
    `field` (N, 2) px is largest. The halves take turns in the order of this misfit, so that both have it.

    Returns the rows (N,) int of their corners in the stream, and the points of both halves. These contain all corners;
    the corners that the estimate uses are marked as used. Points are in the camera frame, by the poses of `state`; uv
    is corrected for edge bloom. None if too few images have enough corners.
    """
    stream, used = factor.stream, factor.keep & (out.root > 0.0)
    rich = np.flatnonzero(np.bincount(stream.image[used], minlength=len(stream.stamps_ns)) >= FEWEST_CORNERS)
    if len(rich) < 2 * FEWEST_IMAGES:
        return None
    misfit = np.bincount(stream.image, (field**2).sum(axis=1), len(stream.stamps_ns))
    parts = np.array_split(rich, min(MOST_IMAGES, len(rich)))
    chosen = np.array([part[np.argmax(misfit[part])] for part in parts])
    chosen = chosen[np.argsort(-misfit[chosen], kind="stable")]
    row, points, R_cam_body = _in_camera(factor, state, chosen)
    rows, halves = [], []
    for images in (chosen[::2], chosen[1::2]):
        part = np.isin(stream.image[row], images)
        half_rows = row[part]
        uv = stream.uv[half_rows]
        if len(factor.direction):
            uv = uv - state.values[factor.name, "bloom"] * factor.direction[half_rows]
        start = np.append(np.flatnonzero(np.diff(stream.image[half_rows], prepend=-1)), len(half_rows))
        basis = R_cam_body[part] @ factor.bodies.basis[stream.point[half_rows]].transpose(0, 2, 1)
        rows.append(half_rows)
        halves.append(ImagePoints(points[part], uv, start, basis, used[half_rows]))
    return np.concatenate(rows), halves[0], halves[1]


def _in_camera(factor: CornerFactor, state: State, images: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (n,) int in the stream of all corners of the `images` (m,), their points (n, 3) m in the camera frame, and
    R_camera_body (n, 3, 3) for each corner."""
    rows, points, rotations = [], [], []
    for block, X, R in factor.in_camera(state):
        wanted = np.isin(factor.stream.image[block], images)
        rows.append(np.arange(block.start, block.stop)[wanted])
        points.append(X[wanted])
        rotations.append(R[wanted])
    return np.concatenate(rows), np.concatenate(points), np.concatenate(rotations)
