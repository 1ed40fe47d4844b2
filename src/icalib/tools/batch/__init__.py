"""Many independent tasks on local processes or a Dask cluster; finished tasks are stored, so that a rerun resumes."""

from icalib.tools.batch.alone import alone
from icalib.tools.batch.files import replacing, write_whole
from icalib.tools.batch.program import program
from icalib.tools.batch.records import check_worker, plain_record, record_json, sentence_on
from icalib.tools.batch.workers import Crew, Lost, run_all

__all__ = [
    "Crew",
    "Lost",
    "alone",
    "check_worker",
    "plain_record",
    "program",
    "record_json",
    "replacing",
    "run_all",
    "sentence_on",
    "write_whole",
]
