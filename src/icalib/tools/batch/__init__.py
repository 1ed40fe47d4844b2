"""Much work shared out to processes and machines by Dask, of which nothing finished is lost or done twice."""

from icalib.batch.alone import alone
from icalib.batch.files import replacing, write_whole
from icalib.batch.program import program
from icalib.batch.records import check_worker, plain_record, record_json, sentence_on
from icalib.batch.workers import Crew, Lost, run_all

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
