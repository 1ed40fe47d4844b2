"""Export to ORB-SLAM3: the calibrated fields of its settings file, in format version 1.0."""

from __future__ import annotations

import numpy as np

from icalib.errors import CalibrationError
from icalib.export.common import (
    CameraParameters,
    Export,
    guesses,
    imu_intrinsics,
    inverse,
    lens_of,
    need,
    no_place_for,
    opencv_matrix,
    others,
    time_offsets,
)
from icalib.geometry.cameras import camera_model
from icalib.result import Calibration

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
    omissions = [*others(c, *names), *imu_intrinsics(c)]
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
        *(_imu(c, c.imu, names[0]) if c.imu is not None else []),
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


def _imu(c: Calibration, imu: str, first: str) -> list[str]:
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
