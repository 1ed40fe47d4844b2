"""Many simulated runs of one scenario, and whether their errors are as their covariances say."""

from icalib.tools.montecarlo.one_run import Task, run
from icalib.tools.montecarlo.record import Record
from icalib.tools.montecarlo.study import Plan, Study, run_file, run_study
from icalib.tools.montecarlo.summary import Consistency, summarise

__all__ = ["Consistency", "Plan", "Record", "Study", "Task", "run", "run_file", "run_study", "summarise"]
