"""What is left of points that cameras followed: as numbers, in files, in the report, in studies and in the viewer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.pages import figures_of

from icalib.data.measurements import Measurements, TrackStream
from icalib.pipeline import calibrate_measurements
from icalib.report import report_html
from icalib.result import (
    Calibration,
    by_key,
    load_calibration,
    projection_uncertainty,
    working_distance,
)
from icalib.sensors.camera.stream import TrackResiduals
from icalib.tools.montecarlo.record import whiteness
from icalib.tools.simulation import Scenario, load_scenario, rig_for, simulate, with_drawn_guess

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[3] / "examples" / "paper" / "table2-3d.yaml"
MOVED_PX, EVERY = 40.0, 211  # of some observations


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return replace(load_scenario(EXAMPLE), duration_s=8.0, sensors=())


@pytest.fixture(scope="module")
def seen(scenario: Scenario) -> Measurements:
    """As cameras see it, some observations far off."""
    own = simulate(scenario, 2).measurements
    return own.with_streams(*(_spoilt(t) for t in own.tracks))


def _spoilt(stream: TrackStream) -> TrackStream:
    uv = stream.uv.copy()
    uv[::EVERY, 1] += MOVED_PX
    return replace(stream, uv=uv)


@pytest.fixture(scope="module")
def found(scenario: Scenario, seen: Measurements) -> Calibration:
    rig = with_drawn_guess(rig_for(scenario, intrinsics="free", distortion="free"), scenario, 2)
    return calibrate_measurements(replace(rig, settings=replace(rig.settings, loss="huber", outlier_std=4.0)), seen)


def test_there_is_one_for_each_observation_that_was_given(found: Calibration, seen: Measurements):
    assert [r.sensor for r in found.track_residuals] == [t.name for t in seen.tracks] == ["cam0", "cam1", "cam2"]
    assert found.image_residuals == found.track_residuals
    for r, stream in zip(found.track_residuals, seen.tracks, strict=True):
        np.testing.assert_array_equal(r.uv, stream.uv)
        np.testing.assert_array_equal(r.point, stream.feature)
        np.testing.assert_array_equal(np.diff(r.start), np.diff(stream.start))
        assert 0.9 * len(r.uv) < r.used.sum() < len(r.uv)
        count = next(f.count for f in found.fits if f.sensor == r.sensor and f.kind == "features")
        assert count == 2 * int(r.used.sum())


def test_predicted_pixels_are_those_of_the_points_without_noise(found: Calibration, scenario: Scenario):
    exact = simulate(replace(scenario, robot_noise_enabled=False), 2).measurements.tracks
    for r, stream in zip(found.track_residuals, exact, strict=True):
        np.testing.assert_array_equal(stream.feature, r.point)
        predicted = r.uv + r.residual
        assert np.sqrt(np.mean((predicted - stream.uv)[r.used] ** 2)) < 0.5
        assert np.sqrt(np.mean((r.uv - stream.uv)[r.used] ** 2)) == pytest.approx(1.0, abs=0.03)


def test_what_stands_out_is_rejected_and_has_no_residual(found: Calibration):
    for r in found.track_residuals:
        spoilt = np.zeros(len(r.uv), dtype=bool)
        spoilt[::EVERY] = True
        assert not r.used[spoilt].any() and r.rejected[spoilt].mean() > 0.8  # others were left out with their tracks
        assert r.rejected[~spoilt].mean() < 0.01
        assert not (r.used & r.rejected).any()
        rejected = next(f.rejected for f in found.fits if f.sensor == r.sensor and f.kind == "features")
        assert rejected == int(r.rejected.sum())


def test_they_come_back_from_files_bit_for_bit(found: Calibration, tmp_path: Path):
    found.save(tmp_path)
    for a, b in zip(found.track_residuals, load_calibration(tmp_path).track_residuals, strict=True):
        assert (a.sensor, a.distance) == (b.sensor, b.distance)
        np.testing.assert_array_equal(a.sigma, b.sigma)
        for name in ("seconds", "start", "point", "uv", "residual", "rejected"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_the_distance_is_that_of_what_is_seen(found: Calibration, scenario: Scenario):
    """The room is 12 m by 10 m."""
    for camera in scenario.cameras:
        distance = working_distance(found, camera.name)
        assert distance is not None and 1.5 < distance < 8.0


def test_a_lens_is_known_where_points_were(found: Calibration):
    m = projection_uncertainty(found, "cam0")
    assert m is not None
    assert m.seen.mean() > 0.9
    assert m.median_seen == pytest.approx(np.median(m.sigma[m.seen]))


def test_noise_is_white_and_what_lasts_is_not(found: Calibration):
    own = {(w.sensor, w.kind): w for w in whiteness(found)}
    assert ("cam0", "corners") not in own
    for r in found.track_residuals:
        white = own[r.sensor, "observations"]
        assert abs(white.lag1) < 0.1
        assert white.mean_square == pytest.approx(np.mean(r.whitened[r.used].astype(float) ** 2))
    lasting = replace(found, residuals=found.residuals | by_key(_lasting(r) for r in found.track_residuals))
    assert all(w.lag1 > 0.95 for w in whiteness(lasting) if w.kind == "observations")


def _lasting(r: TrackResiduals) -> TrackResiduals:
    """Each point's error stays for good."""
    own = np.random.default_rng(0).normal(size=(int(r.point.max()) + 1, 2)).astype(np.float32)
    return replace(r, residual=np.where(r.used[:, None], own[r.point], np.nan))


def test_the_report_shows_them(found: Calibration, tmp_path: Path, assert_drawn: Callable[[str, set[str]], None]):
    text = report_html(found)
    (tmp_path / "report.html").write_text(text)
    r = found.track_residuals[0]
    left_out = len(r.uv) - int(r.used.sum()) - int(r.rejected.sum())
    words = f"{int(r.used.sum())} observations used, {int(r.rejected.sum())} rejected"
    assert words + (f", {left_out} left out with their tracks" if left_out else "") in text
    total = sum(len(x.uv) for x in found.track_residuals)
    assert f"with {total} observations of points that were followed" in text and "0 corners" not in text
    assert "cam0 observations (u and v)" in {t["name"] for t in figures_of(text)["histogram"]["data"]}
    assert "like those it saw" in text
    assert_drawn(text, {f"{kind}-{i}" for kind in ("plane", "image", "time") for i in range(3)})
