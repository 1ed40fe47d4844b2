"""Many recordings of many robots calibrated, resumed where they were left, and what changed over time."""

from icalib.batch import Crew
from icalib.fleet.drift import Change, Drift
from icalib.fleet.jobs import Job, load_jobs
from icalib.fleet.result import Fleet, JobResult
from icalib.fleet.run import run_fleet

__all__ = ["Change", "Crew", "Drift", "Fleet", "Job", "JobResult", "load_jobs", "run_fleet"]
