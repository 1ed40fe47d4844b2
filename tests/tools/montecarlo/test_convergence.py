"""Curves of error and 3 sigma against iterations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.tools.montecarlo.record import RunRecord
from icalib.tools.montecarlo.reproduce import plotly_figure, png, rows


def test_curves_are_the_errors_of_the_path_in_shown_units(record):
    one = record(0)
    row = next(r for r in rows([one]) if r.key == "wheel0.radii")
    panel = row.panels[1]
    assert (panel.title, panel.unit) == ("wheel0 radii right", "mm")
    assert panel.curves[0].error == pytest.approx(1e3 * np.abs([w.error[12] for w in one.path]))
    assert panel.curves[0].bound == pytest.approx(3e3 * np.sqrt([one.covariance[12, 12]] * 2))


def test_first_six_good_runs_of_all_sensors_but_further_cameras(record):
    runs = [replace(record(1), failure="it did not converge."), *(record(seed) for seed in range(2, 10))]
    found = rows(runs)
    assert [r.key for r in found] == ["cam0.rotation", "cam0.time_offset", "cam0.distortion", "wheel0.radii"]
    assert [c.seed for c in found[0].panels[0].curves] == [2, 3, 4, 5, 6, 7]
    assert rows([RunRecord(0, "it broke.", 1.0, "digest")]) == ()


def test_what_is_unobservable_has_the_bound_of_the_result(record, judged):
    one = judged(record(0), "wheel0.radii", ("unobservable", "determined"))
    path = tuple(replace(w, std=np.zeros(13)) for w in one.path)
    panel = rows([replace(one, path=path), record(1)])[-1].panels[0]
    assert panel.title == "wheel0 radii left (unobservable in 1 of 2)"
    assert panel.curves[0].bound == pytest.approx(3e3 * np.sqrt([one.covariance[11, 11]] * 2))


def test_what_is_owed_to_the_guess_is_in_every_bound(record):
    """A camera's x and y follow its height, which nobody knows: in the plane they are off by five formal deviations."""
    one, formal = record(0), np.zeros((2, 13))
    formal[:, 12] = np.sqrt(one.covariance[12, 12]) * np.array([0.8, 0.6])
    path = tuple(replace(w, std=std) for w, std in zip(one.path, formal, strict=True))
    bound = rows([replace(one, path=path)])[-1].panels[1].curves[0].bound
    assert bound == pytest.approx(3e3 * np.sqrt(one.covariance[12, 12] * np.array([0.64 + 0.64, 1.0])))


def test_figures_hold_a_line_and_a_bound_for_each_run_and_entry(record):
    found = rows([record(seed) for seed in range(3)])
    drawn = plotly_figure(found[0])
    assert len(drawn["data"]) == 2 * 3 * 3
    assert {t["xaxis"] for t in drawn["data"]} == {"x", "x2", "x3"}
    assert drawn["data"][0]["y"] == pytest.approx(found[0].panels[0].curves[0].error, rel=1e-4)
    assert drawn["layout"]["yaxis3"]["type"] == "log"
    assert png(found, "Title").startswith(b"\x89PNG")


def test_an_error_of_zero_is_a_gap_on_a_logarithmic_axis(record):
    one = record(0)
    path = (replace(one.path[0], error=np.zeros(13)), one.path[1])
    drawn = plotly_figure(rows([replace(one, path=path)])[0])
    assert drawn["data"][0]["y"][0] is None
