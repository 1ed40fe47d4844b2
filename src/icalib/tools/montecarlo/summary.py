"""Consistency of errors and covariances over many runs, and the page that shows it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.special import erf, gammaincinv

from icalib.report.figures import COLORS, Figure, axis, figure, numbers
from icalib.report.page import Plot, document
from icalib.result.quantities import format_number
from icalib.result.verdict import UNUSABLE
from icalib.sensors.parameter import display_unit
from icalib.tools.montecarlo.record import GroupErrors, Identity, RunRecord

# Consistency of errors and covariances over many runs: NEES, and sampled against predicted covariance.
#
# Summary of the runs of a study, computed from their records.
#
# Statistics exclude entries that are unusable in a run, which means unobservable or too uncertain: their formal
# standard deviation is that of a guess, or of a problem linearised too far from the truth.
#
# Figures of a study as text, in degrees, millimetres and milliseconds.

PROBABILITY = 0.95  # that a consistent covariance has its statistic within the bounds
LEAST_VARIANCE = 1e-13  # smallest eigenvalue of a correlation matrix: below it is rounding
DRAWS = 400  # simulated studies, from which the bounds of the sampled covariance are found


@dataclass(frozen=True)
class Sample:
    """Error (m,) and covariance (m, m) of some entries of one run."""

    seed: int
    error: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Nees:
    """Normalised estimation error squared. mean: of e^T P^-1 e per degree of freedom, 1 for a consistent covariance;
    low, high: its bounds for a consistent covariance; worst_seed, worst: the run with the largest value."""

    mean: float
    low: float
    high: float
    worst_seed: int
    worst: float

    @property
    def consistent(self) -> bool:
        return self.low <= self.mean <= self.high


@dataclass(frozen=True)
class Spread:
    """Ratios of sampled to predicted standard deviation: square roots of the smallest and largest generalised
    eigenvalue of the two covariances, each with its bounds for a consistent covariance. They approach 1 if the
    covariance is consistent and the runs are many."""

    least: float
    least_bounds: tuple[float, float]
    largest: float
    largest_bounds: tuple[float, float]


@dataclass(frozen=True)
class Largest:
    """The largest of `numbers` errors. sigmas: error in standard deviations; entry, seed: its name and run.

    chance: upper bound of the probability of such an error for consistent covariances. Dependence between the errors
    makes the probability smaller.
    """

    sigmas: float
    entry: str
    seed: int
    numbers: int
    chance: float


def nees(samples: list[Sample], probability: float = PROBABILITY) -> Nees:
    """NEES of samples, which may differ in dimension: its sum is chi^2-distributed with the sum of the dimensions.
    probability: that the NEES of a consistent covariance is within the bounds."""
    each = np.array([_squared(s.error, s.covariance) for s in samples])
    dof = sum(len(s.error) for s in samples)
    low, high = gammaincinv(dof / 2, [0.5 - 0.5 * probability, 0.5 + 0.5 * probability]) / (dof / 2)
    per_dof = each / [len(s.error) for s in samples]
    worst = int(np.argmax(per_dof))
    return Nees(float(each.sum()) / dof, float(low), float(high), samples[worst].seed, float(per_dof[worst]))


def largest(errors: Sequence[tuple[float, str, int]]) -> Largest:
    """The largest of errors (error in standard deviations, entry, seed). For jointly normal errors, P(all |z| < c) is
    at least the product of the single probabilities (Sidak, JASA 62, 1967)."""
    z, entry, seed = max(errors, key=lambda error: abs(error[0]))
    return Largest(abs(z), entry, seed, len(errors), float(1.0 - erf(abs(z) / np.sqrt(2.0)) ** len(errors)))


def _squared(e: np.ndarray, P: np.ndarray) -> float:
    """e^T P^-1 e."""
    return float((np.linalg.solve(_factor(P), e) ** 2).sum())


def spread(samples: list[Sample]) -> Spread | None:
    """Spread of samples; None if they differ in dimension, or are too few for a sampled covariance of full rank."""
    n = len(samples[0].error)
    if len(samples) <= n or any(len(s.error) != n for s in samples):
        return None
    predicted = np.mean([s.covariance for s in samples], axis=0)
    roots = _roots(np.array([s.error for s in samples]), predicted)
    rng = np.random.default_rng(0)
    factors = np.array([_factor(s.covariance) for s in samples])
    drawn = [
        _roots(np.einsum("kij,kj->ki", factors, rng.standard_normal((len(samples), n))), predicted)
        for _ in range(DRAWS)
    ]
    low, high = np.quantile(drawn, [0.5 - 0.5 * PROBABILITY, 0.5 + 0.5 * PROBABILITY], axis=0)
    return Spread(float(roots[0]), (float(low[0]), float(high[0])), float(roots[-1]), (float(low[-1]), float(high[-1])))


def _roots(errors: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """(n,) square roots of the generalised eigenvalues of the mean of e e^T and `predicted` (n, n), ascending; errors
    (N, n)."""
    whitened = np.linalg.solve(_factor(predicted), errors.T)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(whitened @ whitened.T / len(errors)), 0.0))


def _factor(P: np.ndarray) -> np.ndarray:
    """L with L L^T = P. Entries are scaled first, since radians beside pixels make a badly conditioned matrix. A
    direction without variance gets LEAST_VARIANCE, so that an error in it counts as huge."""
    sigma = np.sqrt(np.diag(P))
    values, vectors = np.linalg.eigh(P / np.outer(sigma, sigma))
    return sigma[:, None] * vectors * np.sqrt(np.maximum(values, LEAST_VARIANCE))


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


HEADERS = ("block", "dim", "runs", "NEES", "95 %", "RMSE", "mean sigma", "unit", "sampled / predicted")
NUMBERS = HEADERS[1:7] + HEADERS[8:]


def block_row(block: BlockSummary) -> tuple[str, ...]:
    """Cells of one block under `HEADERS`."""
    unit, scale = display_unit(block.unit)
    sizes = ["" if x is None else format_number(scale * x, 3) for x in (block.rmse, block.mean_sigma)]
    return (
        f"{block.sensor} {block.name.replace('_', ' ')}",
        str(block.dimension),
        str(block.runs),
        *nees_cells(block.nees),
        *sizes,
        unit,
        spread_words(block.spread),
    )


def nees_cells(nees: Nees | None) -> tuple[str, str]:
    """Mean NEES per degree of freedom, and its bounds."""
    return ("", "") if nees is None else (f"{nees.mean:.3f}", f"{nees.low:.2f}-{nees.high:.2f}")


def spread_words(spread: Spread | None) -> str:
    return "" if spread is None else f"{spread.least:.2f}-{spread.largest:.2f}"


def chance_words(spread: Spread | None) -> str:
    """Bounds of the spread for a consistent covariance, smallest then largest; "" without a spread."""
    if spread is None:
        return ""
    (a, b), (c, d) = spread.least_bounds, spread.largest_bounds
    return f"{a:.2f}-{b:.2f}, {c:.2f}-{d:.2f}"


def verdict_words(block: BlockSummary) -> str:
    """Number of runs of each verdict, for the entries that are not determined in every run."""
    odd = []
    for entry in block.entries:
        if set(entry.verdicts) - {"determined"}:
            odd.append(f"{entry.label}: {', '.join(f'{n} {v}' for v, n in entry.verdicts.items())}")
    return "; ".join(odd) or "determined in all"


def mean_cells(mean: Mean) -> tuple[str, str, str]:
    return mean.sensor, mean.kind, f"{mean.mean:.3f} +- {mean.standard_error:.3f}"


def answer(consistency: Consistency) -> str:
    """The result of the study in one sentence: how many blocks have a NEES within its bounds."""
    counted = [b for b in consistency.blocks if b.nees is not None]
    if not counted:
        return "No run reached a result."
    out = [b.key for b in counted if b.nees is not None and not b.nees.consistent]
    by_chance = (1.0 - PROBABILITY) * len(counted)
    inside = f"{len(counted) - len(out)} of {len(counted)} blocks have their mean NEES within its 95 % bounds"
    named = f"; outside: {', '.join(out)}" if out else ""
    return f"{inside}; {by_chance:.1f} are expected outside by chance{named}."


def largest_words(consistency: Consistency) -> str:
    """A sentence on the largest single error, and its probability by chance."""
    one = consistency.largest
    if one is None:
        return "No number was determined in any run."
    share = "less than 1" if one.chance < 0.01 else f"at most {100 * one.chance:.0f}"
    return (
        f"The largest error of {one.numbers} numbers is {one.sigmas:.1f} standard deviations ({one.entry}, "
        f"seed {one.seed}); by chance alone {share} of 100 studies would reach it."
    )


def failures_words(consistency: Consistency) -> str:
    if not consistency.failures:
        return f"All {consistency.runs} runs reached a result."
    return (
        f"{len(consistency.failures)} of {consistency.runs} runs failed, and are excluded from the rest of this page."
    )


def unobservable_words(consistency: Consistency) -> list[str]:
    """A line for each unobservable combination, with the number of runs in which it was unobservable."""
    reached = consistency.runs - len(consistency.failures)
    return [f"{n} of {reached} runs: {what}" for what, n in consistency.unobservable.items()]


# `consistency.html`: a study in one file that needs no network.

MEAN = ("sensor", "kind", "mean over runs")


def study_html(consistency: Consistency, identity: Identity, records: Sequence[RunRecord]) -> str:
    """The page as one HTML document."""
    facts = _facts(identity, records)
    summary, nees = (answer(consistency),), [Plot("nees", nees_figure(consistency), "Mean NEES of each block")]
    return page(f"Consistency, {identity.scenario}", summary, {"Blocks": (consistency, nees)}, facts)


def page(
    title: str,
    summary: Sequence[str],
    studies: dict[str, tuple[Consistency, list[Plot]]],
    facts: Sequence[tuple[str, object]] = (),
) -> str:
    """HTML document of one study, or of several, each with its plots. facts: what they were made from."""
    return document(
        "tools/montecarlo/page.html",
        [plot for _, plots in studies.values() for plot in plots],
        title=title,
        summary=summary,
        studies={name: _study_values(*study) for name, study in studies.items()},
        headers=_HEADERS,
        numeric=NUMBERS,
        mean=MEAN,
        facts=facts,
    )


_HEADERS = (*HEADERS, "by chance", "verdicts")


def _study_values(consistency: Consistency, plots: list[Plot]) -> dict[str, object]:
    """What the template shows of a study."""
    return {
        "answer": answer(consistency),
        "blocks": _block_rows(consistency),
        "largest": largest_words(consistency),
        "plots": plots,
        "unobservable": unobservable_words(consistency),
        "failed": failures_words(consistency),
        "failures": [f"seed {f.seed}: {f.sentence}" for f in consistency.failures],
        "residuals": {
            "chi2 per post-fit degree of freedom": list(map(mean_cells, consistency.sizes)),
            "Correlation with the next one in time": list(map(mean_cells, consistency.lag1)),
        },
    }


def _block_rows(consistency: Consistency) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [
        (*block_row(b), chance_words(b.spread), verdict_words(b)) for b in consistency.blocks
    ]
    if consistency.whole is not None:
        rows.append(("all together", "", "", *nees_cells(consistency.whole), *[""] * (len(_HEADERS) - 5)))
    return rows


def nees_figure(consistency: Consistency) -> Figure:
    """Mean NEES of each block, with the 95 % bounds for a consistent covariance."""
    blocks: list[tuple[str, Nees]] = [(b.key, b.nees) for b in consistency.blocks if b.nees is not None]
    names = [name for name, _ in blocks]
    middle = np.array([0.5 * (n.low + n.high) for _, n in blocks])
    half = np.array([0.5 * (n.high - n.low) for _, n in blocks])
    bounds = {
        "type": "scatter",
        "mode": "markers",
        "x": names,
        "y": numbers(middle),
        "name": "95 % bounds",
        "marker": {"opacity": 0},
        "error_y": {"array": numbers(half), "color": "#94a3b8", "thickness": 6, "width": 0},
    }
    means = {
        "type": "scatter",
        "mode": "markers",
        "x": names,
        "y": numbers(np.array([n.mean for _, n in blocks])),
        "name": "mean NEES",
        "marker": {"color": COLORS[0], "size": 8},
    }
    return figure([bounds, means], xaxis=axis("", automargin=True), yaxis=axis("NEES per degree of freedom"))


def _facts(identity: Identity, records: Sequence[RunRecord]) -> list[tuple[str, object]]:
    seconds = float(np.median([r.seconds for r in records]))
    return [
        ("scenario", identity.scenario),
        ("sha256", identity.scenario_sha256),
        ("first guess", identity.guess),
        ("planes of LiDARs", identity.planes),
        ("seeds", f"{records[0].seed} to {records[-1].seed}"),
        ("time of a run", f"{seconds:.1f} s (median)"),
        ("program", identity.program),
        *identity.versions.items(),
    ]
