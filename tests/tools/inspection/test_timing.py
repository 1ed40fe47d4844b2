"""Rates, gaps and jitter against stamps made for them."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.tools.inspection.facts import overlap_s, timing_of

STEP = 50_000_000


def test_even_stamps():
    t = timing_of(1_700_000_000_000_000_001 + STEP * np.arange(101))
    assert t is not None
    assert (t.count, t.gaps, t.longest_gap_s, t.backwards, t.repeated) == (101, 0, None, 0, 0)
    assert (t.rate_hz, t.jitter_s, t.duration_s) == pytest.approx((20.0, 0.0, 5.0))


def test_gaps():
    """One image lost at 1 s, five at 3 s."""
    lost = {20, 60, 61, 62, 63, 64}
    t = timing_of(np.array([STEP * k for k in range(101) if k not in lost], np.int64))
    assert t is not None
    assert (t.gaps, t.longest_gap_s, t.longest_gap_at_s) == (2, pytest.approx(0.3), pytest.approx(2.95))
    assert t.rate_hz == pytest.approx(20.0)


def test_jitter():
    shift = np.random.default_rng(0).normal(scale=1e6, size=2001)
    t = timing_of((STEP * np.arange(2001) + shift).astype(np.int64))
    assert t is not None
    assert t.jitter_s == pytest.approx(np.sqrt(2) * 1e-3, rel=0.1)  # two instants to an interval
    assert t.gaps == 0


def test_stamps_that_go_back_and_repeat():
    t = timing_of(np.array([0, 1, 2, 2, 3, 1, 4], np.int64) * STEP)
    assert t is not None
    assert (t.backwards, t.repeated, t.first_ns, t.last_ns) == (1, 1, 0, 4 * STEP)


@pytest.mark.parametrize("stamps, rate", [([5], None), ([5, 5], None)])
def test_too_few_for_a_rate(stamps, rate):
    t = timing_of(np.array(stamps, np.int64))
    assert t is not None and t.rate_hz is rate and t.gaps == 0


def test_no_stamps():
    assert timing_of(np.zeros(0, np.int64)) is None


def test_overlap():
    a, b, c = (timing_of(np.arange(n, n + 11, dtype=np.int64) * STEP) for n in (0, 4, 30))
    assert a and b and c
    assert overlap_s(a, b) == pytest.approx(0.3) == overlap_s(b, a)
    assert overlap_s(a, c) == pytest.approx(-1.0)
