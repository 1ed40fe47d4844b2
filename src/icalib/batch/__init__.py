"""Much work shared out to processes and machines by Dask, of which nothing finished is lost or done twice."""

from icalib.batch.files import replacing, write_whole
from icalib.batch.program import program
from icalib.batch.workers import Crew, Lost, run_all

__all__ = ["Crew", "Lost", "program", "replacing", "run_all", "write_whole"]
