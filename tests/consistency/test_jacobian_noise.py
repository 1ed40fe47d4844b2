"""What noise in the Jacobians adds to the information, where the truth is no information at all."""

from __future__ import annotations

import numpy as np
import pytest
from tests.consistency.recordings import thin
from threadpoolctl import threadpool_limits

from icalib.estimate.estimate import estimate
from icalib.estimate.jacobian_noise import spurious_information
from icalib.observability import determination
from icalib.pipeline import calibrate_measurements
from icalib.tools.simulation import rig_for, simulate, with_drawn_guess

pytestmark = pytest.mark.full

AXIS = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])  # of examples/paper/single-axis.yaml
RECORDINGS = 6


class EnoughError(Exception):
    """The first estimate is all that is asked for."""


@pytest.fixture
def first_judged(monkeypatch):
    """Problem and outcome of the first estimate from simulated measurements, all of it free and led by no guess, at its
    end: where it is left half-way, a tenth more noise is found than there is."""
    seen = []

    def to_its_end(inputs, state, options, callbacks):
        return estimate(inputs, state, callbacks=callbacks)

    def spy(problem, outcome, *_):
        seen.append((problem, outcome))
        raise EnoughError

    monkeypatch.setattr(determination, "estimate", to_its_end)
    monkeypatch.setattr(determination, "spurious_information", spy)

    def made(seed: int):
        scenario = thin("single-axis", 10.0)
        rig = with_drawn_guess(rig_for(scenario, intrinsics="fixed", distortion="fixed"), scenario, seed)
        with pytest.raises(EnoughError):
            calibrate_measurements(rig, simulate(scenario, seed).measurements)
        return seen[-1]

    return made


def test_all_information_that_is_noise_is_found(first_judged):
    """A robot that turns about one axis shows nothing of the wheels' lever arm along it. Relative poses of wheels that
    never slip are as good as constraints, so that what the IMU's noise makes of the turn between them shows it well:
    half of that noise is what turns the trajectory between its keyframes and the images."""
    shown, noise = [], []
    for seed in range(RECORDINGS):
        problem, outcome = first_judged(seed)
        k = problem.layout.columns("wheel0", "translation")
        shown.append(AXIS @ outcome.information[np.ix_(k, k)] @ AXIS)
        with threadpool_limits(limits=1, user_api="blas"):  # as in a calibration
            noise.append(AXIS @ spurious_information(problem, outcome).mean[np.ix_(k, k)] @ AXIS)
    assert np.sqrt(1.0 / np.mean(shown)) < 0.03  # m: it would pass for known
    assert np.mean(noise) == pytest.approx(np.mean(shown), rel=0.1)
