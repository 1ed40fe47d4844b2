"""Calibrates many recordings of many robots, and reports changes over time. A rerun calibrates new jobs only."""

from icalib.tools.batch import Crew
from icalib.tools.fleet.drift import Drift, GroupChange
from icalib.tools.fleet.jobs import Job, load_jobs
from icalib.tools.fleet.result import Fleet, JobResult
from icalib.tools.fleet.run import run_fleet

__all__ = ["GroupChange", "Crew", "Drift", "Fleet", "Job", "JobResult", "load_jobs", "run_fleet"]
