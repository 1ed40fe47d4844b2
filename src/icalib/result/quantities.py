"""Parameters as text in degrees, millimetres and milliseconds, rounded according to the standard deviation."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, isfinite, log10
from typing import TYPE_CHECKING, Any

import numpy as np

from icalib.geometry import euler
from icalib.result.body_frame import in_body_frame
from icalib.result.excess import largest_dof
from icalib.result.relative import joint_covariance
from icalib.result.verdict import counted, worst
from icalib.rig import LENS
from icalib.rig.kinds import ONE
from icalib.sensors.parameter_spec import display_unit
from icalib.sensors.sensor import ROTATION

if TYPE_CHECKING:
    from icalib.result.calibration import Calibration, ParameterGroup, SensorFit, Verdict

TURNS = ("roll", "pitch", "yaw")
NOT_COUNTED = "In brackets: without weight in the verdict, as auxiliary, with a prior, or of a lens that projects well."
NEAR_LOCK = "Within 5 std of gimbal lock (pitch 90 deg), that of roll, pitch and yaw is unknown."
SHARPENED = 0.5  # posterior over prior standard deviation: below it, the data contribute most of the information


@dataclass(frozen=True)
class Row:
    """Text of one parameter for a table. std and formal are empty if the parameter is fixed. value is empty where only
    the standard deviation is a number, as for rotation about the sensor's axes; verdict and formal are empty for roll,
    pitch and yaw of an estimated rotation, on which the verdict is by axis. A verdict that does not count for that on
    the result, see `verdict.counted`, is in brackets."""

    sensor: str
    group: str
    name: str
    value: str
    std: str
    formal: str
    factor: str
    unit: str
    verdict: str


def table_rows(calibration: Calibration) -> list[Row]:
    """`rows` for a table, sensors first, without the poses of the rigid bodies of a target, which can be many."""
    placed = (r for r in rows(calibration) if r.sensor not in calibration.bodies)
    return sorted(placed, key=lambda r: r.sensor not in calibration.rig["sensors"])


def rows(calibration: Calibration) -> list[Row]:
    """Rows of all parameters of all sensors, in the order of the groups, with poses relative to the body. IMU
    intrinsics that stay close to their prior share one row; an ideal IMU has none."""
    out, in_body = list[Row](), in_body_frame(calibration)
    for group in nontrivial_groups(in_body):
        if group.name == "rotation":
            out += _angle_rows(in_body, group)
            if group.columns is None:
                continue
        group_rows = _rows_of(group, counted(calibration, group))
        sharpened = _sharpened(calibration, group)
        out += [row for row, is_sharper in zip(group_rows, sharpened, strict=True) if is_sharper]
        if merged := [row for row, is_sharper in zip(group_rows, sharpened, strict=True) if not is_sharper]:
            verdict = worst(tuple(v for v, is_sharper in zip(group.verdict, sharpened, strict=True) if not is_sharper))
            words = _verdict_words(verdict, counted(calibration, group))
            out.append(Row(group.sensor, group.name, f"{len(merged)} more intrinsics", "prior", "", "", "", "", words))
    return out


def _sharpened(calibration: Calibration, group: ParameterGroup) -> list[bool]:
    """(n,) whether the data reduce the standard deviation of each IMU intrinsic below `SHARPENED` times that of its
    prior. True for all other parameters."""
    given = calibration.rig.get("sensors", {}).get(group.sensor, {})
    prior = given.get("intrinsics") if given.get("type") == "imu" else None
    if group.name != "intrinsics" or not isinstance(prior, dict) or "sigma" not in prior:
        return [True] * len(group.labels)
    return (group.std < SHARPENED * np.array(prior["sigma"])).tolist()


def records(c: Calibration) -> list[dict[str, Any]]:
    """A record for each entry of each group, SI. The entries of a rotation are roll, pitch and yaw; a target's
    tilt has no values."""
    out = list[dict[str, Any]]()
    for g in nontrivial_groups(c):
        labels, values, std, verdicts = g.labels, _values(g, 1.0), g.std, g.verdict
        if g.name == ROTATION.name:
            labels, verdicts = TURNS, (worst(g.verdict),) * len(TURNS)
            values, std = euler.rpy(g.value).tolist(), euler.rpy_std(g.value, joint_covariance(c, [g]))
        for label, value, sigma, verdict in zip(labels, values, std.tolist(), verdicts, strict=True):
            about = {"sensor": g.sensor, "group": g.name, "entry": label or g.name, "value": value}
            out.append(about | {"std": sigma, "unit": g.unit, "verdict": verdict})
    return out


def nontrivial_groups(calibration: Calibration) -> list[ParameterGroup]:
    """All groups except those fixed at zero, and except the identity rotation of the body or the reference."""
    still = [(name, "rotation") for name in (calibration.body, calibration.reference)]
    return [
        g
        for g in calibration.groups
        if g.columns is not None
        or (g.value.any() and not ((g.sensor, g.name) in still and np.array_equal(g.value, np.eye(3))))
    ]


def rpy_deg(R: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3,) roll, pitch, yaw [deg] with R = Rz(yaw) Ry(pitch) Rx(roll), as in the rig file, and (3,) their standard
    deviations, see `euler.rpy_std`. covariance (3, 3): of the rotation about the sensor's axes [rad^2]."""
    return np.rad2deg(euler.rpy(R)), np.rad2deg(euler.rpy_std(R, covariance))


def format_number(value: float, digits: int = 2) -> str:
    """`value` with `digits` significant digits, without an exponent if it is in 1e-5 to 1e6; "unknown" for NaN,
    "infinite" for infinity."""
    if not isfinite(value):
        return "unknown" if np.isnan(value) else "infinite"
    if value == 0.0 or not 1e-5 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}" if value else "0"
    return f"{value:.{max(0, digits - 1 - floor(log10(abs(value))))}f}"


def chi2_words(fit: SensorFit) -> str:
    """Text of chi^2 per post-fit degree of freedom; a lower bound if their number is below its sampling error."""
    if fit.chi2_per_dof is None:
        return f"at least {format_number(fit.chi2 / largest_dof(fit))}"
    return format_number(fit.chi2_per_dof, 3)


def dof_words(fit: SensorFit) -> str:
    """Text of the post-fit degrees of freedom; an upper bound if they are below their sampling error."""
    return f"at most {largest_dof(fit):.0f}" if fit.chi2_per_dof is None else f"{fit.dof:.0f}"


def rms_words(fit: SensorFit) -> str:
    """Text of the RMS of the raw residuals with its unit: mm for lengths, mrad for angles. Empty without an RMS."""
    if fit.rms is None:
        return ""
    unit, scale = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}.get(fit.unit, (fit.unit, 1.0))
    return f"{format_number(scale * fit.rms, 3)} {unit}".rstrip()


def _verdict_words(verdict: Verdict, counting: tuple[Verdict, ...]) -> str:
    return verdict if verdict in ("determined", "fixed", *counting) else f"({verdict})"


def _rows_of(group: ParameterGroup, counting: tuple[Verdict, ...]) -> list[Row]:
    unit, scale = display_unit(group.unit)
    names, values = _names(group), _values(group, scale)
    factors = [None] * len(names) if group.columns is None or group.factor is None else group.factor.tolist()
    return [
        Row(
            sensor=group.sensor,
            group=group.name,
            name=names[i],
            value=_value_text(values[i], scale * group.std[i]),
            std="" if verdict == "fixed" else format_number(scale * group.std[i]),
            formal="" if verdict == "fixed" else format_number(scale * group.std_formal[i]),
            factor="" if factors[i] is None else f"{factors[i]:.1f}",
            unit=unit,
            verdict=_verdict_words(verdict, counting),
        )
        for i, verdict in enumerate(group.verdict)
    ]


def _angle_rows(c: Calibration, group: ParameterGroup) -> list[Row]:
    """Rows of roll, pitch and yaw of a rotation."""
    angles = zip(TURNS, *(x.tolist() for x in rpy_deg(group.value, joint_covariance(c, [group]))), strict=True)
    if group.columns is None:
        return [Row(group.sensor, group.name, name, f"{x:.6g}", "", "", "", "deg", "fixed") for name, x, _ in angles]
    return [
        Row(group.sensor, group.name, name, _value_text(angle, std), format_number(std), "", "", "deg", "")
        for name, angle, std in angles
    ]


def _names(group: ParameterGroup) -> list[str]:
    if group.labels == (group.name,) or group.labels == ("",):
        return [group.name.replace("_", " ")]
    if group.name in LENS:
        return list(group.labels)
    one = ONE.get(group.name, group.name)
    return [f"{one} {label}".replace("_", " ") for label in group.labels]


def _values(group: ParameterGroup, scale: float) -> list[float | None]:
    if group.value.ndim == 2:  # a rotation matrix: only its standard deviations are shown
        return [None] * len(group.labels)
    return (scale * group.value).tolist()


def _value_text(value: float | None, std: float) -> str:
    """The value, rounded to the second significant digit of its standard deviation."""
    if value is None:
        return ""
    if not isfinite(std) or std <= 0.0 or not 1e-9 < std < 1e3:
        return f"{value:.6g}"
    return f"{value:.{max(0, 1 - floor(log10(std)))}f}"
