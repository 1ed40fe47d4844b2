"""Parameters over time, against the first calibration."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.tools.fleet.page import care_words, over_time, sensors, verdict_words
from icalib.tools.fleet.result import GroupRecord, Job, JobRecord, JobResult

R0 = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
XYZ = ("x", "y", "z")


def result(day: int, *blocks: GroupRecord, dated: bool = True) -> JobResult:
    time = datetime(2026, 11, day, tzinfo=UTC) if dated else None
    job = Job(f"job{day}", "anton", Path("rig.yaml"), (Path("r"),), time)
    return JobResult(job, JobRecord(job.name, "", 1.0, None, blocks=blocks))


def rotation(turn: list[float], verdict: str = "determined") -> GroupRecord:
    R = R0 @ Rotation.from_rotvec(turn).as_matrix()
    return GroupRecord("cam0", "rotation", XYZ, "rad", R, np.deg2rad([0.1, 0.2, 0.3]), (verdict, "determined", "weak"))


def numbers(
    sensor: str, name: str, labels: tuple[str, ...], value: list[float], verdict: str = "determined"
) -> GroupRecord:
    n = len(value)
    return GroupRecord(sensor, name, labels, "px", np.array(value), np.full(n, 0.5), (verdict,) * n)


def test_rotations_are_turns_about_the_sensors_axes_since_the_first():
    drawn = over_time([result(1, rotation([0, 0, 0])), result(3, rotation(np.deg2rad([1, -2, 0.5]).tolist()))], "cam0")
    assert [t["name"] for t in drawn["data"]] == list(XYZ)
    assert [t["y"] for t in drawn["data"]] == [pytest.approx([0, end], abs=1e-9) for end in (1, -2, 0.5)]
    assert [t["error_y"]["array"] for t in drawn["data"]] == [pytest.approx([s, s]) for s in (0.1, 0.2, 0.3)]
    assert drawn["data"][0]["x"] == ["2026-11-01T00:00:00+00:00", "2026-11-03T00:00:00+00:00"]
    assert drawn["layout"]["xaxis"]["type"] == "date"
    assert drawn["layout"]["yaxis"]["title"]["text"] == "rotation [deg]"


def test_what_is_unobservable_is_hollow_and_has_no_bar():
    drawn = over_time([result(1, rotation([0, 0, 0])), result(3, rotation([0, 0, 0], "unobservable"))], "cam0")
    x, y = drawn["data"][:2]
    assert x["marker"]["symbol"] == ["circle", "circle-open"] and x["error_y"]["array"] == [pytest.approx(0.1), 0.0]
    assert y["marker"]["symbol"] == ["circle", "circle"] and y["error_y"]["array"][1] == pytest.approx(0.2)


def test_each_block_has_a_panel_and_each_name_one_place_in_the_legend():
    blocks = [
        rotation([0, 0, 0]),
        GroupRecord("cam0", "translation", XYZ, "m", np.zeros(3), np.full(3, 1e-3), ("determined",) * 3),
        GroupRecord("cam0", "time_offset", ("time_offset",), "s", np.zeros(1), np.full(1, 1e-3), ("determined",)),
        numbers("cam0", "distortion", ("k1",), [0.1], "fixed"),
        numbers("cam1", "intrinsics", ("fx", "fy"), [1.0, 2.0]),
    ]
    results = [result(1, *blocks), result(2, *blocks)]
    assert sensors(results) == ("cam0", "cam1")
    drawn = over_time(results, "cam0")["data"]
    assert [t["yaxis"] for t in drawn] == ["y"] * 3 + ["y2"] * 3 + ["y3"]
    assert [t["showlegend"] for t in drawn] == [True] * 3 + [False] * 4
    assert drawn[3]["error_y"]["array"] == pytest.approx([1.0, 1.0])  # mm


def test_another_camera_model_is_left_out_and_a_late_sensor_starts_late():
    results = [
        result(1),
        result(2, numbers("cam0", "distortion", ("k1", "k2"), [1.0, 2.0])),
        result(3, numbers("cam0", "distortion", ("xi",), [7.0])),
        result(4, numbers("cam0", "distortion", ("k1", "k2"), [1.5, 2.0])),
    ]
    drawn = over_time(results, "cam0")["data"]
    assert [t["text"] for t in drawn] == [["job2", "job4"]] * 2
    assert [t["y"] for t in drawn] == [[0.0, 0.5], [0.0, 0.0]]


def test_without_times_of_their_own_jobs_stand_in_order():
    one, undated = result(2, rotation([0, 0, 0])), result(1, rotation([0, 0, 0]), dated=False)
    twin = replace(one, job=replace(one.job, name="twin"))
    for other, name in ((undated, "job1"), (twin, "twin")):
        drawn = over_time([one, other], "cam0")
        assert drawn["data"][0]["x"] == ["job2", name] and drawn["layout"]["xaxis"]["type"] == "category"


def test_verdicts_are_counted_the_best_first():
    verdicts = ("not usable", "usable", "usable with care", "usable")
    results = [
        replace(r, record=replace(r.record, verdict=verdict))
        for r, verdict in zip(map(result, range(1, 5)), verdicts, strict=True)
    ]
    failed = replace(results[0], record=replace(results[0].record, failure="no corners."))
    assert verdict_words([*results, failed]) == "2 usable, 1 usable with care, 1 not usable"
    assert care_words(results[0]) == "not usable"
