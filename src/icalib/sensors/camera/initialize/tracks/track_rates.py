"""Angular rates of a camera from its feature tracks, over the interval that suits its motion best."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.initialize.steps.rate_correlation import SensorRates
from icalib.initialize.steps.rate_regression import MIN_REGRESSION_SCORE, best_regressions
from icalib.motion.imu_data import ImuData
from icalib.sensors.camera.initialize.tracks.epipolar_rotation import (
    MIN_SHARED_POINTS,
    image_pairs,
    refine_relative_pose,
    rotation_error,
    rotation_without_translation,
    shared_points,
)

MIN_TRACK_RATES = 20  # rates: fewer do not show a time offset
MIN_TRACK_RATE_CORRELATION = 0.5  # with the IMU's rates; smaller than for poses, as rates from tracks are noisy
TRACK_RATE_STEP_S = 0.4  # s between two images: over less, rotation and lateral translation look alike
THINNED_STEP_SHARE = 0.3  # start of the next interval, as a share of `step`: those between add little information
NOISE_EVERY = 5  # the noise of every fifth rate is computed
RATE_STEPS_S = (TRACK_RATE_STEP_S, 0.2, 0.1, 0.05)  # s between the two images of a rate
MIN_STEP_PERIODS = 0.75  # shortest step, in periods of the images
# Ratio of scores above which rates from the second choice of starts replace those from the first
MIN_SCORE_RATIO = 1.3


def track_rates(
    stream: TrackStream,
    model: CameraModel,
    params: np.ndarray,
    step: float = TRACK_RATE_STEP_S,
    thinned: bool = False,
    chained: bool = False,
) -> SensorRates:
    """Mean angular rates between each image and the one about `step` s later, with their noise by the epipolar errors.

    thinned: skips images whose intervals overlap much. chained: also starts from the relative pose of the previous
    interval. Raises EstimationError if fewer than MIN_TRACK_RATES pairs share enough points.
    """
    rays, valid = model.unproject(params, stream.uv)
    t, rows, noise, previous = stream.seconds, [], [], None
    every = max(1, int(THINNED_STEP_SHARE * step / float(np.median(np.diff(t))))) if thinned else 1
    for i, j in image_pairs(stream, step)[::every]:
        p, q = shared_points(stream, valid, i, j)
        if len(p) < MIN_SHARED_POINTS:
            continue
        f, h = rays[p], rays[q]
        cost, R, direction = _best_relative_pose(f, h, previous)
        if np.isfinite(cost):
            previous = (R, direction) if chained else None
            rows.append((t[i], t[j], *(-so3.log(R) / (t[j] - t[i]))))
            if len(rows) % NOISE_EVERY == 0:
                noise.append(rotation_error(f, h, R, direction)[0] / (t[j] - t[i]))
    if len(rows) < MIN_TRACK_RATES:
        raise EstimationError(
            f"{stream.name}: only {len(rows)} pairs of images {step:.2g} s apart share {MIN_SHARED_POINTS} "
            "tracked points or more; record for longer, or with longer feature tracks."
        )
    columns = np.array(rows)
    start, end, rate = columns[:, 0].copy(), columns[:, 1].copy(), columns[:, 2:].copy()
    return SensorRates(start, end, rate, MIN_TRACK_RATE_CORRELATION, noise=float(np.median(noise)))


def _best_relative_pose(
    f: np.ndarray, h: np.ndarray, previous: tuple[np.ndarray, np.ndarray] | None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Cost, rotation and direction of the better of two refinements: from a pure rotation, and from the relative pose
    `previous` if there is one."""
    refined = []
    for start in (rotation_without_translation(f, h), previous):
        if start is not None:
            R, t = start[0].copy(), start[1].copy()
            refined.append((refine_relative_pose(f, h, R, t), R, t))
    return min(refined, key=lambda x: x[0])


def matching_track_rates(imu: ImuData, stream: TrackStream, model: CameraModel, lens: np.ndarray) -> SensorRates:
    """Rates over the longest of RATE_STEPS_S whose match with the gyroscope is significant, with the matching offsets.
    Over short steps rotation and translation look alike; over long steps vibration averages out. If none is
    significant, the best rates, without offsets.

    Raises EstimationError as `track_rates` does for the first step.
    """
    period = float(np.median(np.diff(stream.seconds)))
    steps = [s for s in RATE_STEPS_S if s > MIN_STEP_PERIODS * period] or [period]
    failed: EstimationError | None = None
    candidates: list[tuple[float, SensorRates]] = []
    for step in steps:
        try:
            candidates += _rates_and_score(imu, stream, model, lens, step)
        except EstimationError as error:
            failed = failed or error
            continue
        if candidates[-1][1].offsets:
            break
    if not candidates:
        assert failed is not None
        raise failed
    return max(candidates, key=lambda x: x[0])[1]


def _rates_and_score(
    imu: ImuData, stream: TrackStream, model: CameraModel, lens: np.ndarray, step: float
) -> list[tuple[float, SensorRates]]:
    """Tries two choices of starts for each relative pose: no translation, or this and the pose of the previous
    interval. Returns score and rates of the second choice if these match the gyroscope clearly better, else of the
    first.

    If a camera moves far to the side, a start without translation often ends in a local minimum, unlike the previous
    pose. With a guessed lens, the previous pose may be the worse start.
    """
    candidates = []
    for chained in (False, True):
        rates = track_rates(stream, model, lens, step, chained=chained)
        shifts = best_regressions(imu, rates)
        likely = tuple(s.offset for s in shifts if s.score > MIN_REGRESSION_SCORE)
        candidates.append((max((s.score for s in shifts), default=-np.inf), replace(rates, offsets=likely)))
    (plain, _), (score, _) = candidates
    return candidates[1:] if score > MIN_SCORE_RATIO * plain else candidates[:1]
