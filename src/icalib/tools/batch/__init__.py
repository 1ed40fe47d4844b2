"""Many independent tasks on local processes or a Dask cluster; finished tasks are stored, so that a rerun resumes."""

from icalib.tools.batch.files import replacing, write_atomically
from icalib.tools.batch.lock import exclusive_lock
from icalib.tools.batch.program import program
from icalib.tools.batch.records import check_worker, plain_record, record_json, sentence_on
from icalib.tools.batch.workers import Crew, FailedTask, run_all

__all__ = [
    "Crew",
    "FailedTask",
    "exclusive_lock",
    "check_worker",
    "plain_record",
    "program",
    "record_json",
    "replacing",
    "run_all",
    "sentence_on",
    "write_atomically",
]
