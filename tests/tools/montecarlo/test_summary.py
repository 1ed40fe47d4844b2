"""What a study says, on records that were made up."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from icalib.tools.montecarlo.record import Identity, RunRecord, Size, from_json, to_json
from icalib.tools.montecarlo.summary import (
    Consistency,
    answer,
    consistency_json,
    largest_words,
    study_html,
    summarise,
    unobservable_words,
    verdict_words,
)

KEYS = ("cam0.rotation", "cam0.time_offset", "cam0.distortion", "cam1.rotation", "cam1.distortion", "wheel0.radii")


def block(found: Consistency, key: str):
    return next(b for b in found.blocks if b.key == key)


def test_records_come_back_bit_for_bit(record):
    one = record(3)
    again = from_json(to_json(one))
    assert to_json(again) == to_json(one)
    np.testing.assert_array_equal(again.covariance, one.covariance)
    np.testing.assert_array_equal(again.path[1].std, one.path[1].std)
    assert again.blocks == one.blocks and again.sizes == one.sizes and again.whiteness == one.whiteness
    failed = RunRecord(4, "it broke.", 1.0, "digest")
    assert to_json(from_json(to_json(failed))) == to_json(failed)


def test_blocks_by_their_obvious_formulas(record):
    runs = [record(seed) for seed in range(40)]
    found = summarise(runs)
    assert tuple(b.key for b in found.blocks) == KEYS
    radii = block(found, "wheel0.radii")
    errors = np.array([r.error[11:] for r in runs])
    variances = np.array([np.diag(r.covariance)[11:] for r in runs])
    squared = [r.error[11:] @ np.linalg.inv(r.covariance[11:, 11:]) @ r.error[11:] for r in runs]
    assert (radii.dimension, radii.runs, radii.unit) == (2, 40, "m")
    assert radii.nees is not None and radii.nees.mean == pytest.approx(sum(squared) / 80)
    assert radii.rmse == pytest.approx(np.sqrt(np.mean(errors**2)))
    assert radii.mean_sigma == pytest.approx(np.sqrt(np.mean(variances)))
    right = radii.entries[1]
    assert right.rmse == pytest.approx(np.sqrt(np.mean(errors[:, 1] ** 2)))
    assert right.mean_sigma == pytest.approx(np.sqrt(np.mean(variances[:, 1])))
    whole = [r.error @ np.linalg.solve(r.covariance, r.error) for r in runs]
    assert found.whole is not None and found.whole.mean == pytest.approx(sum(whole) / (40 * 13), rel=1e-6)


def test_honest_records_are_called_so_and_optimistic_ones_are_not(record):
    honest = summarise([record(seed) for seed in range(60)])
    assert all(b.nees is not None and b.nees.low < b.nees.mean < 1.15 * b.nees.high for b in honest.blocks)
    optimistic = summarise([record(seed, optimism=1.5) for seed in range(60)])
    assert not any(b.nees.consistent for b in optimistic.blocks if b.nees is not None)
    assert "outside: cam0.rotation, cam0.time_offset" in answer(optimistic)


def test_order_of_records_does_not_matter(record):
    runs = [record(seed) for seed in range(8)]
    assert consistency_json(summarise(runs[::-1]), {}) == consistency_json(summarise(runs), {})


def test_unobservable_entries_stay_out(record: Callable[..., RunRecord], judged):
    runs = [record(seed) for seed in range(30)]
    spoilt = [replace(r, error=r.error * np.r_[np.ones(11), 1e6, 1.0]) for r in runs]
    found = summarise([judged(r, "wheel0.radii", ("unobservable", "weak")) for r in spoilt])
    radii = block(found, "wheel0.radii")
    alone = [(r.error[12] ** 2, r.covariance[12, 12]) for r in runs]
    assert radii.dimension == 1
    assert radii.nees is not None and radii.nees.mean == pytest.approx(np.mean([e / v for e, v in alone]))
    assert radii.rmse == pytest.approx(np.sqrt(np.mean([e for e, _ in alone])))
    assert radii.entries[0].runs == 0 and radii.entries[0].rmse is None
    assert radii.entries[0].verdicts == {"unobservable": 30}
    assert found.unobservable == {"wheel0 radii left": 30}
    assert unobservable_words(found) == ["30 of 30 runs: wheel0 radii left"]
    assert verdict_words(radii) == "left: 30 unobservable; right: 30 weak"
    assert found.whole is not None and found.whole.mean < 2.0


def test_a_block_may_be_unobservable_in_some_runs_or_all(record, judged):
    both = ("unobservable", "unobservable")
    some = summarise([judged(record(0), "wheel0.radii", both), record(1), record(2), record(3)])
    assert block(some, "wheel0.radii").runs == 3
    none = summarise([judged(record(seed), "wheel0.radii", both) for seed in range(3)])
    assert block(none, "wheel0.radii").nees is None and block(none, "wheel0.radii").dimension == 0
    assert json.loads(consistency_json(none, {}))["blocks"][-1]["nees"] is None


def test_failed_runs_are_listed_and_do_not_count(record):
    runs = [record(seed) for seed in range(5)]
    far = replace(record(7), failure="the solver did not converge: it stopped.", error=np.full(13, 1e3))
    failed = RunRecord(6, "no camera saw the target.", 1.0, "digest")
    found = summarise([far, *runs, failed])
    assert [(f.seed, f.sentence) for f in found.failures] == [
        (6, "no camera saw the target."),
        (7, "the solver did not converge: it stopped."),
    ]
    assert found.runs == 7
    assert found.blocks == summarise(runs).blocks


def test_a_study_may_fail_altogether():
    found = summarise([RunRecord(0, "no camera saw the target.", 1.0, "digest")])
    assert (found.whole, found.blocks) == (None, ())
    assert answer(found) == "No run reached a result."


def test_figures_of_residuals_are_means_with_their_standard_error(record):
    found = summarise([record(seed) for seed in range(1, 5)])
    assert [(m.sensor, m.kind) for m in found.sizes] == [("cam0", "corners")]  # a gyroscope without freedom has none
    ratios = 1.0 + np.arange(1, 5) / 990.0
    assert found.sizes[0].mean == pytest.approx(ratios.mean())
    assert found.sizes[0].standard_error == pytest.approx(ratios.std(ddof=1) / 2.0)
    assert found.lag1[0].mean == pytest.approx(0.025)
    assert found.lag1[0].standard_error == pytest.approx(0.01 * np.std([1, 2, 3, 4], ddof=1) / 2.0)


def test_sizes_weigh_runs_by_their_degrees_of_freedom(record):
    few, many = Size("cam0", "corners", 10, 1.0, 4.0), Size("cam0", "corners", 100, 99.0, 96.0)
    runs = [replace(record(seed), sizes=(size,)) for seed, size in enumerate((few, many))]
    assert summarise(runs).sizes[0].mean == pytest.approx(1.0)


def test_the_largest_error_is_of_what_counts(record, judged):
    runs = [record(seed) for seed in range(20)]
    z = np.array([r.error / np.sqrt(np.diag(r.covariance)) for r in runs])
    spoilt = [replace(r, error=r.error * np.r_[np.ones(11), 1e6, 1.0]) for r in runs]
    open_left = [judged(r, "wheel0.radii", ("unobservable", "determined")) for r in spoilt]
    found = summarise([*open_left, RunRecord(99, "it broke.", 1.0, "digest")])
    counted = np.abs(np.delete(z, 11, axis=1))
    assert found.largest is not None and found.largest.sigmas == pytest.approx(counted.max())
    assert (found.largest.seed, found.largest.numbers) == (int(counted.max(axis=1).argmax()), 20 * 12)
    assert f"of 240 numbers is {counted.max():.1f} standard deviations ({found.largest.entry}," in largest_words(found)
    wrong = summarise(
        [replace(r, error=r.error + 9.0 * np.sqrt(np.diag(r.covariance)) * (np.arange(13) == 3)) for r in runs]
    )
    assert wrong.largest is not None and wrong.largest.entry == "cam0.time_offset"
    assert "less than 1 of 100 studies" in largest_words(wrong)
    assert summarise([]).largest is None and largest_words(summarise([])) == "No number was determined in any run."


def test_on_the_page_each_figure_stands_under_its_heading(record, judged, assert_drawn):
    runs = [judged(record(seed), "wheel0.radii", ("unobservable", "weak")) for seed in range(5)]
    page = study_html(summarise(runs), Identity("s.yaml", "0", "none", "known", "digest", {}), runs)
    marks = ["<h2>Blocks", "The largest error of", "<b>Mean NEES", 'id="nees"', "<h3>Unobservable", "<h3>Failed runs"]
    assert [page.index(m) for m in marks] == sorted(page.index(m) for m in marks)
    assert_drawn(page, {"nees"})
