"""Warns where the camera model of the rig file does not follow the lens, and names a model that does.

Models are compared on held-out images. Each is fitted to every other image, with poses and board shape free. It is
judged by the residuals in the images between, where only poses are fitted.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from icalib.estimation.corner_factor import CornerFactor, CornerOutput
from icalib.estimation.corner_noise import image_speed, residual_noise
from icalib.estimation.estimate import Estimate
from icalib.estimation.state import State
from icalib.geometry.cameras import CAMERA_MODELS, camera_model
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.lens_bundle import ImagePoints, adjust, initial_parameters
from icalib.rig import Rig

MOST_IMAGES = 80  # that are compared, half of them held out; the time is proportional to it
FEWEST_IMAGES = 4  # in each half; with fewer no model is fitted
FEWEST_CORNERS = 8  # in an image; its pose takes up six of their 16 coordinates
BETTER = 0.9  # of the own model's RMS: another that leaves more is not named
EQUAL = 1.1  # times the least RMS: of the models below it the one with fewest parameters is named
SIGN_TEST_SIGMAS = 3.0  # of the number of images that another model fits better; by chance it is half of them


@dataclass(frozen=True)
class _HeldOut:
    """What a fitted model leaves in the M held-out images: squared_error (M,) px^2, the sum over the corners of each
    image; corners: their number in all images."""

    model: CameraModel
    squared_error: np.ndarray
    corners: int

    @property
    def rms(self) -> float:
        """RMS of either component [px]."""
        return float(np.sqrt(0.5 * self.squared_error.sum() / self.corners))


def lens_warnings(rig: Rig, estimate: Estimate) -> Iterator[str]:
    """A sentence for each camera whose estimated lens leaves a large misfit (`ResidualNoise`).

    It names a better model. Where none is clearly better, a sentence appears only if the misfit exceeds the noise.
    """
    outputs, state = estimate.outcome.residuals.corners, estimate.outcome.state
    for camera, factor, out in zip(rig.cameras, estimate.problem.cameras, outputs, strict=True):
        if camera.distortion.mode == "fixed" or not (out.root > 0.0).any():
            continue
        noise = residual_noise(factor, out, rig.settings, image_speed(factor, state))
        if not noise.lens_misfit_is_large:
            continue
        most = float(np.linalg.norm(noise.lens.field, axis=1).max())
        pattern = (
            f"the corners of {camera.name} are off by up to {most:.2g} px, alike wherever in the image they are seen"
        )
        own, best = compare_models(factor, out, state)
        if best is not None and own is not None:
            yield (
                f"{pattern}: {own.model.name} does not follow this lens. In images that had no part in the fit it "
                f"leaves {own.rms:.2g} px, {best.model.name} {best.rms:.2g} px; write `model: {best.model.name}`."
            )
        elif noise.lens.rms > noise.base:
            yield (
                f"{pattern}, and no other camera model follows them clearly better; check that the images are as the "
                "camera took them, and that the target is as the rig file says."
            )


def compare_models(factor: CornerFactor, out: CornerOutput, state: State) -> tuple[_HeldOut | None, _HeldOut | None]:
    """The camera's own model, and the plainest one that is clearly better.

    The first is None where there are too few images, or the own model cannot be fitted to them. The second is None
    where no model is clearly better: by a tenth in RMS, and in more images than chance explains (sign test).
    """
    fitted, held_out = _halves(factor, out, state)
    if fitted is None or held_out is None:
        return None, None
    params = np.concatenate([state.values[factor.name, "intrinsics"], state.values[factor.name, "distortion"]])
    own = _cross_validated(factor.model, [params], fitted, held_out)
    others = []
    for model in (camera_model(name) for name in CAMERA_MODELS if name != factor.model.name):
        starts = list(initial_parameters(model, factor.model, params, fitted))
        if (other := _cross_validated(model, starts, fitted, held_out)) is not None:
            others.append(other)
    if own is None or not others:
        return own, None
    least = min(o.rms for o in others)
    best = min((o for o in others if o.rms <= EQUAL * least), key=lambda o: len(o.model.parameter_names))
    better, n = int((best.squared_error < own.squared_error).sum()), len(own.squared_error)
    # Sign test: `better` has mean n / 2 and standard deviation sqrt(n) / 2 if the models are equally good. The RMS
    # alone may come from a few images.
    by_chance = better - 0.5 * n < 0.5 * SIGN_TEST_SIGMAS * np.sqrt(n)
    return own, best if best.rms < BETTER * own.rms and not by_chance else None


def _cross_validated(
    model: CameraModel, starts: list[np.ndarray], fitted: ImagePoints, held_out: ImagePoints
) -> _HeldOut | None:
    """The model, fitted to the images `fitted` from the best of `starts` (P,), in the images `held_out`.

    None where no start leads to a fit, or a held-out image does not determine its pose.
    """
    fits = []
    for params in starts:
        with suppress(np.linalg.LinAlgError):
            fits.append(adjust(model, params, fitted))
    if not fits:
        return None
    params, shape, _ = min(fits, key=lambda fit: fit[2].sum())
    with suppress(np.linalg.LinAlgError):
        return _HeldOut(model, adjust(model, params, held_out, shape)[2], len(held_out.uv))
    return None


def _halves(factor: CornerFactor, out: CornerOutput, state: State) -> tuple[ImagePoints | None, ImagePoints | None]:
    """The used corners of at most `MOST_IMAGES` images, spread over the recording: every other image, and the rest.

    Points are in the camera frame, by lens and poses of `state`; uv is corrected for bloom. None, None where too few
    images have enough corners.
    """
    stream, used = factor.stream, factor.keep & (out.root > 0.0)
    count = np.bincount(stream.image[used], minlength=len(stream.stamps_ns))
    rich = np.flatnonzero(count >= FEWEST_CORNERS)
    if len(rich) < 2 * FEWEST_IMAGES:
        return None, None
    chosen = rich[np.unique(np.linspace(0, len(rich) - 1, MOST_IMAGES).astype(int))]
    points, R_cam_body = np.empty((len(stream.uv), 3)), np.empty((len(stream.uv), 3, 3))
    for v0, v1 in factor.blocks():
        own = factor.corners_of(v0, v1)
        points[own], of_view = factor.points_in_camera(state, v0, v1)
        R_cam_body[own] = of_view[factor.views.of_corners(v0, v1) - v0]
    uv = stream.uv
    if len(factor.direction):
        uv = uv - state.values[factor.name, "bloom"] * factor.direction
    halves = []
    for own in (chosen[::2], chosen[1::2]):
        rows = np.flatnonzero(used & np.isin(stream.image, own))
        basis = R_cam_body[rows] @ factor.bodies.basis[stream.point[rows]].transpose(0, 2, 1)
        halves.append(ImagePoints(points[rows], uv[rows], np.concatenate([[0], np.cumsum(count[own])]), basis))
    return halves[0], halves[1]
