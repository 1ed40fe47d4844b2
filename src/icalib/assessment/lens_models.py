"""Whether another camera model follows a lens better, where residuals show that the rig file's does not.

Every model is fitted to every other of some images, the poses of these free, and judged by what it leaves in the
images between, in which only the poses are fitted.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from icalib.estimation.corner_factor import CornerFactor, CornerOutput
from icalib.estimation.corner_misfit import lens_misfit
from icalib.estimation.corner_noise import LARGE_MISFIT
from icalib.estimation.estimate import Estimate
from icalib.estimation.medians import median_variance
from icalib.estimation.state import State
from icalib.geometry.cameras import CAMERA_MODELS, camera_model
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.lens_bundle import ImagePoints, adjust, started
from icalib.rig import Rig

IMAGES = 80  # half of them to fit, half to judge
FEWEST_IMAGES, FEWEST_CORNERS = 4, 8  # to fit; of an image: six only tell its pose
CLEARLY = 0.9  # times the error that the model of the rig file leaves
AS_GOOD = 1.1  # times the least error: among such models the one with fewest parameters is named
SIGMAS = 3.0  # of the number of images with smaller errors, by chance half of them


@dataclass(frozen=True)
class _Judged:
    """A model by the squared error (M,) that it leaves in each image that had no part in its fit, of `corners`."""

    model: CameraModel
    square: np.ndarray
    corners: int

    @property
    def rms(self) -> float:
        """Of either component [px]."""
        return float(np.sqrt(0.5 * self.square.sum() / self.corners))


def lens_warnings(rig: Rig, found: Estimate) -> Iterator[str]:
    """A sentence for each camera whose estimated lens leaves a pattern in the image."""
    for camera, factor, out in zip(rig.cameras, found.problem.cameras, found.outcome.residuals.corners, strict=True):
        used = factor.keep & (out.root > 0.0)
        if camera.distortion.mode == "fixed" or not used.any():
            continue
        error = factor.errors(out)
        shown = lens_misfit(factor.stream, error, used)
        noise = np.sqrt(median_variance(((error - shown.field)[used] ** 2).sum(axis=1)))
        if not shown.rms > LARGE_MISFIT * noise:
            continue
        most = float(np.linalg.norm(shown.field, axis=1).max())
        pattern = (
            f"the corners of {camera.name} are off by up to {most:.2g} px, alike wherever in the image they are seen"
        )
        own, best = compare_models(factor, out, found.outcome.state)
        if best is not None and own is not None:
            yield (
                f"{pattern}: {own.model.name} does not follow this lens. In images that had no part in the fit it "
                f"leaves {own.rms:.2g} px, {best.model.name} {best.rms:.2g} px; write `model: {best.model.name}`."
            )
        elif shown.rms > noise:
            yield (
                f"{pattern}, and no other camera model follows them clearly better; check that the images are as the "
                "camera took them, and that the target is as the rig file says."
            )


def compare_models(factor: CornerFactor, out: CornerOutput, state: State) -> tuple[_Judged | None, _Judged | None]:
    """The camera's own model, and the one that clearly fits better. None for what cannot be told."""
    fitted, held_back = _some_images(factor, out, state)
    if fitted is None or held_back is None:
        return None, None
    params = np.concatenate([state.values[factor.name, "intrinsics"], state.values[factor.name, "distortion"]])
    own = _judged(factor.model, [params], fitted, held_back)
    others = [_judged(m, list(started(m, factor.model, params, fitted)), fitted, held_back) for m in _others(factor)]
    judged = [j for j in others if j is not None]
    if own is None or not judged:
        return own, None
    least = min(j.rms for j in judged)
    best = min((j for j in judged if j.rms <= AS_GOOD * least), key=lambda j: len(j.model.parameter_names))
    better, n = int((best.square < own.square).sum()), len(own.square)
    by_chance = better - 0.5 * n < 0.5 * SIGMAS * np.sqrt(n)  # sign test: the gain may be in few images
    return own, best if best.rms < CLEARLY * own.rms and not by_chance else None


def _others(factor: CornerFactor) -> list[CameraModel]:
    return [camera_model(name) for name in CAMERA_MODELS if name != factor.model.name]


def _judged(
    model: CameraModel, starts: list[np.ndarray], fitted: ImagePoints, held_back: ImagePoints
) -> _Judged | None:
    """None where no start leads to a fit."""
    found = []
    for params in starts:
        with suppress(np.linalg.LinAlgError):
            found.append(adjust(model, params, fitted))
    if not found:
        return None
    params, shape, _ = min(found, key=lambda fit: fit[2].sum())
    with suppress(np.linalg.LinAlgError):
        return _Judged(model, adjust(model, params, held_back, shape)[2], len(held_back.uv))
    return None


def _some_images(
    factor: CornerFactor, out: CornerOutput, state: State
) -> tuple[ImagePoints | None, ImagePoints | None]:
    """Corners of every other of some images, and of those between; in the camera frame, by the estimate."""
    stream, used = factor.stream, factor.keep & (out.root > 0.0)
    count = np.bincount(stream.image[used], minlength=len(stream.stamps_ns))
    rich = np.flatnonzero(count >= FEWEST_CORNERS)
    if len(rich) < 2 * FEWEST_IMAGES:
        return None, None
    chosen = rich[np.unique(np.linspace(0, len(rich) - 1, IMAGES).astype(int))]
    points, turn = np.empty((len(stream.uv), 3)), np.empty((len(stream.uv), 3, 3))
    for v0, v1 in factor.blocks():
        own = factor.corners_of(v0, v1)
        points[own], R_cam_body = factor.points_in_camera(state, v0, v1)
        turn[own] = R_cam_body[factor.views.of_corners(v0, v1) - v0]
    uv = stream.uv
    if len(factor.direction):
        uv = uv - state.values[factor.name, "bloom"] * factor.direction
    halves = []
    for own in (chosen[::2], chosen[1::2]):
        rows = np.flatnonzero(used & np.isin(stream.image, own))
        basis = turn[rows] @ factor.bodies.basis[stream.point[rows]].transpose(0, 2, 1)
        halves.append(ImagePoints(points[rows], uv[rows], np.concatenate([[0], np.cumsum(count[own])]), basis))
    return halves[0], halves[1]
