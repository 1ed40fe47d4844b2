"""Assessment of the IMU in a result: residuals, and notes on noise, intrinsics and gaps."""

from __future__ import annotations

from collections.abc import Iterator
from math import comb

import numpy as np

from icalib.base.remark import Remark
from icalib.data.stamps import usual_step
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs
from icalib.motion.imu_data import further_imu_data
from icalib.observability.assessor import AssessedEstimate, Assessment, Assessor, Cause, Remedy
from icalib.observability.prior_sensitivity import Effect
from icalib.result import SensorFit
from icalib.result.calibration import Timeline
from icalib.rig import ImuSensor
from icalib.sensors.imu.mounted_factor import SPEED_SIGMA_M_S
from icalib.sensors.imu.spec import ACCEL_DELAY, EFFECTS, INTRINSICS, INTRINSICS_LABELS, SIZE_EFFECT, prior_words
from icalib.sensors.imu.stream import ImuResiduals


def residuals(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[ImuResiduals]:
    """The residuals of each IMU in all intervals between keyframes; intervals between two recordings have no data and
    are omitted."""
    if inputs.imu is None or inputs.rig.assumes_motion:
        return
    chain, state = estimate.problem.chain, estimate.outcome.state
    seconds = timeline.on_result_clock(state.seconds, state.recording)[:-1]
    between = np.array(chain.starts[1:], dtype=np.int64) - 1
    for name in (chain.name, *inputs.layout.further_imus):
        whitened = estimate.outcome.residuals[name, "readings"].residual
        yield ImuResiduals(name, np.delete(seconds, between), np.delete(whitened, between, axis=0))


def notes(inputs: Inputs, timeline: Timeline) -> Iterator[Remark]:
    """Notes on noise, the prior of the intrinsics and gaps of each IMU; without one, on the assumed smooth motion."""
    rig = inputs.rig
    if inputs.imu is None or rig.imu is None:
        return
    if rig.assumes_motion:
        n = rig.imu.noise
        yield Remark(
            "smooth_motion_assumed",
            f"there is no IMU: the motion is assumed to be smooth, in a second its rate to change by {n.gyro_walk:.2g} "
            f"rad/s and its acceleration by {n.accel_walk:.2g} m/s^2 (standard deviations of each axis).",
        )
        return
    for imu in (rig.imu, *rig.further_imus):
        n, named = imu.noise, f"{imu.name}: " if rig.further_imus else ""
        yield Remark(
            "imu_noise_stated",
            f"{named}IMU noise ({n.source}): gyro {n.gyro:.3g} rad/s/sqrt(Hz), walk {n.gyro_walk:.3g}; accelerometer "
            f"{n.accel:.3g} m/s^2/sqrt(Hz), walk {n.accel_walk:.3g}.",
        )
        if words := _intrinsics_words(imu):
            yield words.with_sentence(f"{named}{words}")
    if rig.imus_alone:
        yield Remark(
            "imus_alone",
            "there are IMUs only: how they move is not measured, and their speed is assumed to be "
            f"{SPEED_SIGMA_M_S:g} m/s (standard deviation of each axis).",
        )
    yield from _gaps(inputs, timeline)


def _gaps(inputs: Inputs, timeline: Timeline) -> Iterator[Remark]:
    """Notes on times without readings of an IMU."""
    assert inputs.imu is not None
    further = (further_imu_data(s, inputs.parts, inputs.measurements) for s in inputs.rig.further_imus)
    for imu in (inputs.imu, *further):
        for a, b in imu.gaps:
            how = "left out, with the images in it"
            if imu is not inputs.imu:
                how = "left out of its readings"
            elif b - a <= inputs.rig.settings.max_gap_s:
                how = "bridged"
            yield Remark("imu_gap", f"{imu.name} has a gap of {b - a:.3f} s at {timeline.words(a)}, {how}.")


def _intrinsics_words(imu: ImuSensor) -> Remark | None:
    """A sentence on the prior of the intrinsics; None if they have none."""
    if imu.intrinsics.mode != "prior" or imu.intrinsics.sigma is None:
        return None
    sigma = dict(zip(INTRINSICS_LABELS, imu.intrinsics.sigma.tolist(), strict=True))
    turn, whose = np.rad2deg(sigma["accel_rotation_x"]), prior_words(imu.intrinsics.sigma)
    return Remark(
        "imu_intrinsics_prior",
        f"prior of IMU intrinsics {whose}: scale {100.0 * sigma['accel_xx']:.2g} % (accelerometer), "
        f"{100.0 * sigma['gyro_xx']:.2g} % (gyroscope), rotation between them {turn:.2g} deg (standard deviations).",
    )


def causes(a: AssessedEstimate) -> Iterator[Cause]:
    """A cause for each effect on the readings of an IMU, and for each IMU whose intrinsics are fixed at those of an
    ideal one, and are others."""
    effects = [e for e in a.effects if e.differs]
    affected = {e.sensor for e in effects if e.spec in EFFECTS}
    for e in effects:
        if e.spec in EFFECTS:
            yield from _effect_causes(e)
        elif e.spec is INTRINSICS:
            k = int(np.argmax(np.abs(e.value / e.std)))
            sentence = (
                f"the rig file calls {e.sensor} ideal (intrinsics: fixed), and it is not: {INTRINSICS_LABELS[k]} is "
                f"about {e.value[k]:.2g} +- {e.std[k]:.2g}, and others may differ, too. Remove intrinsics of "
                f"{e.sensor} in the rig file, so that they are estimated."
            )
            # not grave beside another effect, from which it may follow
            yield Cause(Remark("imu_not_ideal", sentence), e.gain, e.moves > 1.0 and e.sensor not in affected)


def _effect_causes(e: Effect) -> Iterator[Cause]:
    """The cause of one of EFFECTS. A sharper response than an ideal one is none."""
    value = float(e.value[0])
    if e.spec is SIZE_EFFECT:
        # No second estimate with it: translations would refer to another point, the x axis, without being asked.
        y, z = 1e3 * e.value.reshape(2, 3)  # mm; the x axis is at zero
        apart = max(map(np.linalg.norm, (y, z, y - z)))
        sentence = (
            f"the axes of the accelerometer of {e.sensor} are not at one place, but up to {apart:.2g} mm apart. Write "
            "size_effect: free; translations then refer to its x axis."
        )
        yield Cause(Remark("imu_size_effect", sentence), e.gain)
    elif e.spec is ACCEL_DELAY:
        how = f"{1e3 * abs(value):.2g} +- {1e3 * e.std[0]:.1g} ms {'before' if value > 0.0 else 'after'} its gyroscope"
        sentence = f"the accelerometer of {e.sensor} measures {how}, at the same stamps. Write accel_delay: free."
        note = f"the accelerometer of {e.sensor} measures {how}, which was estimated, too; write accel_delay: free."
        remedy = Remedy(e.amended, Remark("accel_delay_estimated", note))
        yield Cause(Remark("accelerometer_late", sentence), e.gain, e.moves > 1.0, remedy=remedy)
    elif value > 0.0:
        sentence = (
            f"{e.sensor} has a low-pass filter, as if of {np.sqrt(0.5 * np.log(2.0) / value) / (2.0 * np.pi):.2g} Hz "
            "(-3 dB). Set a higher bandwidth, and record again."
        )
        yield Cause(Remark("imu_filtered", sentence), e.gain, e.moves > 1.0)


def misfit(imu: ImuSensor, f: SensorFit, is_noise: bool) -> Remark | None:
    """Always None: `validation` tests the noise of the IMU separately, as all other sensors depend on it."""
    return None


# Noise density that the readings of an IMU show by themselves.

ORDER = 6  # of the differences: weaken motion at a tenth of the sampling rate 500 times, slower motion by more
WINDOW = 100  # differences of a window
QUIET = 0.25  # quantile of the windows: most vibration is in others


def quiet_scatter(seconds: np.ndarray, readings: np.ndarray) -> float:
    """Noise density of `readings` (N, 3) at `seconds` (N,) in the quietest windows; NaN where fewer than ten windows
    have readings without a gap.

    Differences of order n of white noise have comb(2 n, n) times its variance, and hardly any of smooth motion. A
    filter in the IMU weakens fast noise, so that the density at the frequencies of motion is this one or larger.
    Vibration in all windows counts as noise. Unit: that of the readings over sqrt(Hz).
    """
    if len(seconds) < 10 * WINDOW + ORDER:
        return np.nan
    step = usual_step(seconds)
    late = np.concatenate([[0], np.cumsum(np.diff(seconds) > 2.0 * step)])
    differences = np.diff(readings, ORDER, axis=0)[late[ORDER:] == late[:-ORDER]]
    count = len(differences) // WINDOW
    if count < 10:
        return np.nan
    squares = differences[: count * WINDOW].reshape(count, WINDOW, -1) ** 2 / comb(2 * ORDER, ORDER)
    return float(np.sqrt((np.quantile(squares.mean(axis=1), QUIET, axis=0)).mean() * step))


def assess(a: AssessedEstimate) -> Assessment:
    """What results say of this kind of sensor."""
    return Assessment(
        residuals=residuals(a.inputs, a.estimate, a.timeline),
        notes=notes(a.inputs, a.timeline),
        causes=causes(a),
    )


ASSESSOR = Assessor(assess, misfit)
