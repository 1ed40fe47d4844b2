"""Points that a camera followed, in its image and over time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icalib.cli import main
from icalib.pipeline import calibrate_measurements
from icalib.result import by_key
from icalib.sensors.camera.stream import TrackResiduals
from icalib.tools.simulation import load_scenario, rig_for, simulate, with_drawn_guess

EXAMPLE = Path(__file__).parents[3] / "examples" / "paper" / "table2-3d.yaml"


@pytest.fixture(scope="module")
def shown(read, tmp_path_factory):
    """The residuals of cam0, and what the viewer has of the result."""
    scenario = replace(load_scenario(EXAMPLE), duration_s=6.0, sensors=())
    rig = with_drawn_guess(rig_for(scenario), scenario, 1)
    found = calibrate_measurements(rig, simulate(scenario, 1).measurements)
    r = found.track_residuals[0]
    some = np.arange(len(r.uv)) % 100 == 3
    r = replace(r, rejected=some, residual=np.where(some[:, None], np.float32(np.nan), r.residual))
    folder = tmp_path_factory.mktemp("tracks")
    replace(found, residuals=found.residuals | by_key([r])).save(folder / "out")
    assert main(["view", str(folder / "out"), "--save", str(folder / "a.rrd"), "--quiet"]) == 0
    return r, read(folder / "a.rrd")


def test_observations_are_on_the_pixels_that_were_measured(shown: tuple[TrackResiduals, dict]):
    r, found = shown
    rows = found["world/imu0/cam0/image/observations"]
    np.testing.assert_allclose(rows.seconds[np.isfinite(rows.seconds)], r.seconds, atol=1e-9)
    own = slice(r.start[7], r.start[8])
    np.testing.assert_allclose(rows.values["Points2D:positions"][7], r.uv[own] + 0.5, atol=1e-4)
    colors = np.array(rows.values["Points2D:colors"][7])
    np.testing.assert_array_equal(colors == colors[r.rejected[own]][0], r.rejected[own])
    assert "world/imu0/cam0/image/corners" not in found


def test_their_size_is_over_time(shown: tuple[TrackResiduals, dict]):
    r, found = shown
    rows, rms = found["residuals/cam0/observations"], r.rms_of_images
    seconds, rms = r.seconds[np.isfinite(rms)], rms[np.isfinite(rms)]
    moving = np.isfinite(rows.seconds)
    np.testing.assert_allclose(rows.seconds[moving], seconds, atol=1e-9)
    np.testing.assert_allclose(np.array(rows.values["Scalars:scalars"])[:, 0], rms, rtol=1e-12)
    k = int(np.searchsorted(r.seconds, seconds[7]))
    own = slice(r.start[k], r.start[k + 1])
    assert rms[7] == pytest.approx(np.sqrt(np.nanmean(r.residual[own].astype(float) ** 2)))
    assert np.median(rms) == pytest.approx(0.95, abs=0.1)
