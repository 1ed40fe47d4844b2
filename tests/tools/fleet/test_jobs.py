"""JOBS.yaml: what it may say, and one sentence for what it may not."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from icalib.cli import main
from icalib.errors import RigError
from icalib.tools.fleet import Job, load_jobs


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "rigs").mkdir()
    for name in ("rig.yaml", "rigs/other.yaml"):
        (tmp_path / name).write_text("sensors: {}\n")
    return tmp_path


def read(folder: Path, text: str) -> tuple[Job, ...]:
    (folder / "JOBS.yaml").write_text(text)
    return load_jobs(folder / "JOBS.yaml")


def test_jobs_and_what_they_take_from_the_defaults(folder: Path, monkeypatch):
    text = """\
defaults: {rig: rig.yaml, robot: anton}
jobs:
  - recording: drives/monday.bag
  - {name: joint, robot: b 2, rig: rigs/other.yaml, recording: [a, /far/b], time: 2026-11-02}
  - {robot: "../b 2", recording: c, time: "2026-11-02T13:05:00+01:00"}
"""
    (folder / "JOBS.yaml").write_text(text)
    monkeypatch.chdir(folder)
    assert load_jobs("JOBS.yaml") == (
        Job("anton-monday.bag", "anton", folder / "rig.yaml", (folder / "drives" / "monday.bag",)),
        Job(
            "joint",
            "b 2",
            folder / "rigs" / "other.yaml",
            (folder / "a", Path("/far/b")),
            datetime(2026, 11, 2, tzinfo=UTC),
        ),
        Job(
            "_b_2-c",
            "../b 2",
            folder / "rig.yaml",
            (folder / "c",),
            datetime(2026, 11, 2, 12, 5, tzinfo=UTC),
        ),
    )


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("jobs: []", r"JOBS.yaml:1: jobs: has no job; add one"),
        (
            "robots: []",
            r"JOBS.yaml:1: robots: there is no such field, did you mean 'jobs'; available are jobs, defaults",
        ),
        ("jobs: {a: 1}", r"JOBS.yaml:1: jobs: must be a list"),
        (
            "jobs:\n- {robot: a, rig: rig.yaml, recordings: r}",
            r"JOBS.yaml:2: jobs\[0\].recordings: there is no such field, did you mean 'recording'; available are ",
        ),
        ("jobs: [{robot: a, rig: rig.yaml}]", r"jobs\[0\]: recording is missing; add recording"),
        ("jobs: [{robot: a, recording: r}]", r"jobs\[0\]: rig is missing; add rig, here or for all jobs in defaults"),
        ("jobs: [{rig: rig.yaml, recording: r}]", r"jobs\[0\]: robot is missing"),
        (
            "defaults: {rig: no.yaml}\njobs: [{robot: a, recording: r}]",
            r"JOBS.yaml:1: defaults.rig: .*no.yaml does not exist; correct the path of the rig file",
        ),
        ("defaults: {recording: r}\njobs: [{robot: a}]", r"defaults.recording: there is no such field"),
        ("jobs: [{robot: a, rig: rig.yaml, recording: []}]", r"jobs\[0\].recording: is an empty list"),
        ("jobs: [{robot: a, rig: rig.yaml, recording: [r, ]]}]", r"not valid YAML"),
        ("jobs: [{robot: a, rig: rig.yaml, recording: [r, {}]}]", r"jobs\[0\].recording\[1\]: must be text"),
        (
            "jobs: [{robot: a, rig: rig.yaml, recording: r, time: monday}]",
            r"jobs\[0\].time: must be a date or time as in 2026-11-02 or .*, but is 'monday'",
        ),
        (
            "jobs: [{name: a/b, robot: a, rig: rig.yaml, recording: r}]",
            r"jobs\[0\].name: must be a valid folder name .*, but is 'a/b'; rename it",
        ),
        ("jobs: [{name: .., robot: a, rig: rig.yaml, recording: r}]", r"jobs\[0\].name: must be a valid folder name"),
        (
            "defaults: {rig: rig.yaml}\njobs:\n- {robot: a, recording: r}\n- {name: A-R, robot: b, recording: r}",
            r"JOBS.yaml:4: jobs\[1\]: this job and jobs\[0\] are both called A-R; give each its own name",
        ),
    ],
)
def test_malformed_files_are_one_sentence(folder: Path, text: str, sentence: str):
    with pytest.raises(RigError, match=sentence) as raised:
        read(folder, text)
    assert "\n" not in str(raised.value) and str(raised.value).endswith(".")


def test_a_malformed_file_leaves_nothing(folder: Path, capsys):
    assert main(["fleet", str(folder / "absent.yaml"), "-o", str(folder / "out")]) == 1
    text = capsys.readouterr().err
    assert text.startswith("icalib: ") and "absent.yaml does not exist; check the path of the file of jobs" in text
    assert not (folder / "out").exists()
