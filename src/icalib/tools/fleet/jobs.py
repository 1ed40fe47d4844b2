"""Reads a file of jobs; its format is described in docs/fleet.md."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from icalib.base.yaml_nodes import YamlValue, read_yaml

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
_UNFIT = re.compile(r"[^A-Za-z0-9_.-]+")


@dataclass(frozen=True)
class Job:
    """One calibration. name: also that of its folder; recordings: one, or several that are solved jointly; time: of the
    recordings (UTC), None if the file does not state it."""

    name: str
    robot: str
    rig: Path
    recordings: tuple[Path, ...]
    time: datetime | None = None


def load_jobs(path: str | Path) -> tuple[Job, ...]:
    """Reads a file of jobs. Paths are relative to its folder. Recordings may be missing: their jobs will fail.

    Raises RigError, one sentence naming file, line, field, what is wrong and what to do.
    """
    root = read_yaml(Path(path), "file of jobs")
    fields = root.record(("jobs",), ("defaults",))
    defaults = fields["defaults"].record((), ("robot", "rig")) if "defaults" in fields else {}
    folder = Path(path).absolute().parent
    values = fields["jobs"].items()
    if not values:
        fields["jobs"].fail("has no job; add one with robot, rig and recording.")
    jobs = tuple(_job(value, defaults, folder) for value in values)
    _refuse_twins(jobs, values)
    return jobs


def _job(value: YamlValue, defaults: dict[str, YamlValue], folder: Path) -> Job:
    job_fields = value.record(("recording",), ("name", "robot", "rig", "time"))
    fields = defaults | job_fields
    for name in ("robot", "rig"):
        if name not in fields:
            value.fail(f"{name} is missing; add {name}, here or for all jobs in defaults.")
    rig = folder / fields["rig"].text()
    if not rig.is_file():
        fields["rig"].fail(f"{rig} does not exist; correct the path of the rig file.")
    robot = fields["robot"].text()
    recordings = tuple(folder / text for text in _texts(fields["recording"]))
    name = (
        _name(job_fields["name"])
        if "name" in job_fields
        else _UNFIT.sub("_", f"{robot}-{recordings[0].name}").lstrip(".-")[:100]
    )
    return Job(name or "_", robot, rig, recordings, _time(job_fields["time"]) if "time" in job_fields else None)


def _texts(value: YamlValue) -> list[str]:
    items = value.items() if value.is_list else [value]
    if not items:
        value.fail("is an empty list; give the path of a recording, or several.")
    return [item.text() for item in items]


def _name(value: YamlValue) -> str:
    text = value.text()
    if not _NAME.fullmatch(text):
        value.fail(
            "must be a valid folder name (letters, digits, _, - and dots, 100 at most), but is "
            f"{value.summary()}; rename it."
        )
    return text


def _time(value: YamlValue) -> datetime:
    try:
        time = datetime.fromisoformat(value.text())
    except ValueError:
        value.fail(f"must be a date or time as in 2026-11-02 or 2026-11-02T13:05:00+01:00, but is {value.summary()}.")
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def _refuse_twins(jobs: tuple[Job, ...], values: list[YamlValue]) -> None:
    """Raises RigError if two jobs have the same name, upper and lower case being equal as in some file systems."""
    first_index: dict[str, int] = {}
    for k, job in enumerate(jobs):
        first = first_index.setdefault(job.name.casefold(), k)
        if first != k:
            values[k].fail(f"this job and {values[first].field} are both called {job.name}; give each its own name.")
