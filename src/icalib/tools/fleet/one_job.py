"""Runs one job on a worker, and returns its record and the files of its result."""

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
    """A job and the hashes of its inputs. They are taken before it waits for a worker, so that the next run sees
    changes of the inputs meanwhile."""

    job: Job
    inputs: InputHashes


@dataclass(frozen=True)
class JobOutcome:
    """Record of a job, and the files of its result by name; empty if the job failed."""

    record: JobRecord
    files: dict[str, bytes]


def run(task: JobTask) -> JobOutcome:
    """Runs a job. It never raises: the record of a failed job has the message. The record's inputs have the program of
    the worker."""
    started, inputs = time.perf_counter(), replace(task.inputs, program=program())
    try:
        result = calibrate(task.job.rig, task.job.recordings)
        files = output_files(result)
    except Exception as caught:
        return JobOutcome(JobRecord(task.job.name, sentence_on(caught), time.perf_counter() - started, inputs), {})
    return JobOutcome(JobRecord.of(task.job.name, result, time.perf_counter() - started, inputs), files)
