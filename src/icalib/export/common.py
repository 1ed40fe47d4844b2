"""Shared parts of the export formats: the `Export` record, lens conversion, rotations, and sentences on omitted
values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from icalib.errors import CalibrationError
from icalib.geometry.cameras import camera_model
from icalib.geometry.cameras.convert import fit_model
from icalib.result import Calibration, Verdict
from icalib.result.quantities import in_body_frame
from icalib.result.verdict import TOO_UNCERTAIN
from icalib.sensors.imu.spec import EFFECTS, INTRINSICS
from icalib.sensors.sensor import CLOCK_RATE, MOUNTED_NAMES


@dataclass(frozen=True)
class Export:
    """files: text of each file by name. sentences: what the format cannot represent, and caveats on the values."""

    files: dict[str, str]
    sentences: tuple[str, ...]


@dataclass(frozen=True)
class CameraParameters:
    """Lens of a camera in a model that the other program knows: intrinsics fx, fy, cx, cy [px], distortion, and
    resolution (width, height) [px]. sentence: the error of the conversion if the model was converted, else empty."""

    model: str
    intrinsics: list[float]
    distortion: list[float]
    resolution: tuple[int, int]
    sentence: str


def lens_of(c: Calibration, name: str, program: str, supported: Sequence[str]) -> CameraParameters:
    """Lens of camera `name` in a model that `program` supports. If its model is not in `supported`, it is fitted by
    pinhole-radtan for pinhole models and by pinhole-equidistant for all others."""
    sensor = c.rig["sensors"][name]
    model, (width, height) = sensor["model"], (int(side) for side in sensor["resolution"])
    params = np.concatenate([c.group(name, "intrinsics").value, c.group(name, "distortion").value])
    sentence = ""
    if model not in supported:
        target = camera_model("pinhole-radtan" if model.startswith("pinhole") else "pinhole-equidistant")
        params, rms, most = fit_model(camera_model(model), params, target, (width, height))
        sentence = (
            f"{program} has no {model}: {name} is given as the nearest {target.name}, which differs by "
            f"{rms:.2f} px RMS over the image, {most:.1f} px at most."
        )
        model = target.name
    return CameraParameters(model, params[:4].tolist(), params[4:].tolist(), (width, height), sentence)


def need_imu(c: Calibration, program: str) -> str:
    """Name of the IMU. Raises CalibrationError without an IMU."""
    if c.imu is None:
        raise CalibrationError(
            f"{program} needs an IMU, and this calibration has none; export to kalibr, camera-info, ros2-static, urdf "
            "or json."
        )
    return c.imu


def need(names: Sequence[str], kind: str, program: str) -> None:
    """Raise CalibrationError if `names`, the sensors of a kind that `program` requires, is empty."""
    if not names:
        raise CalibrationError(f"this calibration has no {kind}, so there is nothing to export to {program}.")


def rolling_shutter(c: Calibration, name: str) -> tuple[float, str, int] | None:
    """Readout time [s] of a camera, what it exposes one after the other ("row" or "column"), and their number; None for
    other sensors and global shutters."""
    shutter, group = c.rig["sensors"][name].get("shutter"), c.group_or_none(name, "readout")
    if shutter is None or group is None:
        return None
    rows = shutter["rolling"] == "rows"
    return float(group.value[0]), "row" if rows else "column", int(c.rig["sensors"][name]["resolution"][rows])


def guesses(c: Calibration, names: Sequence[str]) -> tuple[str, ...]:
    """A sentence for each of the sensors `names` that has unusable parameters, by verdict, and `moving_offsets`."""
    meanings: dict[Verdict, str] = {
        "unobservable": "unobservable, so the value depends on the initial guess",
        "too uncertain": f"too uncertain, with a standard deviation above {TOO_UNCERTAIN:g} tolerances",
    }
    sentences = []
    for name, (verdict, meaning) in product(names, meanings.items()):
        labels = [
            g.name.replace("_", " ") + ("" if len(g.labels) == 1 else f" {label}")
            for g in c.groups
            if g.sensor == name
            for label, v in zip(g.labels, g.verdict, strict=True)
            if v == verdict
        ]
        if labels:
            sentences.append(f"{name}: {', '.join(labels)} is {meaning}.")
    return (*sentences, *moving_offsets(c, names))


def moving_offsets(c: Calibration, names: Sequence[str]) -> tuple[str, ...]:
    """A sentence for each of the sensors `names` whose time offset differs from row to row, or changes with time."""
    sentences = []
    for name in names:
        if (shutter := rolling_shutter(c, name)) is not None:
            sentences.append(
                f"{name} has a rolling shutter, read out in {1e3 * shutter[0]:.3f} ms: its time offset is that of the "
                f"middle {shutter[1]}."
            )
        if rate := clock_rate(c, name):
            sentences.append(
                f"The clock of {name} has a rate of {rate:+.1f} ppm: its time offset is that of the middle of the "
                f"recording, and changes by {1e-3 * rate:+.4f} ms each second."
            )
    return tuple(sentences)


def clock_rate(c: Calibration, name: str) -> float:
    """Rate of the clock of sensor `name` [ppm]; 0 without one."""
    group = c.group_or_none(name, "clock_rate")
    return 0.0 if group is None else float(group.value[0])


def guessed_poses(c: Calibration) -> tuple[str, ...]:
    """`guesses` of all sensors, for files with poses relative to the body."""
    return guesses(in_body_frame(c), tuple(dict.fromkeys((*c.mounted, *c.on_body))))


def gravity(c: Calibration) -> float:
    """Magnitude of gravity [m/s^2]: the estimate, or what the rig file states."""
    stated = c.rig["gravity"]
    mean = stated["prior"] if isinstance(stated, dict) else stated
    return float(next((g.value[0] for g in c.groups if g.name == "gravity"), mean))


def others(c: Calibration, *covered: str) -> list[str]:
    """Names of all mounted sensors except `covered`, those that the format represents."""
    return [name for name in c.mounted if name not in covered]


def no_place_for(program: str, omissions: Sequence[str]) -> tuple[str, ...]:
    """One sentence that lists `omissions`, which `program` cannot represent; none if the list is empty."""
    if not omissions:
        return ()
    return (f"{program} has no place for {', '.join(omissions)}; see calibration.yaml.",)


def time_offset(c: Calibration, name: str) -> float:
    """Time offset of sensor `name` [s]. Raises CalibrationError if its clock restarts, because each recording then has
    a different offset."""
    if restarts(c, name):
        raise CalibrationError(
            f"the clock of {name} restarts, so each recording has its own time offset, but this format needs "
            "one. Export to ros2-static, camera-info, urdf or json, or calibrate one recording alone."
        )
    return float(c.group(name, "time_offset").value[0])


def restarts(c: Calibration, name: str) -> bool:
    """Whether the clock of the sensor restarts, so that each recording has a separate time offset."""
    return len(c.group(name, "time_offset").value) > 1


def time_offsets(c: Calibration, names: Sequence[str]) -> list[str]:
    """Words for the nonzero time offsets among the sensors `names`."""
    offsets = {g.sensor: g.value for g in c.groups if g.name == "time_offset" and g.value.any()}
    return [_time_offset_words(name, offsets[name]) for name in names if name in offsets]


def _time_offset_words(name: str, value: np.ndarray) -> str:
    if len(value) > 1:
        return f"the time offsets of {name} (one for each recording)"
    return f"the time offset of {name} ({1e3 * value[0]:+.3f} ms)"


def sensor_intrinsics(c: Calibration, names: Sequence[str] | None = None) -> list[str]:
    """Words for parameters of sensors beyond pose and clock, such as "radii and baseline of wheel0". names: by default
    all but cameras and IMUs."""
    phrases, said = [], (*MOUNTED_NAMES, CLOCK_RATE.name)
    for name in others(c, *c.cameras, *imus(c)) if names is None else names:
        groups = [g.name for g in c.groups if g.sensor == name and g.name not in said]
        words = [group.replace("_", " ") for group in groups]
        phrases += [f"{', '.join(words[:-1])}{' and ' if words[1:] else ''}{words[-1]} of {name}"] if words else []
    return phrases


def imu_values(c: Calibration, imu: str | None) -> np.ndarray:
    """(24,) intrinsics of an IMU (see `motion.imu_data`), zeros without any."""
    group = None if imu is None else c.group_or_none(imu, "intrinsics")
    return np.zeros(24) if group is None else group.value


def imus(c: Calibration) -> tuple[str, ...]:
    """Names of the IMUs, that of the body first."""
    return () if c.imu is None else (c.imu, *(name for name in c.of_type("imu") if name != c.imu))


def imu_parameters(c: Calibration, names: Sequence[str], *kept: str) -> list[str]:
    """Words for the groups of the IMUs `names` that are not zero, but for those `kept`, which the format has."""
    words = {INTRINSICS.name: "scale and misalignment"} | {s.name: s.name.replace("_", " ") for s in EFFECTS}
    groups = [g for g in c.groups if g.sensor in names and g.name in words and g.name not in kept]
    return [f"{words[g.name]} of {g.sensor}" for g in groups if g.value.any()]


def topic(c: Calibration, name: str, default: str) -> str:
    """ROS topic of a sensor in the rig file. `default` if there is none, or if an IMU has two topics, which other
    programs read as one."""
    given = c.rig["sensors"][name].get("topic")
    return given if isinstance(given, str) else default


def inverse(T: np.ndarray) -> np.ndarray:
    """(4, 4) inverse of a rigid transform."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def quaternion(R: np.ndarray) -> tuple[float, float, float, float]:
    """Unit quaternion x, y, z, w of a rotation matrix, w >= 0."""
    x, y, z, w = Rotation.from_matrix(R).as_quat(canonical=True).tolist()
    return x, y, z, w


def opencv_matrix(name: str, T: np.ndarray, kind: str = "d") -> list[str]:
    """Lines of a 4x4 matrix in OpenCV's YAML format. kind: element type, d (double) or f (float)."""
    rows = [", ".join(repr(float(x)) for x in row) for row in T]
    head = [f"{name}: !!opencv-matrix", "   rows: 4", "   cols: 4", f"   dt: {kind}"]
    return [*head, f"   data: [{rows[0]},", *(f"      {row}," for row in rows[1:3]), f"      {rows[3]}]"]


def yaml_text(comments: Sequence[str], data: Mapping[str, Any], head: str = "") -> str:
    """`head`, comment lines and YAML of `data`. Lists of numbers take one line, and so does each row of a matrix;
    sequences are indented, as OpenCV's reader requires."""
    body = yaml.dump(
        dict(data), Dumper=_Indented, sort_keys=False, default_flow_style=None, width=100_000, allow_unicode=True
    )
    return head + "".join(f"# {line}\n" for line in comments) + body


class _Indented(yaml.SafeDumper):
    """YAML dumper that indents sequences in mappings."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)
