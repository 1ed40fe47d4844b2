"""Summary of the runs of a study, computed from their records.

Statistics exclude entries that are unusable in a run, which means unobservable or too uncertain: their formal standard
deviation is that of a guess, or of a problem linearised too far from the truth.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from icalib.result.verdict import UNUSABLE
from icalib.tools.montecarlo.record import GroupErrors, RunRecord
from icalib.tools.montecarlo.statistics import Largest, Nees, Sample, Spread, largest, nees, spread


@dataclass(frozen=True)
class Entry:
    """One parameter of a block over the runs. runs: number of those in which it is not unusable; rmse, mean_sigma:
    root mean square of its error and of its standard deviation over these runs, or None; verdicts: number of runs of
    each verdict."""

    label: str
    runs: int
    rmse: float | None
    mean_sigma: float | None
    verdicts: dict[str, int]


@dataclass(frozen=True)
class BlockSummary:
    """One block over the runs, without unusable entries. dimension: largest number of entries in a run; runs:
    number of those with at least one entry.

    rmse, mean_sigma: root mean squares over entries and runs. All statistics are None if no run has an entry; spread
    also if runs are few, or differ in their unusable entries.
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
    """Mean over the runs, with its standard error, of one statistic of a sensor's residuals."""

    sensor: str
    kind: str
    mean: float
    standard_error: float


@dataclass(frozen=True)
class Failure:
    """A run that reached no result, and the message."""

    seed: int
    sentence: str


@dataclass(frozen=True)
class Consistency:
    """Summary of a study. runs: number of all; failures: runs that are excluded from the statistics. whole: NEES of all
    blocks together. largest: among the errors that are not unusable. sizes: chi^2 per post-fit degree of freedom;
    lag1: lag-one autocorrelation of whitened residuals. unobservable: number of runs by unobservable combination."""

    runs: int
    failures: tuple[Failure, ...]
    whole: Nees | None
    largest: Largest | None
    blocks: tuple[BlockSummary, ...]
    sizes: tuple[Mean, ...]
    lag1: tuple[Mean, ...]
    unobservable: dict[str, int]


def summarise(records: Sequence[RunRecord]) -> Consistency:
    """Summary of records in any order. Failed runs are listed, and excluded from the statistics."""
    ordered = sorted(records, key=lambda r: r.seed)
    good = [r for r in ordered if not r.failure]
    first: dict[str, GroupErrors] = {}
    for record in good:
        for block in record.blocks:
            first.setdefault(block.key, block)
    all_samples = _samples(good, tuple(first))
    errors = [error for r in good for error in _errors(r)]
    return Consistency(
        len(ordered),
        tuple(Failure(r.seed, r.failure) for r in ordered if r.failure),
        nees(all_samples) if all_samples else None,
        largest(errors) if errors else None,
        tuple(_block(good, block) for block in first.values()),
        _means([(s.sensor, s.kind, s.chi2, s.dof) for r in good for s in r.sizes if s.dof > 0.0]),
        _means([(w.sensor, w.kind, w.lag1, 1.0) for r in good for w in r.whiteness]),
        dict(Counter(sentence.split(":")[0] for r in good for sentence in r.unobservable).most_common()),
    )


def consistency_json(consistency: Consistency, study: Mapping[str, object]) -> bytes:
    """Content of consistency.json; study: inputs of the runs, see `Identity`."""
    return json.dumps({"format": "icalib consistency", "study": dict(study)} | asdict(consistency), indent=1).encode()


def counting(record: RunRecord, key: str) -> np.ndarray:
    """(m,) indices in `record.error` of the entries of block `key` that are not unusable."""
    block = next((b for b in record.blocks if b.key == key), None)
    if block is None:
        return np.arange(0)
    return record.columns(key)[[v not in UNUSABLE for v in block.verdict]]


def _errors(record: RunRecord) -> list[tuple[float, str, int]]:
    """Error in formal standard deviations, name and seed of each entry that is not unusable."""
    return [
        (z, block.key if label == block.name else f"{block.key} {label}", record.seed)
        for block, label, verdict, z in record.errors()
        if verdict not in UNUSABLE
    ]


def _samples(records: Sequence[RunRecord], keys: tuple[str, ...]) -> list[Sample]:
    """Sample of the blocks `keys` together for each run, without unusable entries and runs without entries."""
    samples = []
    for r in records:
        k = np.concatenate([np.arange(0), *(counting(r, key) for key in keys)])
        if len(k):
            samples.append(Sample(r.seed, r.error[k], r.covariance[np.ix_(k, k)]))
    return samples


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
    columns = [(r, r.columns(block.key)[index]) for r in records if len(r.columns(block.key))]
    verdicts = Counter(next(b for b in r.blocks if b.key == block.key).verdict[index] for r, _ in columns)
    counted = [(r.error[k], r.covariance[k, k]) for r, k in columns if k in counting(r, block.key)]
    errors, variances = np.array(counted).reshape(-1, 2).T
    return Entry(
        block.labels[index], len(counted), _root_mean(errors**2), _root_mean(variances), dict(verdicts.most_common())
    )


def _root_mean(squares: np.ndarray) -> float | None:
    return float(np.sqrt(np.mean(squares))) if len(squares) else None


def _means(figures: list[tuple[str, str, float, float]]) -> tuple[Mean, ...]:
    """Weighted means by sensor and kind, in order of first appearance: sum of the amounts over sum of the weights, from
    tuples (sensor, kind, amount, weight) of all runs."""
    pairs_by_key: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for sensor, kind, *pair in figures:
        pairs_by_key.setdefault((sensor, kind), []).append((pair[0], pair[1]))
    out = []
    for (sensor, kind), pairs in pairs_by_key.items():
        amounts, weights = np.array(pairs).T
        mean, n = amounts.sum() / weights.sum(), len(pairs)
        error = np.std(amounts - mean * weights, ddof=1) / (weights.mean() * np.sqrt(n)) if n > 1 else 0.0
        out.append(Mean(sensor, kind, float(mean), float(error)))
    return tuple(out)
