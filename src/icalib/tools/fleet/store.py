"""The folder of a fleet: jobs/ has a folder for each job with its result and its record, written together."""

from __future__ import annotations

from pathlib import Path

from icalib.base.files import below, check_writable, finish_writing, read_file, write_files
from icalib.errors import CalibrationError
from icalib.result import Calibration, load_calibration
from icalib.tools.batch import check_worker, program
from icalib.tools.fleet.inputs import InputHashes
from icalib.tools.fleet.one_job import JobOutcome
from icalib.tools.fleet.record import JobRecord, from_json, to_json

JOBS, RECORD = "jobs", "fleet-job.json"


class JobStore:
    """Records and results by the name of the job. Raises CalibrationError if the folder cannot be written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        check_writable(folder / JOBS)

    def place(self, name: str) -> Path:
        """Folder of the job's files."""
        return below(self.folder / JOBS, name)

    def find(self, name: str) -> JobRecord | None:
        """The record of a job; None if the job is not done, or its result was deleted.

        Raises CalibrationError if the record is damaged, or an interrupted writing cannot be completed.
        """
        place = self.place(name)
        if not place.is_dir():
            return None
        finish_writing(place)
        if not (place / RECORD).exists():
            return None
        try:
            record = from_json(read_file(place, RECORD))
        except (ValueError, KeyError, TypeError) as error:
            raise CalibrationError(f"{place / RECORD} is damaged; delete it to run the job again.") from error
        return record if not record.blocks or (place / "result.json").exists() else None

    def add(self, outcome: JobOutcome) -> None:
        """Stores record and files of a job. Raises CalibrationError if the worker ran another icalib, or the folder
        cannot be written."""
        inputs = outcome.record.inputs
        check_worker(inputs.program if inputs is not None else "", program())
        write_files(self.place(outcome.record.name), outcome.files | {RECORD: to_json(outcome.record)})

    def load(self, name: str) -> Calibration:
        """The job's result. Raises CalibrationError if there is none, or it is damaged."""
        return load_calibration(self.place(name))


def to_do(store: JobStore, inputs: dict[str, InputHashes]) -> tuple[dict[str, JobRecord], dict[str, str]]:
    """Records of the jobs with an up-to-date result; and, for those whose inputs changed, words on the change. inputs:
    current hashes by name of the job."""
    done, changed = dict[str, JobRecord](), dict[str, str]()
    for name, now in inputs.items():
        record = store.find(name)
        if record is None or record.inputs is None:
            continue
        why = record.inputs.changed(now)
        if why:
            changed[name] = why
        else:
            done[name] = record
    return done, changed
