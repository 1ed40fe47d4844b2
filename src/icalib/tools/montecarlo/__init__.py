"""Monte-Carlo studies: simulated calibrations of one scenario, and whether their errors match their covariances."""

from icalib.tools.montecarlo.record import RunRecord, RunTask, run
from icalib.tools.montecarlo.study import Study, StudyPlan, run_file, run_study
from icalib.tools.montecarlo.summary import Consistency, summarise

__all__ = ["Consistency", "StudyPlan", "RunRecord", "Study", "RunTask", "run", "run_file", "run_study", "summarise"]
