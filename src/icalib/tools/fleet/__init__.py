"""Calibrates many recordings of many robots, and reports changes over time. A rerun calibrates new jobs only."""

from icalib.tools.batch import Crew
from icalib.tools.fleet.result import Drift, Fleet, GroupChange, Job, JobResult, load_jobs
from icalib.tools.fleet.run import run_fleet

__all__ = ["GroupChange", "Crew", "Drift", "Fleet", "Job", "JobResult", "load_jobs", "run_fleet"]
