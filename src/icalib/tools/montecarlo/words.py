"""Figures of a study as text, in degrees, millimetres and milliseconds."""

from __future__ import annotations

from icalib.result.quantities import format_number
from icalib.sensors.parameter_spec import display_unit
from icalib.tools.montecarlo.statistics import PROBABILITY, Nees, Spread
from icalib.tools.montecarlo.summary import BlockSummary, Consistency, Mean

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
