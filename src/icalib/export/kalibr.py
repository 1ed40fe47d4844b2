"""Kalibr's result files, for programs that read these.

Formats: `camchain-imucam.yaml` and `imu.yaml` as kalibr_calibrate_imu_camera writes them (its wiki, "yaml formats").
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import yaml

from icalib.errors import CalibrationError
from icalib.export.common import (
    CameraParameters,
    imu_parameters,
    imu_values,
    imus,
    inverse,
    lens_of,
    moving_offsets,
    no_place_for,
    restarts,
    rolling_shutter,
    time_offset,
)
from icalib.geometry import so3
from icalib.result import Calibration
from icalib.sensors.camera.stream import CornerResiduals, image_of
from icalib.sensors.imu.spec import INTRINSICS, SIZE_EFFECT

# icalib model -> Kalibr's camera and distortion model, and the number of leading icalib distortion coefficients that
# Kalibr lists as intrinsics before the focal lengths.
KALIBR_MODELS = {
    "pinhole-radtan": ("pinhole", "radtan", 0),
    "pinhole-equidistant": ("pinhole", "equidistant", 0),
    "eucm": ("eucm", "none", 2),
    "double-sphere": ("ds", "none", 2),
    "omni-radtan": ("omni", "radtan", 1),
}
KALIBR_NOISE = {  # density in a rig file -> in an imu file
    "gyro": "gyroscope_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accel": "accelerometer_noise_density",
    "accel_walk": "accelerometer_random_walk",
}
SAME_INSTANT_S = 0.025  # images of two cameras at most this far apart count as simultaneous


def camchain_name(calibration: Calibration) -> str:
    """Kalibr's name of the file that `camchain` returns."""
    return "camchain.yaml" if calibration.imu is None else "camchain-imucam.yaml"


def kalibr_texts(c: Calibration) -> dict[str, Callable[[Calibration], str]]:
    """What writes the text of each of Kalibr's files, by name. There is no camchain without a camera, and no imu.yaml
    without an IMU."""
    chain = {camchain_name(c): camchain} if c.cameras else {}
    return chain | ({} if c.imu is None else {"imu.yaml": imu_yaml})


def camchain(calibration: Calibration) -> str:
    """Text of camchain-imucam.yaml, or of camchain.yaml without an IMU. Cameras are named cam0, cam1, ... in the order
    of the rig, as Kalibr requires."""
    c = calibration
    overlaps = cam_overlaps(c)
    lenses = [lens_of(c, name, "Kalibr", tuple(KALIBR_MODELS)) for name in c.cameras]
    data = {f"cam{i}": _camera(c, i, lens, overlaps) for i, lens in enumerate(lenses)}
    comment = "# Kalibr's camchain by icalib. "
    if c.imu is None:
        comment += "T_cn_cnm1 takes coordinates in the frame of the camera before to this one's."
    else:
        comment += (
            "T_cam_imu takes coordinates in the imu frame to the camera frame, T_cn_cnm1 those of the camera before to "
            "this one; t_imu = t_cam + timeshift_cam_imu [s]. The imu frame has the axes of the accelerometer, as "
            "Kalibr's; calibration.yaml has those of the gyroscope."
        )
    fits = [f"# {lens.sentence}" for lens in lenses if lens.sentence]
    restarting = [
        f"# cam{i} has no timeshift_cam_imu: its clock restarts, and each recording has one of its own."
        for i, name in enumerate(c.cameras)
        if restarts(c, name)
    ]
    rolling = [
        f"# cam{i}: each {shutter[1]} is exposed line_delay [s] after the one before; timeshift_cam_imu is that of the "
        f"middle {shutter[1]}."
        for i, name in enumerate(c.cameras)
        if (shutter := rolling_shutter(c, name)) is not None
    ]
    moving = [f"# {sentence}" for sentence in moving_offsets(c, c.cameras)]
    return _text([comment, *_renamed("cam", c.cameras), *restarting, *moving, *rolling, *fits], data)


def imu_yaml(calibration: Calibration) -> str:
    """Text of imu.yaml. Raises CalibrationError without an IMU, or if its rate is unknown."""
    c = calibration
    if c.imu is None:
        raise CalibrationError("the rig has no IMU, so there is no imu.yaml to write.")
    comment = (
        "# Kalibr's imu file by icalib. T_i_b takes coordinates in the body frame to the imu frame; "
        f"{'imu0' if imus(c)[1:] else 'the imu'} is the body here."
    )
    comments = [comment, *_renamed("imu", imus(c))]
    if imus(c)[1:]:
        comments.append("# t_imu0 = t_imu + time_offset [s].")
    comments += [f"# {sentence}" for sentence in no_place_for("Kalibr", imu_omissions(c))]
    return _text(comments, {f"imu{k}": _imu(c, name) for k, name in enumerate(imus(c))})


def imu_omissions(c: Calibration) -> list[str]:
    """Words for the parameters of IMUs that Kalibr lacks."""
    return imu_parameters(c, imus(c), INTRINSICS.name, SIZE_EFFECT.name)


def _imu(c: Calibration, name: str) -> dict[str, Any]:
    """Kalibr's entry of one IMU."""
    if name not in c.rates:
        raise CalibrationError(f"the rate of {name} is not known, and Kalibr's imu.yaml needs one; calibrate again.")
    noise = c.rig["sensors"][name]["noise"]
    T_body_imu, offset = np.eye(4), 0.0
    if name != c.imu:
        T_body_imu = inverse(_T_imu_kalibr(c, c.imu)) @ c.T_imu_sensor(name) @ _T_imu_kalibr(c, name)
        offset = None if restarts(c, name) else time_offset(c, name)
    data: dict[str, Any] = {
        "T_i_b": inverse(T_body_imu).tolist() if name != c.imu else np.eye(4).tolist(),
        **{theirs: float(noise[ours]) for ours, theirs in KALIBR_NOISE.items()},
        "model": "calibrated",
        "rostopic": f"/{name}",
        **({} if offset is None else {"time_offset": offset}),
        "update_rate": float(c.rates[name]),
    }
    return data | _intrinsics(c, name)


def _T_imu_kalibr(c: Calibration, imu: str | None) -> np.ndarray:
    """(4, 4) pose of Kalibr's frame of an IMU, which has the axes of the accelerometer, in icalib's, which has those of
    the gyroscope."""
    T = np.eye(4)
    T[:3, :3] = so3.exp(-imu_values(c, imu)[12:15])
    return T


def _camera(c: Calibration, index: int, lens: CameraParameters, overlaps: np.ndarray) -> dict[str, Any]:
    name = c.cameras[index]
    T_cam_imu = inverse(c.T_imu_sensor(name))
    data: dict[str, Any] = {} if c.imu is None else {"T_cam_imu": (T_cam_imu @ _T_imu_kalibr(c, c.imu)).tolist()}
    if index > 0:
        data["T_cn_cnm1"] = (T_cam_imu @ c.T_imu_sensor(c.cameras[index - 1])).tolist()
    if (shutter := rolling_shutter(c, name)) is not None:
        data["line_delay"] = shutter[0] / shutter[2]
    return data | {
        "cam_overlaps": np.flatnonzero(overlaps[index]).tolist(),
        **_lens_fields(lens),
        "rostopic": f"/{name}/image_raw",
        **({} if c.imu is None or restarts(c, name) else {"timeshift_cam_imu": time_offset(c, name)}),
    }


def _lens_fields(lens: CameraParameters) -> dict[str, Any]:
    camera, distortion, before = KALIBR_MODELS[lens.model]
    return {
        "camera_model": camera,
        "distortion_coeffs": lens.distortion[before:],
        "distortion_model": distortion,
        "intrinsics": [*lens.distortion[:before], *lens.intrinsics],
        "resolution": list(lens.resolution),
    }


def _intrinsics(c: Calibration, imu: str) -> dict[str, Any]:
    """Kalibr's scale-misalignment model, gyro = M C_gyro_i w + A C_gyro_i f, of w and f in the axes of the
    accelerometer, and the places of its axes where they are estimated; empty if the IMU is assumed ideal."""
    x, size = imu_values(c, imu), c.group_or_none(imu, SIZE_EFFECT.name)
    if not x.any() and size is None:
        return {}
    C_accel_gyro = _T_imu_kalibr(c, imu)[:3, :3].T
    places = {} if size is None else {"rx_i": np.zeros(3), "ry_i": size.value[:3], "rz_i": size.value[3:]}
    return {
        "model": "scale-misalignment" if size is None else "scale-misalignment-size-effect",
        "accelerometers": {
            "M": lower(x[:6]).tolist(),
            **{name: (C_accel_gyro @ r).tolist() for name, r in places.items()},
        },
        "gyroscopes": {
            "M": lower(x[6:12]).tolist(),
            "A": x[15:].reshape(3, 3).tolist(),
            "C_gyro_i": _T_imu_kalibr(c, imu)[:3, :3].tolist(),
        },
    }


def lower(x: np.ndarray) -> np.ndarray:
    """(3, 3) identity plus a lower triangle, whose 6 entries x are given row by row."""
    M = np.eye(3)
    M[np.tril_indices(3)] += x
    return M


def cam_overlaps(c: Calibration) -> np.ndarray:
    """(n, n) bool: whether two cameras observed the same target point in simultaneous images (`SAME_INSTANT_S`)."""
    residuals = {r.sensor: r for r in c.corner_residuals}
    streams = [residuals[name] for name in c.cameras]
    n = len(streams)
    overlaps = np.zeros((n, n), dtype=bool)
    for i in range(n):
        for j in range(i):
            overlaps[i, j] = overlaps[j, i] = _overlap(streams[i], streams[j])
    return overlaps


def _overlap(a: CornerResiduals, b: CornerResiduals) -> bool:
    """Whether one point of the target is in simultaneous images of both cameras."""
    if not len(a.seconds) or not len(b.seconds):
        return False
    after = np.clip(np.searchsorted(b.seconds, a.seconds), 1, max(len(b.seconds) - 1, 1)) % len(b.seconds)
    before = np.maximum(after - 1, 0)
    nearest = np.where(a.seconds - b.seconds[before] < b.seconds[after] - a.seconds, before, after)
    together = np.abs(a.seconds - b.seconds[nearest]) <= SAME_INSTANT_S
    n_points = 1 + max(a.point.max(initial=0), b.point.max(initial=0))
    keys_a = np.repeat(np.where(together, nearest, -1), np.diff(a.start)) * n_points + a.point
    keys_b = image_of(b) * n_points + b.point
    return bool(np.isin(keys_a[keys_a >= 0], keys_b).any())


def _renamed(kind: str, names: tuple[str, ...]) -> list[str]:
    """Comments on which sensor each Kalibr name stands for, if the names differ."""
    return [f"# {kind}{i} is {name}." for i, name in enumerate(names) if name != f"{kind}{i}"]


def _text(comments: list[str], data: dict[str, Any]) -> str:
    """YAML in Kalibr's layout: keys sorted, one line for each row of a matrix."""
    return "\n".join(comments) + "\n" + yaml.safe_dump(data, default_flow_style=None, width=100_000)
