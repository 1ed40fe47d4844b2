"""Export to VINS-Fusion: `vins.yaml`, and one file for each camera."""

from __future__ import annotations

from math import sqrt

from icalib.errors import CalibrationError
from icalib.export.common import (
    CameraParameters,
    Export,
    gravity,
    guesses,
    imu_intrinsics,
    lens_of,
    need,
    need_imu,
    no_place_for,
    opencv_matrix,
    others,
    time_offset,
    topic,
)
from icalib.result import Calibration

_MODELS = ("pinhole-radtan", "pinhole-equidistant", "omni-radtan")
_MOST = 2


def vins_fusion(c: Calibration) -> Export:
    """Files for the IMU and the first one or two cameras. Raises CalibrationError without a camera, or without an IMU
    whose rate is known."""
    imu = need_imu(c, "VINS-Fusion")
    need(c.cameras, "camera", "VINS-Fusion")
    if imu not in c.rates:
        raise CalibrationError(f"the rate of {imu} is not known, and VINS-Fusion's noise needs it; calibrate again.")
    names = c.cameras[:_MOST]
    lenses = [lens_of(c, name, "VINS-Fusion", _MODELS) for name in names]
    sentences = tuple(lens.sentence for lens in lenses if lens.sentence) + _offset(c, names)
    omissions = [*others(c, *names), *imu_intrinsics(c)]
    sentences += no_place_for("VINS-Fusion", omissions) + guesses(c, names)
    files = {"vins.yaml": _main(c, imu, names, lenses, sentences)}
    for i, (name, lens) in enumerate(zip(names, lenses, strict=True)):
        files[f"cam{i}.yaml"] = _camera(name, lens)
    return Export(files, sentences)


def _offset(c: Calibration, names: tuple[str, ...]) -> tuple[str, ...]:
    """A sentence if the time offsets of the two cameras differ, as VINS-Fusion has only one."""
    offsets = [time_offset(c, name) for name in names]
    if len(names) < 2 or abs(offsets[1] - offsets[0]) < 1e-5:
        return ()
    return (
        f"VINS-Fusion has one td for both cameras, that of {names[0]}; {names[1]} differs from it by "
        f"{1e3 * (offsets[1] - offsets[0]):+.3f} ms.",
    )


def _main(
    c: Calibration, imu: str, names: tuple[str, ...], lenses: list[CameraParameters], sentences: tuple[str, ...]
) -> str:
    """Text of vins.yaml."""
    width, height = lenses[0].resolution
    lines = ["%YAML:1.0", "# For VINS-Fusion, by icalib: copy its other settings (feature tracking, solver) in here."]
    lines.append("# body_T_cam takes coordinates in the camera frame to the imu frame: p_imu = body_T_cam p_cam.")
    lines += [f"# {sentence}" for sentence in sentences]
    lines += ["imu: 1", f"num_of_cam: {len(names)}", f'imu_topic: "{topic(c, imu, f"/{imu}")}"']
    for i, name in enumerate(names):
        lines += [f'image{i}_topic: "{topic(c, name, f"/{name}/image_raw")}"', f'cam{i}_calib: "cam{i}.yaml"']
    lines += [f"image_width: {width}", f"image_height: {height}", "estimate_extrinsic: 0"]
    for i, name in enumerate(names):
        lines += opencv_matrix(f"body_T_cam{i}", c.T_imu_sensor(name))
    lines += _noise(c, imu)
    lines += [f"g_norm: {gravity(c)!r}", "estimate_td: 0"]
    lines.append("# What to add to an image's stamp to have the IMU's clock [s].")
    lines.append(f"td: {time_offset(c, names[0])!r}")
    return "\n".join(lines) + "\n"


def _noise(c: Calibration, imu: str) -> list[str]:
    """Noise of single readings. VINS-Fusion integrates a step dt with the covariance (dt acc_n)^2, so acc_n = density *
    sqrt(rate); likewise for the random walks."""
    noise, root = c.rig["sensors"][imu]["noise"], sqrt(c.rates[imu])
    names = {"acc_n": "accel", "gyr_n": "gyro", "acc_w": "accel_walk", "gyr_w": "gyro_walk"}
    head = f"# Of single readings: densities times the root of the rate, {c.rates[imu]:.6g} Hz; larger ones are usual."
    return [head, *(f"{theirs}: {float(noise[ours]) * root!r}" for theirs, ours in names.items())]


def _camera(name: str, lens: CameraParameters) -> str:
    """File of one camera in the format of camodocal's camera models."""
    fx, fy, cx, cy = lens.intrinsics
    d = lens.distortion
    match lens.model:
        case "pinhole-radtan":
            kind, parts = "PINHOLE", {"distortion": _named(("k1", "k2", "p1", "p2"), d)}
            parts["projection"] = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
        case "omni-radtan":
            kind, parts = "MEI", {"mirror": {"xi": d[0]}}
            parts["distortion"] = _named(("k1", "k2", "p1", "p2"), d[1:])
            parts["projection"] = {"gamma1": fx, "gamma2": fy, "u0": cx, "v0": cy}
        case _:
            kind, terms = "KANNALA_BRANDT", _named(("k2", "k3", "k4", "k5"), d)
            parts = {"projection": terms | {"mu": fx, "mv": fy, "u0": cx, "v0": cy}}
    width, height = lens.resolution
    lines = ["%YAML:1.0", f"# The lens of {name}, by icalib.", "---", f"model_type: {kind}", f"camera_name: {name}"]
    lines += [f"image_width: {width}", f"image_height: {height}"]
    for part, values in parts.items():
        lines += [f"{part}_parameters:", *(f"   {key}: {float(value)!r}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def _named(names: tuple[str, ...], values: list[float]) -> dict[str, float]:
    return dict(zip(names, values, strict=True))
