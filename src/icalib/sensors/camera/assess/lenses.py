"""Warns if the camera model of the rig file does not follow the lens, and names a model that does.

Models are compared by cross-validation. Each model is fitted to half of the images, with poses and board shape free,
and tested on the other half, in which only poses are fitted. Both halves see the places of the image where the misfit
is. All models use the same detected corners: a corner is rejected only if no model explains it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from icalib.base.remark import Remark
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs
from icalib.geometry.cameras import CAMERA_MODELS, camera_model
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.cameras.convert import Adjusted, ImagePoints, adjust, fit_rays, initial_parameters
from icalib.motion.factor import of_type, pairs_of
from icalib.observability.assessor import Cause
from icalib.observability.prior_sensitivity import Relaxed
from icalib.optim.state import Key, State
from icalib.result import ParameterGroup, SensorFit
from icalib.rig import Settings
from icalib.sensors.camera.corner_bias import with_circle_centres
from icalib.sensors.camera.corner_factor import CornerFactor, CornerOutput
from icalib.sensors.camera.corner_noise import (
    LARGE_MISFIT_RATIO,
    ResidualNoise,
    image_flow,
    image_speed,
    rejected,
    residual_noise,
)
from icalib.sensors.camera.spec import INTRINSICS, LENS, Camera
from icalib.sensors.camera.track_factor import FeatureFactor

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
            yield Cause(
                Remark(
                    "lens_misfit_unexplained", f"{misfit}{NO_BETTER_MODEL if current is not None else ''}{CHECK_IMAGES}"
                ),
                gain,
            )


def worst_regions(uv: np.ndarray, field: np.ndarray, resolution: tuple[int, int]) -> str:
    """Names of the fewest of nine image regions whose mean squared misfits are half of the sum of all nine.
    uv (N, 2) px: corners; field (N, 2) px: their misfit; resolution: width and height [px]."""
    column, row = np.clip(3.0 * uv / resolution, 0, 2).astype(int).T
    region = 3 * row + column
    square = np.bincount(region, (field**2).sum(axis=1), 9) / np.maximum(np.bincount(region, minlength=9), 1)
    order = np.argsort(-square)
    count = int(np.searchsorted(square[order].cumsum(), 0.5 * square.sum())) + 1
    return " and ".join(REGIONS[k // 3][k % 3] for k in order[:count])


def _named_model(misfit: str, current: _Trial, best: _Trial, camera: Camera) -> Remark:
    """The sentence about a `misfit` that the model `best` explains."""
    old = " and ".join(name for name in LENS if getattr(camera, name).value is not None)
    remove = f", and remove {old}, of {current.model.name}" if old else ""  # another model has other numbers
    return Remark(
        "lens_model_wrong",
        f"{misfit}: {current.model.name} does not follow this lens. In images that had no part in the fit it leaves "
        f"{current.rms:.2g} px, {best.model.name} {best.rms:.2g} px; write `model: {best.model.name}`{remove}.",
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


# Finds a second set of parameters that describes the same lens.
#
# Some models project alike with two sets of parameters: double-sphere has different pairs of xi and alpha. Standard
# deviations hold only near one set.

MOST_POINTS = 400  # image points at which two lenses are compared
OTHER_FOCAL = 0.02  # relative difference of fx: sets that differ by less count as one
MOST_CHI2 = 16.0  # sum over all observations of the squared difference over the noise: four standard deviations


def ambiguities(inputs: Inputs, estimate: Estimate, fits: Sequence[SensorFit]) -> Iterator[Remark]:
    """One sentence for each camera whose observations fit another set of parameters as well."""
    for camera, factor in zip(inputs.rig.cameras, of_type(estimate.problem.factors, CornerFactor), strict=True):
        fit = next((f for f in fits if f.sensor == camera.name and f.unit == "px" and f.rms), None)
        if camera.intrinsics.mode == "fixed" or camera.distortion.mode == "fixed" or fit is None or not fit.rms:
            continue
        lens, uv = factor.lens(estimate.outcome.state), observed(estimate, factor)
        # `count` counts both coordinates of each point; `rms` is that of one coordinate.
        limit = fit.rms * np.sqrt(MOST_CHI2 / max(0.5 * fit.count, 1.0))
        twin = twin_lens(factor.model, lens, uv, float(limit))
        if twin is not None:
            numbers = ", ".join(f"{n} {x:.4g}" for n, x in zip(factor.model.parameter_names, twin, strict=True))
            yield Remark(
                "second_lens_fits",
                f"{camera.name}: the images fit a second set of parameters of {factor.model.name} as well: {numbers}. "
                "Both are the same lens within the noise; use the parameters of one set together.",
            )


def twin_lens(model: CameraModel, lens: np.ndarray, uv: np.ndarray, limit_px: float) -> np.ndarray | None:
    """(P,) the other set of parameters that projects most like `lens` (P,). None if all differ by more than `limit_px`
    RMS [px] at uv (N, 2) px."""
    uv = uv[:: max(1, len(uv) // MOST_POINTS)]
    rays, valid = model.unproject(lens, uv)
    rays, uv, best = rays[valid], uv[valid], (limit_px, None)
    for distortion in model.start_distortions if len(rays) > len(lens) else ():
        start = np.array([*lens[:4], *distortion])
        start[:2] *= model.central_scale(lens) / model.central_scale(start)
        if 2 * model.project(start, rays)[1].sum() < len(rays):
            continue
        with suppress(np.linalg.LinAlgError):
            other = fit_rays(model, start, rays, uv, 1e-3)
            other_uv, is_projected = model.project(other, rays)
            apart = float(np.sqrt(((other_uv - uv) ** 2).sum(axis=1).mean())) if is_projected.all() else np.inf
            if apart < best[0] and abs(other[0] / lens[0] - 1.0) > OTHER_FOCAL:
                best = apart, other
    return best[1]


def observed(estimate: Estimate, factor: CornerFactor) -> np.ndarray:
    """(N, 2) px: detected corners and used tracked points of a camera."""
    features = of_type(estimate.problem.factors, FeatureFactor)
    pairs = [pair for f in features for pair in zip(f.streams, f.keep, strict=True)]
    tracked_uv = [s.uv[k] for s, k in pairs if s.name == factor.name]
    return np.concatenate([factor.stream.uv, *tracked_uv])


# Tests whether intrinsics that the rig file fixes are those of this camera, by where they would go if free.
#
# Residuals alone do not show it, because the other parameters absorb much of a lens error. With the intrinsics of the
# other camera of a stereo pair, 13 px different, corners may fit to 0.4 px.

OTHER_LENS, CLEARLY = 0.015, 3.0  # least change of an intrinsic parameter: relative to fx, and in standard deviations
NEARER = 0.5  # ratio of the largest differences in fx, fy, cx, cy [px], below which another camera is named


@dataclass(frozen=True)
class _LensStep:
    """step (4,): change of fx, fy, cx, cy [px] from their fixed values to those of the data; std (4,): its formal
    standard deviation [px]."""

    camera: str
    step: np.ndarray
    std: np.ndarray


def wrong_lenses(inputs: Inputs, relaxed_rig: Relaxed | None, factor: float) -> Iterator[Cause]:
    """Cameras whose fixed intrinsics contradict the data, with the gain in chi^2 if they are free.

    factor: the largest empirical factor, which multiplies formal standard deviations. relaxed_rig: see `relaxed`;
    nothing is tested if it is None.
    """
    given = {c.name: c.intrinsics.value for c in inputs.rig.cameras if c.intrinsics.value is not None}
    steps = _lens_steps(inputs, relaxed_rig)
    nearest = {s.camera: _nearest(s, given) for s in steps}
    for s in steps:
        value, other, gain = given[s.camera], nearest[s.camera], float(((s.step / s.std) ** 2).max())
        clearly = np.abs(s.step) > np.maximum(OTHER_LENS * value[0], CLEARLY * factor * s.std)
        if not clearly.any():
            continue
        if nearest.get(other) != s.camera:
            yield Cause(_wrong_words(s, value, clearly, other), gain, True, _lens_keys(s.camera))
        elif s.camera < other:  # said once of both
            yield Cause(swapped_words(s.camera, other), gain, True, _lens_keys(s.camera, other))


def _lens_keys(*cameras: str) -> tuple[Key, ...]:
    return tuple((camera, name) for camera in cameras for name in LENS)


def _nearest(s: _LensStep, given: Mapping[str, np.ndarray]) -> str:
    """The camera whose `given` intrinsics are nearest to those of the data of another; empty if none is near."""
    wanted = given[s.camera] + s.step
    far = {name: float(np.abs(wanted - value).max()) for name, value in given.items()}
    name = min(far, key=lambda n: far[n])
    return name if far[name] < NEARER * np.abs(s.step).max() else ""


def _wrong_words(s: _LensStep, value: np.ndarray, clearly: np.ndarray, other: str) -> Remark:
    """A sentence on fixed intrinsics `value` (4,) that contradict the data; other: the camera that they fit, or
    empty."""
    where = ", ".join(
        f"{name} {old + step:.1f} and not {old:.1f}"
        for name, old, step, far in zip(("fx", "fy", "cx", "cy"), value, s.step, clearly, strict=True)
        if far
    )
    hint = f" Those of {other} are nearer." if other else ""
    return Remark(
        "fixed_intrinsics_wrong",
        f"the intrinsics of {s.camera} that the rig file fixes do not fit its images, which want "
        f"{where}: check that they are this camera's, at this resolution, or leave them free.{hint}",
    )


def _lens_steps(inputs: Inputs, relaxed_rig: Relaxed | None) -> tuple[_LensStep, ...]:
    """Steps of all cameras whose intrinsics are fixed, with the fixed lens parameters of all of them free. Empty if
    `relaxed_rig` is None."""
    fixed = [c for c in inputs.rig.cameras if c.intrinsics.mode == "fixed"]
    if not fixed or relaxed_rig is None:
        return ()
    step, std = relaxed_rig.step([(c.name, name) for c in fixed for name in LENS if getattr(c, name).mode == "fixed"])
    columns = [relaxed_rig.layout.columns(c.name, "intrinsics") for c in fixed]
    return tuple(_LensStep(c.name, step[k], std[k]) for c, k in zip(fixed, columns, strict=True))


def swapped_words(a: str, b: str) -> Remark:
    """A sentence on two cameras that are swapped."""
    return Remark(
        "cameras_swapped",
        f"{a} and {b} seem to be swapped: what the data say of each fits what the rig file gives of the other. Correct "
        "their topics or paths, or the values in the rig file.",
    )


# Whether the guess of a lens is contradicted: by projections, as single coefficients are strongly correlated.

GRID = 12  # rays along each side of an image


def is_far_guess(camera: Camera, name: str, groups_by_key: Mapping[Key, ParameterGroup]) -> bool | None:
    """Whether the guess of the group `name` of the lens projects points farther off than the prior uncertainty of the
    intrinsics; None for other groups."""
    return _lens_off(camera, name, groups_by_key) > INTRINSICS.prior_sigma if name in LENS else None


def _lens_off(camera: Camera, name: str, groups_by_key: Mapping[Key, ParameterGroup]) -> float:
    """RMS shift [px] of projections over the image if the group `name` of the estimated lens is replaced by its
    guess."""
    model, values = camera_model(camera.model), {part: groups_by_key[camera.name, part].value for part in LENS}
    guess = np.concatenate(list((values | {name: getattr(camera, name).value}).values()))
    sides = [np.linspace(0.0, n - 1.0, GRID) for n in camera.resolution]
    uv = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    rays, has_ray = model.unproject(np.concatenate(list(values.values())), uv)
    guess_uv, is_projected = model.project(guess, rays)
    both = has_ray & is_projected
    return float(np.sqrt(np.mean(((guess_uv - uv)[both] ** 2).sum(axis=1)))) if both.any() else np.inf


# Cameras whose resolution in the rig file is larger than their images.

# Principal point over the middle of the stated image. Lenses are centred to a tenth of the image; half the resolution
# (binning, or a scaled stream) gives 0.5.
OFF_CENTRE = 0.75
# Of twice the principal point: observations beyond it show that the image is larger, so that it was cropped.
BEYOND = 1.1
KNOWN = 0.02  # largest standard deviation of the principal point over the size of the image


def wrong_resolutions(inputs: Inputs, estimate: Estimate, groups: Sequence[ParameterGroup]) -> Iterator[Cause]:
    """A grave cause for each camera with a lens that is estimated, whose images seem to be smaller than stated."""
    lenses = {g.sensor: g for g in groups if g.name == "intrinsics" and g.mode != "fixed"}
    for camera, factor in zip(inputs.rig.cameras, of_type(estimate.problem.factors, CornerFactor), strict=True):
        uv, g = observed(estimate, factor), lenses.get(camera.name)
        if g is None or not len(uv):
            continue
        if (size := smaller_image(camera.resolution, g.value[2:4], g.std[2:4], uv)) is not None:
            stated, apparent = (f"{width} x {height}" for width, height in (camera.resolution, size))
            sentence = Remark(
                "resolution_wrong",
                f"the resolution of {camera.name} is wrong: its principal point and all observations are those of "
                f"images of about {apparent} px, not {stated}. Correct its resolution in the rig file.",
            )
            yield Cause(sentence, np.inf, True)


def smaller_image(
    resolution: tuple[int, int], centre: np.ndarray, std: np.ndarray, uv: np.ndarray
) -> tuple[int, int] | None:
    """(width, height) px of the images that the data show, if they are smaller than `resolution`; else None.

    centre, std (2,): principal point and its standard deviations. uv (N, 2): all observations. Units are px."""
    stated, apparent = np.array(resolution), 2.0 * centre + 1.0
    small = (apparent < OFF_CENTRE * stated) & (std < KNOWN * stated) & (uv.max(axis=0) < BEYOND * apparent)
    if not small.any():
        return None
    width, height = np.where(small, apparent, stated).round().astype(int).tolist()
    return width, height
