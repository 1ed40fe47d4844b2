"""One job, on a worker: calibrate, and give back all that is to be written. What goes wrong becomes part of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from icalib.export.outputs import output_files
from icalib.pipeline import calibrate
from icalib.tools.batch import program, sentence_on
from icalib.tools.fleet.inputs import InputHashes
from icalib.tools.fleet.jobs import Job
from icalib.tools.fleet.record import JobRecord


@dataclass(frozen=True)
class JobTask:
    """A job, and what it would be made from, looked at before: what changes while it waits is seen the next time."""

    job: Job
    inputs: InputHashes


@dataclass(frozen=True)
class JobOutcome:
    """files: of the result, by name; none where there is none."""

    record: JobRecord
    files: dict[str, bytes]


def run(task: JobTask) -> JobOutcome:
    """Never raises: the sentence of a job that failed is in its record. The inputs name the program that worked."""
    started, inputs = time.perf_counter(), replace(task.inputs, program=program())
    try:
        result = calibrate(task.job.rig, task.job.recordings)
        files = output_files(result)
    except Exception as caught:
        return JobOutcome(JobRecord(task.job.name, sentence_on(caught), time.perf_counter() - started, inputs), {})
    return JobOutcome(JobRecord.of(task.job.name, result, time.perf_counter() - started, inputs), files)
