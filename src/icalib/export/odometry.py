"""Export to programs for visual-inertial and LiDAR-inertial odometry: OpenVINS, MINS, ORB-SLAM3, VINS-Fusion, FAST-LIO,
FAST-LIVO2 and LIO-SAM."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from icalib.errors import CalibrationError
from icalib.export.common import (
    CameraParameters,
    Export,
    gravity,
    guesses,
    imu_parameters,
    imu_values,
    imus,
    inverse,
    lens_of,
    need,
    need_imu,
    no_place_for,
    opencv_matrix,
    others,
    sensor_intrinsics,
    time_offset,
    time_offsets,
    topic,
    yaml_text,
)
from icalib.export.kalibr import KALIBR_NOISE, cam_overlaps, lower
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.result import Calibration
from icalib.sensors.imu.spec import INTRINSICS

# Export to OpenVINS: `kalibr_imucam_chain.yaml` and `kalibr_imu_chain.yaml`, the file names in its configuration.
#
# Export to MINS: the calibrated fields of its configuration.

HEAD = "%YAML:1.0\n"
MODELS = {"pinhole-radtan": "radtan", "pinhole-equidistant": "equidistant"}
_OTHER_OFFSET_S = 1e-5


def openvins(c: Calibration) -> Export:
    """Files of cameras and IMU. Raises CalibrationError without a camera, or without an IMU whose rate is known."""
    need_imu(c, "OpenVINS")
    need(c.cameras, "camera", "OpenVINS")
    for name in imus(c):
        if name not in c.rates:
            raise CalibrationError(f"the rate of {name} is not known, and OpenVINS wants one; calibrate again.")
    lenses = [lens_of(c, name, "OpenVINS", tuple(MODELS)) for name in c.cameras]
    sentences = tuple(lens.sentence for lens in lenses if lens.sentence)
    omissions = others(c, *c.cameras, *imus(c)[1:]) + imu_parameters(c, imus(c), INTRINSICS.name)
    sentences += _offsets(c) + no_place_for("OpenVINS", omissions) + guesses(c, c.cameras)
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
    files = {
        "kalibr_imucam_chain.yaml": yaml_text(comments, chain, HEAD),
        "kalibr_imu_chain.yaml": _openvins_imus(c),
    }
    return Export(files, sentences)


def _offsets(c: Calibration) -> tuple[str, ...]:
    """A sentence if time offsets of cameras differ, as OpenVINS applies that of the first camera to all images."""
    first = time_offset(c, c.cameras[0])
    others = {n: time_offset(c, n) - first for n in c.cameras[1:]}
    off = [f"{n} by {1e3 * d:+.3f} ms" for n, d in others.items() if abs(d) > _OTHER_OFFSET_S]
    if not off:
        return ()
    return (f"OpenVINS uses the time offset of {c.cameras[0]} for all cameras; from it differ {', '.join(off)}.",)


def _openvins_imus(c: Calibration) -> str:
    """File of the IMUs; OpenVINS reads the first. w: rate, f: specific force, both in the imu frame; gyro = Tw
    R_IMUtoGYRO w + Tg f, accel = Ta R_IMUtoACC f. Its model "kalibr" reads Tw and Ta as lower triangular, and uses both
    rotations."""
    several = len(imus(c)) > 1
    frame = (
        "frame of imu0, with the axes of its gyroscope," if several else "imu frame, with the axes of the gyroscope,"
    )
    comments = [
        f"{' and '.join(imus(c))} for OpenVINS, by icalib. The {frame} is the body frame.",
        *(["OpenVINS reads imu0 only. T_i_b takes coordinates in the body frame to that of the IMU."] * several),
        "Densities are in continuous time, SI.",
        "gyro = Tw R_IMUtoGYRO rate + Tg force, accel = Ta R_IMUtoACC force, of rate and force in the imu frame.",
    ]
    return yaml_text(comments, {f"imu{k}": _openvins_imu(c, name) for k, name in enumerate(imus(c))}, HEAD)


def _openvins_imu(c: Calibration, imu: str) -> dict[str, Any]:
    noise, x = c.rig["sensors"][imu]["noise"], imu_values(c, imu)
    return {
        "T_i_b": inverse(c.T_imu_sensor(imu)).tolist() if imu != c.imu else np.eye(4).tolist(),
        **{theirs: float(noise[ours]) for ours, theirs in KALIBR_NOISE.items()},
        "rostopic": topic(c, imu, f"/{imu}"),
        "time_offset": time_offset(c, imu) if imu != c.imu else 0.0,
        "update_rate": float(c.rates[imu]),
        "model": "kalibr",
        "Tw": lower(x[6:12]).tolist(),
        "R_IMUtoGYRO": np.eye(3).tolist(),
        "Ta": lower(x[:6]).tolist(),
        "R_IMUtoACC": so3.exp(x[12:15]).tolist(),
        "Tg": x[15:].reshape(3, 3).tolist(),
    }


_MERGE_INTO_MINS = (
    "Put these fields into MINS's file of the same name; it has others besides, which are not calibrated."
)
_TIME = "t_imu = t_{0} + timeoffset [s]."
_POSE = "T_imu_{0} takes coordinates in the {1} frame to the imu frame: p_imu = T_imu_{0} p_{0}."


def _of_imu_and_lidars(c: Calibration) -> list[str]:
    """Words for the parameters of IMU and LiDARs beyond pose and clock."""
    return imu_parameters(c, imus(c)[:1]) + sensor_intrinsics(c, c.lidars)


def mins(c: Calibration) -> Export:
    """One file for each kind of sensor in the rig. Of wheels, only the first set with left and right radii is exported.
    Raises CalibrationError without an IMU."""
    imu = need_imu(c, "MINS")
    lenses = {name: lens_of(c, name, "MINS", tuple(MODELS)) for name in c.cameras}
    sentences = tuple(lens.sentence for lens in lenses.values() if lens.sentence)
    pairs = [name for name in c.wheels if (name, "radii") in ((g.sensor, g.name) for g in c.groups)]
    positions = c.of_type("position")
    covered = [*c.cameras, *c.lidars, *pairs[:1], *positions]
    sentences += no_place_for("MINS", [*_of_imu_and_lidars(c), *others(c, *covered)]) + guesses(c, covered)
    files = {"config_imu.yaml": _mins_imu(c, imu)}
    if c.cameras:
        cameras = {f"cam{i}": _mins_camera(c, name, lens) for i, (name, lens) in enumerate(lenses.items())}
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


def _mins_camera(c: Calibration, name: str, lens: CameraParameters) -> dict[str, Any]:
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
    return yaml_text(["For MINS, by icalib.", _MERGE_INTO_MINS, *comments, *sentences], data, HEAD)


# Export to ORB-SLAM3: the calibrated fields of its settings file, in format version 1.0.

# Name in ORB-SLAM3 of each icalib camera model. Both cameras of a stereo rig must have the same type.
_TYPES = {
    "pinhole-radtan": "PinHole",
    "pinhole-radtan5": "PinHole",
    "pinhole-equidistant": "KannalaBrandt8",
}
_MOST = 2


def orb_slam3(c: Calibration) -> Export:
    """The file orb_slam3.yaml for the first one or two cameras, with an IMU or without.

    Raises CalibrationError without a camera, or if the rate of the IMU is unknown.
    """
    need(c.cameras, "camera", "ORB-SLAM3")
    if c.imu is not None and c.imu not in c.rates:
        raise CalibrationError(f"the rate of {c.imu} is not known, and ORB-SLAM3 needs it; calibrate again.")
    lenses = [lens_of(c, name, "ORB-SLAM3", tuple(_TYPES)) for name in c.cameras[:_MOST]]
    names = c.cameras[: len(_alike(lenses))]
    lenses = lenses[: len(names)]
    omissions = [*others(c, *names), *imu_parameters(c, imus(c)[:1])]
    sentences = tuple(lens.sentence for lens in lenses if lens.sentence)
    sentences += no_place_for("ORB-SLAM3", [*omissions, *time_offsets(c, names)]) + guesses(c, names)
    lines = [
        "%YAML:1.0",
        "# For ORB-SLAM3, by icalib: copy its other settings (ORB extractor, viewer, Stereo.ThDepth) in here.",
        f"# Camera1 is {names[0]}{f', Camera2 is {names[1]}' if names[1:] else ''}.",
        *(f"# {sentence}" for sentence in sentences),
        'File.version: "1.0"',
        f'Camera.type: "{_TYPES[lenses[0].model]}"',
        *_cameras(c, names, lenses),
        *(_orb_slam3_imu(c, c.imu, names[0]) if c.imu is not None else []),
    ]
    return Export({"orb_slam3.yaml": "\n".join(lines) + "\n"}, sentences)


def _alike(lenses: list[CameraParameters]) -> list[CameraParameters]:
    """Lenses that one file can represent: those with the camera type and resolution of the first."""
    first = lenses[0]
    return [x for x in lenses if (_TYPES[x.model], x.resolution) == (_TYPES[first.model], first.resolution)]


def _cameras(c: Calibration, names: tuple[str, ...], lenses: list[CameraParameters]) -> list[str]:
    width, height = lenses[0].resolution
    lines = []
    for i, lens in enumerate(lenses, 1):
        fields = camera_model(lens.model).parameter_names
        values = zip(fields, [*lens.intrinsics, *lens.distortion], strict=True)
        lines += [f"Camera{i}.{field}: {value!r}" for field, value in values]
        if names[1:] and _TYPES[lens.model] == "KannalaBrandt8":
            lines += [f"Camera{i}.overlappingBegin: 0", f"Camera{i}.overlappingEnd: {width - 1}"]
    lines += [f"Camera.width: {width}", f"Camera.height: {height}"]
    if names[0] in c.rates:
        lines.append(f"Camera.fps: {round(c.rates[names[0]])}")
    if names[1:]:
        T = inverse(c.T_imu_sensor(names[0])) @ c.T_imu_sensor(names[1])
        lines.append("# Stereo.T_c1_c2 takes coordinates of Camera2 to Camera1: p_c1 = T_c1_c2 p_c2.")
        lines += opencv_matrix("Stereo.T_c1_c2", T, "f")
    return lines


def _orb_slam3_imu(c: Calibration, imu: str, first: str) -> list[str]:
    """Lines of the extrinsics T_imu_cam and the noise of the IMU. Noise densities are in continuous time, as ORB-SLAM3
    multiplies them by the square root of the rate."""
    noise = c.rig["sensors"][imu]["noise"]
    fields = {"NoiseGyro": "gyro", "NoiseAcc": "accel", "GyroWalk": "gyro_walk", "AccWalk": "accel_walk"}
    return [
        "# IMU.T_b_c1 takes coordinates of Camera1 to the imu frame: p_imu = T_b_c1 p_c1.",
        *opencv_matrix("IMU.T_b_c1", np.asarray(c.T_imu_sensor(first)), "f"),
        *(f"IMU.{theirs}: {float(noise[ours])!r}" for theirs, ours in fields.items()),
        f"IMU.Frequency: {float(c.rates[imu])!r}",
    ]


# Export to VINS-Fusion: `vins.yaml`, and one file for each camera.

_MODELS = ("pinhole-radtan", "pinhole-equidistant", "omni-radtan")


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
    omissions = [*others(c, *names), *imu_parameters(c, imus(c)[:1])]
    sentences += no_place_for("VINS-Fusion", omissions) + guesses(c, names)
    files = {"vins.yaml": _main(c, imu, names, lenses, sentences)}
    for i, (name, lens) in enumerate(zip(names, lenses, strict=True)):
        files[f"cam{i}.yaml"] = _vins_fusion_camera(name, lens)
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


def _vins_fusion_camera(name: str, lens: CameraParameters) -> str:
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


# Export to FAST-LIO, FAST-LIVO2 and LIO-SAM: the calibrated fields of their configurations.

_MERGE = "For {0}, by icalib: put these fields into its own configuration, which has others besides."
# Name in FAST-LIVO2 of each icalib camera model, and of its coefficients.
_LENSES = {
    "pinhole-radtan": ("Pinhole", ("cam_d0", "cam_d1", "cam_d2", "cam_d3")),
    "pinhole-equidistant": ("EquidistantCamera", ("k1", "k2", "k3", "k4")),
}


def fast_lio(c: Calibration) -> Export:
    """FAST-LIO: one file for each LiDAR. Raises CalibrationError without an IMU or a LiDAR."""
    imu = need_imu(c, "FAST-LIO")
    need(c.lidars, "LiDAR", "FAST-LIO")
    omissions = [*others(c, *c.lidars), *_of_imu_and_lidars(c)]
    sentences = no_place_for("FAST-LIO", omissions) + guesses(c, c.lidars)
    comments = [
        _MERGE.format("FAST-LIO"),
        "extrinsic_R (row by row) and extrinsic_T [m] place the LiDAR in the imu frame:",
        "p_imu = extrinsic_R p_lidar + extrinsic_T. t_imu = t_lidar + time_offset_lidar_to_imu [s].",
    ]
    files = {}
    for name in c.lidars:
        offset = time_offset(c, name)
        common = {"lid_topic": topic(c, name, f"/{name}"), "imu_topic": topic(c, imu, f"/{imu}")}
        common |= {"time_sync_en": False, "time_offset_lidar_to_imu": offset}
        place = {"extrinsic_est_en": False} | _extrinsics(c, name)
        files[f"{name}.yaml"] = yaml_text([*comments, *sentences], {"common": common, "mapping": place})
    return Export(files, sentences)


def fast_livo2(c: Calibration) -> Export:
    """FAST-LIVO2: one file for each LiDAR together with the first camera, and one for the lens of that camera. Raises
    CalibrationError without an IMU, a LiDAR or a camera."""
    imu = need_imu(c, "FAST-LIVO2")
    need(c.lidars, "LiDAR", "FAST-LIVO2")
    need(c.cameras, "camera", "FAST-LIVO2")
    camera = c.cameras[0]
    lens = lens_of(c, camera, "FAST-LIVO2", tuple(_LENSES))
    sentences = (lens.sentence,) if lens.sentence else ()
    omissions = [*others(c, camera, *c.lidars), *_of_imu_and_lidars(c)]
    sentences += no_place_for("FAST-LIVO2", omissions) + guesses(c, [camera, *c.lidars])
    comments = [
        _MERGE.format("FAST-LIVO2"),
        "extrinsic_R (row by row) and extrinsic_T [m] place the LiDAR in the imu frame:",
        "p_imu = extrinsic_R p_lidar + extrinsic_T. Rcl and Pcl take points of the LiDAR to the camera:",
        "p_cam = Rcl p_lidar + Pcl.",
        "Times are those of the LiDAR: t_lidar = t_imu - imu_time_offset = t_cam + img_time_offset [s].",
    ]
    files = {}
    for name in c.lidars:
        T = inverse(c.T_imu_sensor(camera)) @ c.T_imu_sensor(name)
        offset = time_offset(c, name)
        data = {
            "common": {
                "img_topic": topic(c, camera, f"/{camera}/image_raw"),
                "lid_topic": topic(c, name, f"/{name}"),
                "imu_topic": topic(c, imu, f"/{imu}"),
            },
            "extrin_calib": _extrinsics(c, name) | {"Rcl": T[:3, :3].ravel().tolist(), "Pcl": T[:3, 3].tolist()},
            "time_offset": {"imu_time_offset": offset, "img_time_offset": time_offset(c, camera) - offset},
        }
        files[f"{name}.yaml"] = yaml_text([*comments, *sentences], data)
    comments = [_MERGE.format("FAST-LIVO2"), f"The lens of {camera}."]
    files[f"camera_{camera}.yaml"] = yaml_text([*comments, *sentences], _vikit(lens))
    return Export(files, sentences)


def lio_sam(c: Calibration) -> Export:
    """LIO-SAM: one file for each LiDAR. Raises CalibrationError without an IMU or a LiDAR."""
    imu = need_imu(c, "LIO-SAM")
    need(c.lidars, "LiDAR", "LIO-SAM")
    omissions = [*others(c, *c.lidars), *_of_imu_and_lidars(c), *time_offsets(c, c.lidars)]
    sentences = no_place_for("LIO-SAM", omissions) + guesses(c, c.lidars)
    comments = [
        _MERGE.format("LIO-SAM"),
        "extrinsicRot (row by row) and extrinsicTrans [m] place the IMU in the lidar frame:",
        "p_lidar = extrinsicRot p_imu + extrinsicTrans. extrinsicRPY is the same rotation, of the IMU's own attitude;",
        "versions whose utility.h has no .inverse() at extQRPY need its transpose there.",
        "Under ROS 2 the fields stand below /**: ros__parameters. Noise densities are in continuous time, SI.",
    ]
    noise = c.rig["sensors"][imu]["noise"]
    fields = {"imuAccNoise": "accel", "imuGyrNoise": "gyro", "imuAccBiasN": "accel_walk", "imuGyrBiasN": "gyro_walk"}
    files = {}
    for name in c.lidars:
        T = inverse(c.T_imu_sensor(name))
        rotation = T[:3, :3].ravel().tolist()
        data = {"pointCloudTopic": topic(c, name, f"/{name}"), "imuTopic": topic(c, imu, f"/{imu}")}
        data |= {theirs: float(noise[ours]) for theirs, ours in fields.items()}
        data |= {"imuGravity": gravity(c), "extrinsicTrans": T[:3, 3].tolist()}
        data |= {"extrinsicRot": rotation, "extrinsicRPY": list(rotation)}
        files[f"{name}.yaml"] = yaml_text([*comments, *sentences], {"lio_sam": data})
    return Export(files, sentences)


def _extrinsics(c: Calibration, name: str) -> dict[str, Any]:
    T = c.T_imu_sensor(name)
    return {"extrinsic_T": T[:3, 3].tolist(), "extrinsic_R": T[:3, :3].ravel().tolist()}


def _vikit(lens: CameraParameters) -> dict[str, Any]:
    """Fields of a lens as the camera loader of rpg_vikit reads them."""
    model, names = _LENSES[lens.model]
    width, height = lens.resolution
    fields = dict(zip(("cam_fx", "cam_fy", "cam_cx", "cam_cy"), lens.intrinsics, strict=True))
    fields |= dict(zip(names, lens.distortion, strict=True))
    return {"cam_model": model, "cam_width": width, "cam_height": height, "scale": 1.0} | fields
