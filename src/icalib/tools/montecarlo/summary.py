"""What the runs of a study say together. It is made from their records alone."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from icalib.tools.montecarlo.record import GroupErrors, RunRecord
from icalib.tools.montecarlo.statistics import Largest, Nees, Sample, Spread, largest, nees, spread


@dataclass(frozen=True)
class Entry:
    """One number of a block: root mean square of its error and of its standard deviation over the runs in which it is
    not undetermined (None where there are none), and how often it was judged what."""

    label: str
    runs: int
    rmse: float | None
    mean_sigma: float | None
    verdicts: dict[str, int]


@dataclass(frozen=True)
class BlockSummary:
    """One block over the runs. dimension: the most entries that counted in a run; runs: those in which some did.

    rmse, mean_sigma: root mean squares over the entries and runs that count. nees and spread are absent where nothing
    counts; spread too where runs are few, or differ in what they determine.
    """

    sensor: str
    name: str
    unit: str
    dimension: int
    runs: int
    nees: Nees | None
    rmse: float | None
    mean_sigma: float | None
    spread: Spread | None
    entries: tuple[Entry, ...]

    @property
    def key(self) -> str:
        return f"{self.sensor}.{self.name}"


@dataclass(frozen=True)
class Mean:
    """Mean over the runs with its standard error, of one figure of a sensor's residuals."""

    sensor: str
    kind: str
    mean: float
    standard_error: float


@dataclass(frozen=True)
class Failure:
    """A run that reached no result, and why."""

    seed: int
    sentence: str


@dataclass(frozen=True)
class Consistency:
    """runs: of all, of which `failures` do not count below. whole: all blocks together. largest: of all single errors
    that count. sizes: chi^2 per post-fit degree of freedom; lag1: correlation of whitened residuals with the next in
    time. undetermined: how many runs left which combination open."""

    runs: int
    failures: tuple[Failure, ...]
    whole: Nees | None
    largest: Largest | None
    blocks: tuple[BlockSummary, ...]
    sizes: tuple[Mean, ...]
    lag1: tuple[Mean, ...]
    undetermined: dict[str, int]


def summarise(records: Sequence[RunRecord]) -> Consistency:
    """Of records in any order; those that failed are listed and count for nothing else."""
    ordered = sorted(records, key=lambda r: r.seed)
    good = [r for r in ordered if not r.failure]
    first: dict[str, GroupErrors] = {}
    for record in good:
        for block in record.blocks:
            first.setdefault(block.key, block)
    whole = _samples(good, tuple(first))
    errors = [error for r in good for error in _errors(r)]
    return Consistency(
        len(ordered),
        tuple(Failure(r.seed, r.failure) for r in ordered if r.failure),
        nees(whole) if whole else None,
        largest(errors) if errors else None,
        tuple(_block(good, block) for block in first.values()),
        _means([(s.sensor, s.kind, s.chi2, s.dof) for r in good for s in r.sizes if s.dof > 0.0]),
        _means([(w.sensor, w.kind, w.lag1, 1.0) for r in good for w in r.whiteness]),
        dict(Counter(sentence.split(":")[0] for r in good for sentence in r.undetermined).most_common()),
    )


def consistency_json(found: Consistency, study: Mapping[str, object]) -> bytes:
    """`consistency.json`: `study` says what the runs were made from."""
    return json.dumps({"format": "icalib consistency", "study": dict(study)} | asdict(found), indent=1).encode()


def counting(record: RunRecord, key: str) -> np.ndarray:
    """(m,) entries of the block in the record's error that are not undetermined: those that say something."""
    block = next((b for b in record.blocks if b.key == key), None)
    if block is None:
        return np.arange(0)
    return record.columns(key)[[v != "undetermined" for v in block.verdict]]


def _errors(record: RunRecord) -> list[tuple[float, str, int]]:
    """Of all entries that count: error in formal standard deviations, name, seed."""
    return [
        (z, block.key if label == block.name else f"{block.key} {label}", record.seed)
        for block, label, verdict, z in record.errors()
        if verdict != "undetermined"
    ]


def _samples(records: Sequence[RunRecord], keys: tuple[str, ...]) -> list[Sample]:
    """Of the blocks `keys` together, runs without any entry that counts left out."""
    found = []
    for r in records:
        k = np.concatenate([np.arange(0), *(counting(r, key) for key in keys)])
        if len(k):
            found.append(Sample(r.seed, r.error[k], r.covariance[np.ix_(k, k)]))
    return found


def _block(records: Sequence[RunRecord], block: GroupErrors) -> BlockSummary:
    samples = _samples(records, (block.key,))
    errors = np.concatenate([np.empty(0), *(s.error for s in samples)])
    variances = np.concatenate([np.empty(0), *(np.diag(s.covariance) for s in samples)])
    return BlockSummary(
        block.sensor,
        block.name,
        block.unit,
        max((len(s.error) for s in samples), default=0),
        len(samples),
        nees(samples) if samples else None,
        _root_mean(errors**2),
        _root_mean(variances),
        spread(samples) if samples else None,
        tuple(_entry(records, block, k) for k in range(len(block.labels))),
    )


def _entry(records: Sequence[RunRecord], block: GroupErrors, index: int) -> Entry:
    own = [(r, r.columns(block.key)[index]) for r in records if len(r.columns(block.key))]
    verdicts = Counter(next(b for b in r.blocks if b.key == block.key).verdict[index] for r, _ in own)
    counted = [(r.error[k], r.covariance[k, k]) for r, k in own if k in counting(r, block.key)]
    errors, variances = np.array(counted).reshape(-1, 2).T
    return Entry(
        block.labels[index], len(counted), _root_mean(errors**2), _root_mean(variances), dict(verdicts.most_common())
    )


def _root_mean(squares: np.ndarray) -> float | None:
    return float(np.sqrt(np.mean(squares))) if len(squares) else None


def _means(figures: list[tuple[str, str, float, float]]) -> tuple[Mean, ...]:
    """Of (sensor, kind, amount, weight) of all runs: sum of the amounts over sum of the weights, in the order in which
    they first appear."""
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for sensor, kind, *pair in figures:
        found.setdefault((sensor, kind), []).append((pair[0], pair[1]))
    out = []
    for (sensor, kind), pairs in found.items():
        amounts, weights = np.array(pairs).T
        mean, n = amounts.sum() / weights.sum(), len(pairs)
        error = np.std(amounts - mean * weights, ddof=1) / (weights.mean() * np.sqrt(n)) if n > 1 else 0.0
        out.append(Mean(sensor, kind, float(mean), float(error)))
    return tuple(out)
