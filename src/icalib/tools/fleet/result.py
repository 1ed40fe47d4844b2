"""What all jobs of a fleet found together."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from icalib.tools.fleet.drift import Drift, by_chance
from icalib.tools.fleet.jobs import Job
from icalib.tools.fleet.record import JobRecord


@dataclass(frozen=True)
class JobResult:
    """A job as the file gives it now, and what is known of it."""

    job: Job
    record: JobRecord

    @property
    def time(self) -> datetime | None:
        """When the recording was made: the file's word, else the recording's clock, None where neither knows."""
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
    """results: in the order of the file. drifts: of each robot. limit: sigmas beyond which a change counts. again: jobs
    that were done again, and what had changed."""

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
        """How many changes chance alone is expected to show."""
        return by_chance(sum(d.judged for d in self.drifts), self.limit)

    def of(self, job: str) -> JobResult:
        """Raises KeyError where there is no such job."""
        return {r.job.name: r for r in self.results}[job]


def by_robot(results: tuple[JobResult, ...]) -> dict[str, list[JobResult]]:
    """Of each robot those that reached a result, by time; in the order of the file where one has none."""
    found: dict[str, list[JobResult]] = {r.job.robot: [] for r in results}
    for r in results:
        if not r.failed:
            found[r.job.robot].append(r)
    return {robot: in_time(own) for robot, own in found.items()}


def in_time(results: list[JobResult]) -> list[JobResult]:
    times = {r.job.name: r.time for r in results}
    known = {name: t for name, t in times.items() if t is not None}
    return sorted(results, key=lambda r: known[r.job.name]) if len(known) == len(results) else results
