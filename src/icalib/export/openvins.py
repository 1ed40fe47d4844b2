"""Export to OpenVINS: `kalibr_imucam_chain.yaml` and `kalibr_imu_chain.yaml`, the file names in its configuration.

Export to MINS: the calibrated fields of its configuration.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from icalib.errors import CalibrationError
from icalib.export.common import (
    CameraParameters,
    Export,
    guesses,
    imu_intrinsics,
    imu_values,
    inverse,
    lens_of,
    need,
    need_imu,
    no_place_for,
    others,
    time_offset,
    topic,
    yaml_text,
)
from icalib.export.kalibr import KALIBR_NOISE, cam_overlaps, lower
from icalib.geometry import so3
from icalib.result import Calibration

HEAD = "%YAML:1.0\n"
MODELS = {"pinhole-radtan": "radtan", "pinhole-equidistant": "equidistant"}
_OTHER_OFFSET_S = 1e-5


def openvins(c: Calibration) -> Export:
    """Files of cameras and IMU. Raises CalibrationError without a camera, or without an IMU whose rate is known."""
    imu = need_imu(c, "OpenVINS")
    need(c.cameras, "camera", "OpenVINS")
    if imu not in c.rates:
        raise CalibrationError(f"the rate of {imu} is not known, and OpenVINS wants one; calibrate again.")
    lenses = [lens_of(c, name, "OpenVINS", tuple(MODELS)) for name in c.cameras]
    sentences = tuple(lens.sentence for lens in lenses if lens.sentence)
    sentences += _offsets(c) + no_place_for("OpenVINS", others(c, *c.cameras)) + guesses(c, c.cameras)
    overlaps = cam_overlaps(c)
    chain: dict[str, Any] = {}
    for i, (name, lens) in enumerate(zip(c.cameras, lenses, strict=True)):
        before = c.T_imu_sensor(c.cameras[i - 1])
        step = {"T_cn_cnm1": (inverse(c.T_imu_sensor(name)) @ before).tolist()} if i else {}
        chain[f"cam{i}"] = {
            "T_imu_cam": c.T_imu_sensor(name).tolist(),
            **step,
            "cam_overlaps": np.flatnonzero(overlaps[i]).tolist(),
            "camera_model": "pinhole",
            "distortion_coeffs": lens.distortion,
            "distortion_model": MODELS[lens.model],
            "intrinsics": lens.intrinsics,
            "resolution": list(lens.resolution),
            "rostopic": topic(c, name, f"/{name}/image_raw"),
            "timeshift_cam_imu": time_offset(c, name),
        }
    comments = [
        "Cameras for OpenVINS, by icalib.",
        "T_imu_cam takes coordinates in the camera frame to the imu frame: p_imu = T_imu_cam p_cam.",
        "T_cn_cnm1 takes those of the camera before to this one's. t_imu = t_cam + timeshift_cam_imu [s].",
        *(f"cam{i} is {name}." for i, name in enumerate(c.cameras) if name != f"cam{i}"),
        *sentences,
    ]
    files = {"kalibr_imucam_chain.yaml": yaml_text(comments, chain, HEAD), "kalibr_imu_chain.yaml": _imu(c, imu)}
    return Export(files, sentences)


def _offsets(c: Calibration) -> tuple[str, ...]:
    """A sentence if time offsets of cameras differ, as OpenVINS applies that of the first camera to all images."""
    first = time_offset(c, c.cameras[0])
    others = {n: time_offset(c, n) - first for n in c.cameras[1:]}
    off = [f"{n} by {1e3 * d:+.3f} ms" for n, d in others.items() if abs(d) > _OTHER_OFFSET_S]
    if not off:
        return ()
    return (f"OpenVINS uses the time offset of {c.cameras[0]} for all cameras; from it differ {', '.join(off)}.",)


def _imu(c: Calibration, imu: str) -> str:
    """File of the IMU. w: rate, f: specific force, both in the imu frame; gyro = Tw R_IMUtoGYRO w + Tg f, accel = Ta
    R_IMUtoACC f. Its model "kalibr" reads Tw and Ta as lower triangular, and uses both rotations."""
    noise, x = c.rig["sensors"][imu]["noise"], imu_values(c)
    data = {
        "T_i_b": np.eye(4).tolist(),
        **{theirs: float(noise[ours]) for ours, theirs in KALIBR_NOISE.items()},
        "rostopic": topic(c, imu, f"/{imu}"),
        "time_offset": 0.0,
        "update_rate": float(c.rates[imu]),
        "model": "kalibr",
        "Tw": lower(x[6:12]).tolist(),
        "R_IMUtoGYRO": np.eye(3).tolist(),
        "Ta": lower(x[:6]).tolist(),
        "R_IMUtoACC": so3.exp(x[12:15]).tolist(),
        "Tg": x[15:].reshape(3, 3).tolist(),
    }
    comments = [
        f"{imu} for OpenVINS, by icalib. The imu frame, with the axes of the gyroscope, is the body frame.",
        "Densities are in continuous time, SI.",
        "gyro = Tw R_IMUtoGYRO rate + Tg force, accel = Ta R_IMUtoACC force, of rate and force in the imu frame.",
    ]
    return yaml_text(comments, {"imu0": data}, HEAD)


_MERGE = "Put these fields into MINS's file of the same name; it has others besides, which are not calibrated."
_TIME = "t_imu = t_{0} + timeoffset [s]."
_POSE = "T_imu_{0} takes coordinates in the {1} frame to the imu frame: p_imu = T_imu_{0} p_{0}."


def mins(c: Calibration) -> Export:
    """One file for each kind of sensor in the rig. Of wheels, only the first set with left and right radii is exported.
    Raises CalibrationError without an IMU."""
    imu = need_imu(c, "MINS")
    lenses = {name: lens_of(c, name, "MINS", tuple(MODELS)) for name in c.cameras}
    sentences = tuple(lens.sentence for lens in lenses.values() if lens.sentence)
    pairs = [name for name in c.wheels if (name, "radii") in ((g.sensor, g.name) for g in c.groups)]
    positions = c.of_type("position")
    covered = [*c.cameras, *c.lidars, *pairs[:1], *positions]
    sentences += no_place_for("MINS", [*imu_intrinsics(c), *others(c, *covered)]) + guesses(c, covered)
    files = {"config_imu.yaml": _mins_imu(c, imu)}
    if c.cameras:
        cameras = {f"cam{i}": _camera(c, name, lens) for i, (name, lens) in enumerate(lenses.items())}
        files["config_camera.yaml"] = _file(_conventions("cam", "camera", c.cameras), cameras, sentences)
    if c.lidars:
        lidars = {
            f"lidar{i}": _placed(c, name, "lidar") | {"topic": topic(c, name, f"/{name}")}
            for i, name in enumerate(c.lidars)
        }
        files["config_lidar.yaml"] = _file(_conventions("lidar", "LiDAR", c.lidars), lidars, sentences)
    if positions:
        gps = {f"gps{i}": _antenna(c, name) for i, name in enumerate(positions)}
        comments = ["pGinI: the antenna in the IMU's frame [m].", *_conventions("gps", "GPS", positions)[1:]]
        files["config_gps.yaml"] = _file(comments, gps, sentences)
    if pairs:
        files["config_wheel.yaml"] = _wheels(c, pairs[0], sentences)
    return Export(files, sentences)


def _mins_imu(c: Calibration, imu: str) -> str:
    """File of the IMU with its noise densities."""
    noise = c.rig["sensors"][imu]["noise"]
    fields = {"accel_noise": "accel", "accel_bias": "accel_walk", "gyro_noise": "gyro", "gyro_bias": "gyro_walk"}
    data = {theirs: float(noise[ours]) for theirs, ours in fields.items()} | {"topic": topic(c, imu, f"/{imu}")}
    return _file(["Densities in continuous time, SI."], {"imu": data}, ())


def _camera(c: Calibration, name: str, lens: CameraParameters) -> dict[str, Any]:
    """Entry of one camera."""
    return _placed(c, name, "cam") | {
        "intrinsics": lens.intrinsics,
        "distortion_coeffs": lens.distortion,
        "distortion_model": MODELS[lens.model],
        "resolution": list(lens.resolution),
        "topic": topic(c, name, f"/{name}/image_raw"),
    }


def _placed(c: Calibration, name: str, kind: str) -> dict[str, Any]:
    """Time offset [s] and pose T_imu_sensor of one sensor."""
    offset = time_offset(c, name)
    return {"timeoffset": offset, f"T_imu_{kind}": c.T_imu_sensor(name).tolist()}


def _antenna(c: Calibration, name: str) -> dict[str, Any]:
    """Entry of one GPS antenna: lever arm, time offset and topic.

    MINS compares a fix at `time` with p_IinE + R_EtoI^T pGinI of the IMU at time + timeoffset on the IMU's clock
    (mins/src/update/gps/UpdaterGPS.cpp, `UpdaterGPS::update`). These are icalib's lever arm and time offset.
    """
    arm = c.group(name, "translation").value.tolist()
    return {"timeoffset": time_offset(c, name), "pGinI": arm, "topic": topic(c, name, f"/{name}/fix")}


def _conventions(kind: str, word: str, names: tuple[str, ...]) -> list[str]:
    """Comments on the conventions of pose and time offset, and on which sensor each entry stands for."""
    other = [f"{kind}{i} is {name}." for i, name in enumerate(names) if name != f"{kind}{i}"]
    return [_POSE.format(kind, word), _TIME.format(kind), *other]


def _wheels(c: Calibration, name: str, sentences: tuple[str, ...]) -> str:
    left, right = c.group(name, "radii").value.tolist()
    data = _placed(c, name, "wheel")
    data |= {"intrinsics": [left, right, float(c.group(name, "baseline").value[0])]}
    comments = [
        *_conventions("wheel", "wheel", ()),
        "intrinsics: radius of the left wheel, of the right one, baseline [m].",
    ]
    return _file(comments, {"wheel": data | {"topic": topic(c, name, f"/{name}")}}, sentences)


def _file(comments: list[str], data: dict[str, Any], sentences: tuple[str, ...]) -> str:
    return yaml_text(["For MINS, by icalib.", _MERGE, *comments, *sentences], data, HEAD)
