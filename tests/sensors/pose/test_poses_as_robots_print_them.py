"""Poses of an arm that stops, as controllers print them: each is read through fields, and the convention that fits is
named; where several fit, none is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each
from tests.typed import not_none

from icalib.errors import EstimationError
from icalib.initialize.hand_eye import PosePairs, hand_eye, unexplained_motion
from icalib.rig import PoseSensor
from icalib.rig.file import rig_from_dict, rig_to_dict
from icalib.sensors.pose.initialize.conventions import Convention, best_convention, with_checked_convention
from icalib.sensors.pose.read import checked_poses
from icalib.sensors.pose.read.transforms import as_frame_sensor, read_pose_file

RNG = np.random.default_rng(3)
N = 14
R = Rotation.from_rotvec(RNG.uniform(-1.5, 1.5, (N, 3)))
P = RNG.uniform(-0.5, 0.5, (N, 3))
XYZW = R.as_quat()
X, ARM = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix(), np.array([0.05, 0.1, 0.2])
BODY = R.as_matrix() @ X, P + R.as_matrix() @ ARM + 1e-4 * RNG.standard_normal((N, 3))
MATRIX = np.concatenate([R.as_matrix(), 100.0 * P[:, :, None]], axis=2).reshape(N, 12)
BACK = np.hstack([-1e3 * R.inv().apply(P), R.inv().as_quat()[:, [3, 0, 1, 2]]])
PRINTED = [  # numbers of a row, and the fields that read them
    (np.hstack([P, XYZW[:, [3, 0, 1, 2]]]), {"rotations": "wxyz"}),
    (np.hstack([1e3 * P, XYZW]), {"position_unit": "mm"}),
    (np.hstack([1e2 * P, R.as_euler("xyz", degrees=True)]), {"position_unit": "cm", "rotations": ["xyz", "degrees"]}),
    (np.hstack([1e3 * P, R.as_euler("ZYX")]), {"position_unit": "mm", "rotations": ["ZYX", "radians"]}),
    (np.hstack([P, R.as_rotvec()]), {"rotations": ["vector", "radians"]}),
    (MATRIX, {"position_unit": "cm"}),
    (BACK, {"position_unit": "mm", "rotations": "wxyz", "inverted": True}),
]


def pose_sensor(**fields) -> PoseSensor:
    sensors = {"imu0": {"type": "imu"}, "flange": {"type": "pose", **fields}}
    rig = rig_from_dict({"sensors": sensors}, "rig.yaml")
    assert rig_from_dict(rig_to_dict(rig), "rig.yaml").poses == rig.poses
    return rig.poses[0]


def unexplained(folder: Path, rows: np.ndarray, sensor: PoseSensor) -> float:
    """Share of the motion that poses do not explain, as they are read. Raises EstimationError with a convention."""
    path = folder / "poses.csv"
    path.write_text("".join(f"{5 * k}000000000,{','.join(map(repr, row))}\n" for k, row in enumerate(rows.tolist())))
    read = as_frame_sensor(read_pose_file("flange", path, how=sensor.rotations), sensor)

    def place(stream):
        pairs = PosePairs(*BODY, stream.rotation, stream.position)
        share = unexplained_motion(pairs, hand_eye(pairs, None, (False, False)))
        return share, share

    return with_checked_convention(checked_poses(read, sensor, "here")[0], sensor, place)


@each(("rows", "fields"), PRINTED)
def test_each_is_read_through_fields(tmp_path, rows, fields):
    assert unexplained(tmp_path, rows, pose_sensor(**fields)) < 0.01


@each(("rows", "fields"), PRINTED)
def test_the_fields_that_fit_are_named(tmp_path, rows, fields):
    with pytest.raises(EstimationError, match=r"for it in the rig file\.$") as error:
        unexplained(tmp_path, rows, pose_sensor())
    for name, value in fields.items():
        written = f"[{', '.join(value)}]" if isinstance(value, list) else str(value).replace("True", "true")
        assert f"{name}: {written}" in str(error.value)
    assert str(error.value).count(": ") - str(error.value).count("inverted: they") == len(fields)


def test_inverted_by_mistake(tmp_path):
    with pytest.raises(EstimationError, match=r"are not inverted.*write inverted: false"):
        unexplained(tmp_path, np.hstack([P, XYZW]), pose_sensor(inverted=True))


def test_another_order_of_angles_than_stated(tmp_path):
    rows = np.hstack([P, R.as_euler("xyz", degrees=True)])
    with pytest.raises(EstimationError, match=r"write rotations: \[xyz, degrees\] for it"):
        unexplained(tmp_path, rows, pose_sensor(rotations=["ZYX", "degrees"]))


def test_three_numbers_of_another_motion_are_not_named(tmp_path):
    with pytest.raises(EstimationError, match="three numbers give each rotation, and the motion does not show how"):
        unexplained(tmp_path, np.hstack([P, RNG.uniform(-1.0, 1.0, (N, 3))]), pose_sensor())


def test_a_convention_must_explain_the_motion_and_have_no_rival(tmp_path):
    """A robot that turns in place: positions are noise, and the inverse reduces it without explaining the motion."""
    path = tmp_path / "poses.csv"
    path.write_text("".join(f"{5 * k}000000000,{','.join(map(repr, r))}\n" for k, r in enumerate(BACK.tolist())))
    stream = checked_poses(read_pose_file("odom", path), PoseSensor("odom", ""), "here")[0]
    one, two = Convention(stream, "are inverted"), Convention(stream, "are in left-handed axes")
    assert not_none(best_convention([one, two], [0.02, 0.5], 0.1)).words == "are inverted"
    assert best_convention([one, two], [0.3, 0.9], 0.1) is None
    assert best_convention([one, two], [0.02, 0.021], 0.1) is None


@each("written", ["xyz", ["xyz", "turns"], "euler", ["vector"]])
def test_an_unknown_way_to_write_rotations(written):
    with pytest.raises(Exception, match=r"rotations: must be xyzw or wxyz .*correct it"):
        pose_sensor(rotations=written)
