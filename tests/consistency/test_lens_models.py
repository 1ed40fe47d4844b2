"""Rigs whose camera model does not follow the lens: its place rejects no corner, and a better model is named."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from tests.remarks import named

from icalib.base.remark import Remark
from icalib.data.measurements import CornerStream, Measurements
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Rig
from icalib.sensors.camera.assess import lenses
from icalib.tools.simulation import handheld, rig_for, simulate

WIDE = ("eucm", (430.0, 429.0, 371.0, 245.0), (0.62, 1.09))
NARROW = ("pinhole-radtan", (458.7, 457.3, 367.2, 248.4), (-0.28, 0.07, 2e-4, 2e-5))


def stills(
    lens: tuple, model: str, seed: int, outliers: float = 0.0, images: int = 40
) -> tuple[Rig, Measurements, np.ndarray]:
    """A camera with `lens` alone before a board, some images, noise of 0.2 px; a rig file with `model`. The last: which
    corners are gross outliers."""
    scenario = handheld(20.0)
    camera = dataclasses.replace(scenario.cameras[0], model=lens[0], intrinsics=lens[1], distortion=lens[2])
    motion = dataclasses.replace(scenario.motion, distance_m=0.4)
    simulation = simulate(dataclasses.replace(scenario, cameras=(camera,), motion=motion), seed)
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    own = dataclasses.replace(rig.cameras[0], model=model, corner_noise_px=None)
    settings = dataclasses.replace(rig.settings, loss="huber", outlier_std=4.0)
    whole = simulation.measurements.cameras[0]
    kept = np.linspace(0, len(whole.stamps_ns) - 1, images).astype(int)
    rows = np.isin(whole.image, kept)
    uv, rng = whole.uv[rows], np.random.default_rng(seed)
    wrong = rng.random(len(uv)) < outliers
    angle, size = rng.uniform(0.0, 2.0 * np.pi, int(wrong.sum())), rng.uniform(4.0, 40.0, int(wrong.sum()))
    uv[wrong] += size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    start = np.concatenate([[0], np.cumsum(np.diff(whole.start)[kept])])
    stream = CornerStream("cam0", whole.stamps_ns[kept], start, whole.point[rows], uv)
    rig = rig.with_(imu=None, cameras=(own,), settings=settings)
    return rig, Measurements.of_streams(stream), wrong


def pattern_of(result: Calibration) -> list[Remark]:
    return [w for w in result.warnings if w.name in ("lens_model_wrong", "lens_misfit_unexplained")]


def test_where_the_model_does_not_follow_the_lens_another_is_named():
    rig, measurements, _ = stills(WIDE, "pinhole-radtan", 1)
    result = calibrate_measurements(rig, measurements)
    (words,) = pattern_of(result)
    assert words.name == "lens_model_wrong" and "`model: eucm`" in words and ": pinhole-radtan " in words
    (residuals,) = result.corner_residuals
    size = np.linalg.norm(residuals.residual, axis=1)
    assert (size > 1.0).sum() > 400  # five times the noise and more, and yet:
    assert residuals.rejected.sum() <= 5
    # The model that is named leaves the noise, and then there is nothing to say.
    named = rig.with_(cameras=(dataclasses.replace(rig.cameras[0], model="eucm"),))
    better = calibrate_measurements(named, measurements)
    assert not pattern_of(better)
    assert better.fits[-1].rms == pytest.approx(0.2, rel=0.05)


@pytest.mark.parametrize(
    ("lens", "model"), [(NARROW, "pinhole-radtan"), pytest.param(WIDE, "eucm", marks=pytest.mark.full)]
)
def test_gross_outliers_are_rejected_with_a_note(lens: tuple, model: str):
    rig, measurements, wrong = stills(lens, model, 2, outliers=0.02)
    result = calibrate_measurements(rig, measurements)
    (residuals,) = result.corner_residuals
    assert (wrong & ~residuals.rejected).sum() == 0
    assert (residuals.rejected & ~wrong).sum() <= 2
    count = int(residuals.rejected.sum())
    assert f"cam0: {count} of {len(wrong)} corners" in named("corners_rejected", result.notes)
    for name, truth in (("intrinsics", lens[1]), ("distortion", lens[2])):
        group = result.group("cam0", name)
        assert np.abs((group.value - np.array(truth)) / group.std_formal).max() < 4.0
    assert not pattern_of(result)


@pytest.mark.full
def test_outliers_beside_an_error_of_the_lens_are_rejected_and_the_rest_is_not():
    rig, measurements, wrong = stills(WIDE, "pinhole-radtan", 3, outliers=0.02)
    result = calibrate_measurements(rig, measurements)
    (residuals,) = result.corner_residuals
    assert (residuals.rejected & ~wrong).sum() <= 5
    assert (wrong & ~residuals.rejected).sum() <= 0.06 * wrong.sum()
    assert "write `model: eucm`" in pattern_of(result)[0]


def test_where_no_model_follows_none_is_named_but_the_region_is():
    """A drop of water on the glass, of 60 px, moves corners by up to 8 px."""
    rig, measurements, _ = stills(NARROW, "pinhole-radtan", 1)
    (stream,) = measurements.cameras
    near = np.exp(-((stream.uv - [560.0, 150.0]) ** 2).sum(axis=1) / (2.0 * 60.0**2))
    uv = stream.uv + near[:, None] * [6.0, 3.0]
    result = calibrate_measurements(rig, Measurements.of_streams(dataclasses.replace(stream, uv=uv)))
    (words,) = pattern_of(result)
    assert "top right corner" in words and "no other camera model follows them clearly better" in words
    assert "write `model" not in words


def test_models_are_compared_by_the_corners_of_the_detector(monkeypatch):
    """Neither the correction of bent edges by the own lens nor the corners that it rejects favour the own model."""
    rig, measurements, wrong = stills(WIDE, "pinhole-radtan", 4, outliers=0.01, images=24)
    (stream,) = measurements.cameras
    edges = np.tile(np.array([-30.0, 0.0, 30.0, 0.0, 0.0, 60.0, 0.0], dtype=np.float32), (len(stream.uv), 2, 1))
    measurements = Measurements.of_streams(dataclasses.replace(stream, edges=edges))
    given = []
    monkeypatch.setattr(lenses, "compare_models", lambda *args: given.append(args) or (None, None))
    result = calibrate_measurements(rig, measurements)
    ((factor, out, state, settings, noise),) = given
    np.testing.assert_array_equal(factor.stream.uv, stream.uv)
    monkeypatch.undo()
    all_own, all_best = lenses.compare_models(factor, out, state, settings, noise)
    assert all_own is not None and all_best is not None
    (residuals,) = result.corner_residuals
    size = np.linalg.norm(residuals.residual, axis=1)
    large = size > np.quantile(size, 0.8)  # as if the own model had rejected what it cannot follow
    root = np.where(large, 0.0, out.root)
    own, best = lenses.compare_models(factor, dataclasses.replace(out, root=root), state, settings, noise)
    for fewer, whole in ((own, all_own), (best, all_best)):
        assert fewer is not None
        assert fewer.model is whole.model
        assert fewer.rms == pytest.approx(whole.rms, rel=0.02)
        assert fewer.corners >= 0.995 * whole.corners
    assert all_own.corners <= len(wrong) - 0.9 * wrong.sum()
    assert all_best.model.name == "eucm" and all_best.rms == pytest.approx(0.2, rel=0.1)
