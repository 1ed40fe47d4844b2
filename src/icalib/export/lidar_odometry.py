"""Export to FAST-LIO, FAST-LIVO2 and LIO-SAM: the calibrated fields of their configurations."""

from __future__ import annotations

from typing import Any

from icalib.export.common import (
    CameraParameters,
    Export,
    gravity,
    guesses,
    imu_intrinsics,
    inverse,
    lens_of,
    need,
    need_imu,
    no_place_for,
    others,
    time_offset,
    time_offsets,
    topic,
    yaml_text,
)
from icalib.result import Calibration

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
    omissions = [*others(c, *c.lidars), *imu_intrinsics(c)]
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
    omissions = [*others(c, camera, *c.lidars), *imu_intrinsics(c)]
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
    omissions = [*others(c, *c.lidars), *imu_intrinsics(c), *time_offsets(c, c.lidars)]
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
