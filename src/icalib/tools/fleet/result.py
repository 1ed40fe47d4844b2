"""Result of a fleet: the results of all jobs, and the changes of each robot."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from icalib.tools.fleet.drift import Drift, by_chance
from icalib.tools.fleet.jobs import Job
from icalib.tools.fleet.record import JobRecord


@dataclass(frozen=True)
class JobResult:
    """A job of the current file of jobs, and its record."""

    job: Job
    record: JobRecord

    @property
    def time(self) -> datetime | None:
        """Time of the recording (UTC): from the file of jobs, else from the recording's clock, else None."""
        if self.job.time is not None or self.record.stamp_ns is None:
            return self.job.time
        return datetime.fromtimestamp(self.record.stamp_ns // 10**9, UTC)

    @property
    def failed(self) -> bool:
        return bool(self.record.failure)

    @property
    def status(self) -> str:
        return "failed" if self.failed else "done"

    @property
    def sentence(self) -> str:
        return self.record.failure or self.record.status


@dataclass(frozen=True)
class Fleet:
    """Result of a fleet. results: in the order of the file of jobs; drifts: one for each robot; limit: sigmas beyond
    which a block has changed; again: jobs that were calibrated again, and the changed inputs."""

    results: tuple[JobResult, ...]
    drifts: tuple[Drift, ...]
    limit: float
    again: dict[str, str]

    @property
    def failed(self) -> tuple[JobResult, ...]:
        return tuple(r for r in self.results if r.failed)

    @property
    def drifted(self) -> tuple[Drift, ...]:
        return tuple(d for d in self.drifts if d.changes)

    @property
    def by_chance(self) -> float:
        """Expected number of changes by chance."""
        return by_chance(sum(d.n_tested for d in self.drifts), self.limit)

    def of(self, job: str) -> JobResult:
        """Result of the job with this name. Raises KeyError if there is none."""
        return {r.job.name: r for r in self.results}[job]


def by_robot(results: tuple[JobResult, ...]) -> dict[str, list[JobResult]]:
    """Results of each robot, without failed jobs. They are sorted by time, or in the order of the file if one has no
    time."""
    groups: dict[str, list[JobResult]] = {r.job.robot: [] for r in results}
    for r in results:
        if not r.failed:
            groups[r.job.robot].append(r)
    return {robot: in_time(group) for robot, group in groups.items()}


def in_time(results: list[JobResult]) -> list[JobResult]:
    times = {r.job.name: r.time for r in results}
    known = {name: t for name, t in times.items() if t is not None}
    return sorted(results, key=lambda r: known[r.job.name]) if len(known) == len(results) else results
