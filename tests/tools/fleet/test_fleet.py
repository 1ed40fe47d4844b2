"""A fleet whose results are known: what is done, done again, kept, written and said."""

from __future__ import annotations

import dataclasses
import os
import shutil
import sqlite3
from contextlib import closing
from itertools import count
from pathlib import Path

import pytest

from icalib.base.files import COMMIT
from icalib.cli import main
from icalib.errors import CalibrationError
from icalib.geometry.so3 import rpy, rpy_std
from icalib.result import joint_covariance, load_calibration
from icalib.tools.fleet import Fleet, run_fleet
from icalib.tools.fleet import run as run_module
from icalib.tools.fleet.result import from_json, to_json

NAMES = ["anton-r0", "anton-turned", "berta-r0", "berta-r1"]
BAD = "  - {robot: berta, recording: bad, time: 2026-10-09}\n"


def fleet(folder: Path, **options) -> Fleet:
    return run_fleet(folder / "JOBS.yaml", folder / "out", **options)


def written(folder: Path) -> dict[str, int]:
    files = sorted((folder / "out" / "jobs").glob("*/*"))
    return {str(f.relative_to(folder / "out" / "jobs")): f.stat().st_mtime_ns for f in files}


def query(folder: Path, text: str) -> list[tuple]:
    with closing(sqlite3.connect(folder / "out" / "fleet.sqlite")) as base:
        return base.execute(text).fetchall()


def add(folder: Path, text: str) -> None:
    with (folder / "JOBS.yaml").open("a") as file:
        file.write(text)


def test_each_job_leaves_its_whole_result(fleet_folder: Path, workshop, same):
    found = fleet(fleet_folder)
    assert [r.job.name for r in found.results] == NAMES == workshop.done and found.failed == ()
    for name in NAMES:
        place = fleet_folder / "out" / "jobs" / name
        assert {"calibration.yaml", "report.html", "fleet-job.json"} <= {f.name for f in place.iterdir()}
        assert same(load_calibration(place).groups, workshop.results[name.split("-")[1]].groups)
    assert sorted(f.name for f in (fleet_folder / "out").iterdir()) == [".lock", "fleet.html", "fleet.sqlite", "jobs"]
    assert [d.robot for d in found.drifted] == ["anton"] and found.drifted[0].sensors == ("cam1",)


def test_finished_jobs_are_not_done_again(fleet_folder: Path, workshop):
    fleet(fleet_folder)
    before, page = written(fleet_folder), (fleet_folder / "out" / "fleet.html").read_bytes()
    found = fleet(fleet_folder)
    assert len(workshop.done) == 4 and found.again == {} and written(fleet_folder) == before
    assert (fleet_folder / "out" / "fleet.html").read_bytes() == page
    add(fleet_folder, "  - {robot: anton, recording: r1}\n")
    fleet(fleet_folder)
    assert workshop.done[4:] == ["anton-r1"] and {n: written(fleet_folder)[n] for n in before} == before


def test_what_only_names_a_job_does_not_do_it_again(fleet_folder: Path, workshop):
    fleet(fleet_folder)
    text = (fleet_folder / "JOBS.yaml").read_text().replace("robot: berta, ", "name: berta-r1, robot: bertha, ", 2)
    (fleet_folder / "JOBS.yaml").write_text(text.replace("name: berta-r1", "name: berta-r0", 1))
    found = fleet(fleet_folder)
    assert len(workshop.done) == 4 and [d.robot for d in found.drifts] == ["anton", "bertha"]


def test_changed_inputs_do_a_job_again_and_say_so(fleet_folder: Path, workshop, monkeypatch):
    fleet(fleet_folder)
    said: list[str] = []
    (fleet_folder / "r1").unlink()
    shutil.copytree(workshop_recording(fleet_folder), fleet_folder / "r1")
    found = fleet(fleet_folder, say=said.append)
    assert workshop.done[4:] == ["berta-r1"] and found.again == {"berta-r1": "the recording changed"}
    assert said == ["berta-r1 is calibrated again: the recording changed."]
    os.utime(fleet_folder / "r1" / "cam0" / "corners.csv", ns=(1, 1))
    assert fleet(fleet_folder).again == {"berta-r1": "the recording changed"}
    with (fleet_folder / "rig.yaml").open("a") as file:
        file.write("# by hand\n")
    assert fleet(fleet_folder).again == dict.fromkeys(NAMES, "the rig file changed")
    monkeypatch.setattr("icalib.tools.fleet.result.program", lambda: "another")
    assert fleet(fleet_folder).again == dict.fromkeys(NAMES, "icalib changed")
    assert len(workshop.done) == 4 + 1 + 1 + 4 + 4 and fleet(fleet_folder).again == {}


def workshop_recording(folder: Path) -> Path:
    """With other times of change, and one file more."""
    copy = folder / "copy"
    shutil.copytree(folder / "r0", copy)
    (copy / "notes.txt").write_text("a new file")
    return copy


def test_a_failed_job_is_kept_with_its_sentence_and_others_go_on(fleet_folder: Path, workshop, capsys):
    add(fleet_folder, BAD)
    arguments = ["fleet", str(fleet_folder / "JOBS.yaml"), "-o", str(fleet_folder / "out")]
    assert main(arguments) == 1
    out = capsys.readouterr().out
    assert "5 jobs of 2 robots: 4 calibrated, 1 failed. Changed over time: anton (cam1)." in out
    assert "Failed: berta-bad: bad is cut off; record <again>." in out
    assert "Changed: anton, anton-r0 to anton-turned: cam1 turned by 0.0" in out
    assert list((fleet_folder / "out" / "jobs" / "berta-bad").iterdir())[0].name == "fleet-job.json"
    assert query(fleet_folder, "SELECT * FROM results WHERE status = 'failed'") == [
        ("berta", "2026-10-09T00:00:00+00:00", "berta-bad", "failed", "bad is cut off; record <again>.", *[None] * 8)
    ]
    assert main([*arguments, "--quiet"]) == 1 and len(workshop.done) == 5
    assert capsys.readouterr().out == ""
    page = (fleet_folder / "out" / "fleet.html").read_text()
    assert "bad is cut off; record &lt;again&gt;." in page
    workshop.results = workshop.results | {"bad": workshop.results["r0"]}
    (fleet_folder / "bad").symlink_to(fleet_folder / "r0")
    assert main(arguments) == 0
    assert "berta-bad is calibrated again: the recording changed." in capsys.readouterr().out


def test_a_failure_leaves_no_result_of_before(fleet_folder: Path, workshop):
    fleet(fleet_folder)
    workshop.results = {k: c for k, c in workshop.results.items() if k != "r1"}
    (fleet_folder / "r1").unlink()
    fleet(fleet_folder)
    assert [f.name for f in (fleet_folder / "out" / "jobs" / "berta-r1").iterdir()] == ["fleet-job.json"]


def test_a_solver_that_did_not_converge_is_a_failed_job_with_its_result(fleet_folder: Path, workshop):
    workshop.change = lambda job, c: (
        dataclasses.replace(c, converged=False, status="it went on and on.") if job == "anton-turned" else c
    )
    found = fleet(fleet_folder)
    assert [r.sentence for r in found.failed] == ["the solver did not converge: it went on and on."]
    assert found.drifted == () and found.drifts[0].jobs == ("anton-r0",)
    assert query(fleet_folder, "SELECT DISTINCT job, sensor FROM results WHERE status = 'failed'")
    assert (fleet_folder / "out" / "jobs" / "anton-turned" / "report.html").exists()


def test_a_result_that_was_taken_away_is_made_again(fleet_folder: Path, workshop):
    fleet(fleet_folder)
    shutil.rmtree(fleet_folder / "out" / "jobs" / "anton-r0")
    (fleet_folder / "out" / "jobs" / "berta-r0" / "result.json").unlink()
    fleet(fleet_folder)
    assert workshop.done[4:] == ["anton-r0", "berta-r0"]


def test_a_set_that_was_cut_off_in_its_move_counts_and_is_put_in_place(fleet_folder: Path, workshop):
    fleet(fleet_folder)
    place = fleet_folder / "out" / "jobs" / "anton-r0"
    (place / COMMIT).mkdir()
    for name in ("fleet-job.json", "result.json"):
        (place / name).rename(place / COMMIT / name)
    fleet(fleet_folder)
    assert len(workshop.done) == 4 and not (place / COMMIT).exists() and (place / "result.json").exists()


def test_damaged_files_are_named(fleet_folder: Path, workshop):
    fleet(fleet_folder)
    place = fleet_folder / "out" / "jobs" / "anton-r0"
    (place / "result.npz").write_bytes(b"")
    found = fleet(fleet_folder)
    assert "result.npz is truncated" in found.drifts[0].notes[0] and found.drifted == ()
    for content in (b"", b"{}", b'{"format": 1}', b"[]"):
        (place / "fleet-job.json").write_bytes(content)
        with pytest.raises(CalibrationError, match=r"fleet-job\.json is damaged; delete it to run the job again"):
            fleet(fleet_folder)


def test_interrupted_it_says_what_is_there(fleet_folder: Path, workshop, capsys):
    workshop.interrupt = 3
    arguments = ["fleet", str(fleet_folder / "JOBS.yaml"), "-o", str(fleet_folder / "out")]
    assert main(arguments) == 130
    place = fleet_folder / "out"
    said = f"icalib: interrupted; 3 of 4 jobs are in {place}; the same command resumes.\n"
    assert capsys.readouterr().err == said
    workshop.interrupt = None
    assert main(arguments) == 0 and workshop.done == NAMES


def test_a_job_that_killed_its_workers_is_reported_and_tried_again_the_next_time(
    fleet_folder: Path, workshop, monkeypatch
):
    from icalib.tools.batch import FailedTask

    def lose(work, tasks, crew):
        yield from ((task, FailedTask("its worker died again and again; give it more memory.")) for task in tasks)

    with monkeypatch.context() as patch:
        patch.setattr(run_module, "run_all", lose)
        assert len(fleet(fleet_folder).failed) == 4
    assert fleet(fleet_folder).failed == () and len(workshop.done) == 4


def test_another_icalib_on_a_worker_is_refused(fleet_folder: Path, workshop, monkeypatch):
    programs = (f"program {k}" for k in count())  # another one wherever it is asked for
    monkeypatch.setattr("icalib.tools.fleet.result.program", lambda: next(programs))
    with pytest.raises(CalibrationError, match="a worker of the cluster runs another version of icalib"):
        fleet(fleet_folder)


def test_the_table_holds_every_entry_of_every_job(fleet_folder: Path, workshop):
    fleet(fleet_folder)
    c = workshop.results["turned"]
    g = c.group("cam1", "translation")
    rows = query(
        fleet_folder,
        "SELECT robot, time, status, sentence, entry, value, sigma, unit, verdict FROM results "
        "WHERE job = 'anton-turned' AND sensor = 'cam1' AND block = 'translation'",
    )
    about = ("anton", "2026-10-08T00:00:00+00:00", "done", c.status)
    expected = zip("xyz", g.value.tolist(), g.std.tolist(), g.verdict, strict=True)
    assert rows == [(*about, entry, value, std, "m", verdict) for entry, value, std, verdict in expected]
    turns = query(
        fleet_folder,
        "SELECT entry, value, sigma, unit, verdict FROM results WHERE job = 'berta-r0' AND block = 'rotation' "
        "AND sensor = 'cam0'",
    )
    c = workshop.results["r0"]
    g = c.group("cam0", "rotation")
    angles, std = rpy(g.value).tolist(), rpy_std(g.value, joint_covariance(c, [g])).tolist()
    assert turns[:3] == [(*x, "rad", None) for x in zip(("roll", "pitch", "yaw"), angles, std, strict=True)]
    assert turns[3:] == [(a, None, s, "rad", v) for a, s, v in zip("xyz", g.std.tolist(), g.verdict, strict=True)]
    counted = query(fleet_folder, "SELECT job, count(*) FROM results GROUP BY job ORDER BY job")
    assert [name for name, _ in counted] == NAMES and len({n for _, n in counted}) == 1
    assert ("time_offset",) in query(fleet_folder, "SELECT DISTINCT entry FROM results")
    assert query(fleet_folder, "SELECT DISTINCT sensor FROM results") == [("cam0",), ("cam1",)]
    assert query(fleet_folder, "SELECT DISTINCT time FROM results WHERE job = 'berta-r1'") == [
        ("2026-10-02T12:05:00+00:00",)
    ]


def test_the_time_of_a_recording_is_that_of_its_clock_where_it_has_one(fleet_folder: Path, workshop):
    add(fleet_folder, "  - {robot: carla, recording: r0}\n  - {robot: dora, recording: r0}\n")

    def since_start(job, c):
        if job != "dora-r0":
            return c
        return dataclasses.replace(c, recordings=(dataclasses.replace(c.recordings[0], origin_ns=10**12),))

    workshop.change = since_start
    found = fleet(fleet_folder)
    clock, unknown = found.of("carla-r0").time, found.of("dora-r0").time
    assert unknown is None and clock is not None
    stamp = workshop.results["r0"].recordings[0].origin_ns
    assert abs(clock.timestamp() - 1e-9 * stamp) < 1.0


def test_calibrations_are_compared_in_order_of_time_not_of_the_file(fleet_folder: Path, workshop):
    lines = (fleet_folder / "JOBS.yaml").read_text().splitlines(keepends=True)
    (fleet_folder / "JOBS.yaml").write_text("".join([*lines[:2], lines[3], lines[2], *lines[4:]]))
    assert fleet(fleet_folder).drifts[0].jobs == ("anton-r0", "anton-turned")
    add(fleet_folder, "  - {robot: anton, recording: r1}\n")
    workshop.change = lambda job, c: dataclasses.replace(
        c, recordings=(dataclasses.replace(c.recordings[0], origin_ns=0),)
    )
    shutil.rmtree(fleet_folder / "out")
    found = fleet(fleet_folder).drifts[0]
    assert found.jobs == ("anton-turned", "anton-r0", "anton-r1")  # one has no time: in the file's order


@pytest.mark.parametrize(("sigma", "drifted"), [("3", True), ("60", False)])
def test_how_many_sigma_count_can_be_chosen(fleet_folder: Path, workshop, capsys, sigma: str, drifted: bool):
    arguments = ["fleet", str(fleet_folder / "JOBS.yaml"), "-o", str(fleet_folder / "out"), "--sigma", sigma]
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert ("Changed over time: anton (cam1)." in out) == drifted
    assert ("Nothing changed over time." in out) != drifted
    assert f"{'2' if drifted else '0'} of 16 comparisons exceed {sigma} sigma" in out


@pytest.mark.parametrize("sigma", [0.0, -1.0, float("nan"), float("inf")])
def test_sigmas_that_make_no_sense(fleet_folder: Path, sigma: float):
    with pytest.raises(CalibrationError, match="must be above 0 sigma"):
        fleet(fleet_folder, limit=sigma)


def test_a_folder_that_cannot_be_written(fleet_folder: Path, workshop, capsys):
    (fleet_folder / "file").write_text("")
    assert main(["fleet", str(fleet_folder / "JOBS.yaml"), "-o", str(fleet_folder / "file" / "out")]) == 1
    text = capsys.readouterr().err
    assert "cannot be written" in text and text.count("\n") == 1 and workshop.done == []


def test_a_table_that_cannot_be_written(fleet_folder: Path, workshop):
    (fleet_folder / "out" / "fleet.sqlite").mkdir(parents=True)
    with pytest.raises(CalibrationError, match=r"fleet\.sqlite cannot be written"):
        fleet(fleet_folder)
    assert sorted(f.name for f in (fleet_folder / "out").iterdir()) == [".lock", "fleet.sqlite", "jobs"]


def test_a_record_reads_back(workshop, fleet_folder: Path, same):
    record = fleet(fleet_folder).results[1].record
    assert same(from_json(to_json(record)), record)


def test_the_page_is_drawn_and_opens_offline(fleet_folder: Path, workshop, assert_drawn):
    add(fleet_folder, BAD)
    fleet(fleet_folder)
    page = (fleet_folder / "out" / "fleet.html").read_text()
    assert "5 jobs of 2 robots: 4 calibrated, 1 failed. Changed over time: anton (cam1)." in page
    assert '<a href="jobs/anton-r0/report.html">anton-r0</a>' in page and 'src="http' not in page
    assert page.count("<details open>") == 1 and page.count("<details>") == 1
    assert_drawn(page, {"time-0-0", "time-0-1", "time-1-0", "time-1-1"})


def test_what_cannot_be_judged_is_pointed_to_on_the_first_screen(fleet_folder: Path, workshop, capsys):
    def edited(job, c):
        lens = c.group("cam0", "intrinsics")
        other = dataclasses.replace(lens, value=lens.value * (1.1 if job == "berta-r1" else 1.0))
        return dataclasses.replace(c, groups=tuple(other if g is lens else g for g in c.groups))

    workshop.change = edited
    assert main(["fleet", str(fleet_folder / "JOBS.yaml"), "-o", str(fleet_folder / "out")]) == 0
    out = capsys.readouterr().out
    assert "Cannot be judged: berta, berta-r0 to berta-r1: the lens of cam0 moved points by" in out
    page = (fleet_folder / "out" / "fleet.html").read_text()
    assert '<a href="#facts">Cannot be judged</a>: 1 more, not determined or typed.' in page
    assert "<li>berta, berta-r0 to berta-r1: the lens of cam0 moved points by" in page
