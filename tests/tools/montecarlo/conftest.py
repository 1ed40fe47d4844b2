"""Records made up from obvious formulas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from icalib.tools.montecarlo.record import GroupErrors, RunRecord, Size, Waypoint, Whiteness

BLOCKS = (
    GroupErrors("cam0", "rotation", ("x", "y", "z"), "rad", ("determined",) * 3),
    GroupErrors("cam0", "time_offset", ("time_offset",), "s", ("weak",)),
    GroupErrors("cam0", "distortion", ("k1", "k2"), "", ("determined",) * 2),
    GroupErrors("cam1", "rotation", ("x", "y", "z"), "rad", ("determined",) * 3),
    GroupErrors("cam1", "distortion", ("k1", "k2"), "", ("determined",) * 2),
    GroupErrors("wheel0", "radii", ("left", "right"), "m", ("determined",) * 2),
)
SIZES = np.repeat([1e-4, 1e-5, 1e-3, 1e-4, 1e-3, 1e-5], [3, 1, 2, 3, 2, 2])  # standard deviations, about


def made_up(seed: int, optimism: float = 1.0) -> RunRecord:
    """Errors drawn from a covariance that is unlike from run to run, and stated `optimism`^2 times too small."""
    rng = np.random.default_rng([seed, 5])
    L = SIZES[:, None] * (np.eye(13) + 0.3 * rng.standard_normal((13, 13)))
    error = L @ rng.standard_normal(13)
    covariance = L @ L.T / optimism**2
    start = error + 100.0 * SIZES
    path = tuple(Waypoint("first", e, np.sqrt(np.diag(covariance))) for e in (start, error))
    sizes = (Size("cam0", "corners", 1000, 990.0, 990.0 + seed), Size("imu0", "gyroscope", 60, 0.0, 1.0))
    lags = (Whiteness("cam0", "corners", 1.0, 0.01 * seed),)
    return RunRecord(seed, "", 2.0, "digest", BLOCKS, error, covariance, (), sizes, lags, path)


def with_verdict(record: RunRecord, key: str, verdict: tuple[str, ...]) -> RunRecord:
    blocks = tuple(replace(b, verdict=verdict) if b.key == key else b for b in record.blocks)
    return replace(record, blocks=blocks, unobservable=("wheel0 radii left: not determined; roll on.",))


@pytest.fixture
def record() -> Callable[..., RunRecord]:
    return made_up


@pytest.fixture
def judged() -> Callable[[RunRecord, str, tuple[str, ...]], RunRecord]:
    return with_verdict
