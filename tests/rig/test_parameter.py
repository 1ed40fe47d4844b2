"""Parameters refuse what makes no sense in one sentence, and `Rig.with_` changes what it says and nothing else."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each

import icalib
from icalib.errors import RigError
from icalib.rig import Camera, ImuNoise, ImuSensor, Lidar, PoseSensor, Rig, Settings, Wheels, by_name
from icalib.sensors.parameter import Parameter

TURN = Rotation.from_euler("xyz", [10.0, -20.0, 80.0], degrees=True)


def test_the_four_ways_to_treat_a_parameter():
    assert (icalib.free().mode, icalib.free().value, icalib.free().size) == ("free", None, 0)
    start = icalib.guess(0.25)
    assert start.mode == "free" and start.value is not None and start.value.tolist() == [0.25] and start.size == 1
    kept = icalib.fixed([1, 2, 3])
    assert kept.mode == "fixed" and kept.value is not None and kept.value.dtype == np.float64 and kept.sigma is None
    known = icalib.prior(TURN, 0.01)
    assert known.mode == "prior" and known.sigma is not None and known.sigma.tolist() == [0.01] * 3 and known.size == 3
    assert known.value is not None
    np.testing.assert_allclose(known.value, TURN.as_matrix(), atol=1e-15)


def test_a_rotation_of_few_digits_is_made_exact_and_an_exact_one_stays():
    rounded = icalib.fixed(TURN.as_matrix().round(4)).value
    assert rounded is not None
    np.testing.assert_allclose(rounded @ rounded.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rounded, TURN.as_matrix(), atol=1e-4)
    exact = TURN.as_matrix()
    assert (icalib.fixed(exact).value == exact).all()


@each(
    ("make", "words"),
    [
        (lambda: icalib.fixed([0.0, np.nan]), "NaN or infinite"),
        (lambda: icalib.guess([[1.0, 2.0]]), r"shape \(1, 2\)"),
        (lambda: icalib.guess([]), r"shape \(0,\)"),
        (lambda: icalib.guess("0.1 m"), "not '0.1 m'"),
        (lambda: icalib.guess([[1.0, 2.0], [3.0]]), "a vector of numbers"),
        (lambda: icalib.fixed(2.0 * np.eye(3)), "is not a rotation matrix"),
        (lambda: icalib.fixed(np.diag([1.0, 1.0, -1.0])), "is a reflection"),
        (lambda: icalib.prior([0.0, 1.0], 0.0), "must be above 0 and finite, but one entry is 0"),
        (lambda: icalib.prior([0.0, 1.0], [0.1, -2.0]), "one entry is -2"),
        (lambda: icalib.prior([0.0, 1.0], np.inf), "one entry is inf"),
        (lambda: icalib.prior([0.0, 1.0], [0.1, 0.1, 0.1]), r"1 or 2 numbers, but it has shape \(3,\)"),
        (lambda: icalib.prior(np.eye(3), np.eye(3)), "1 or 3 numbers"),
        (lambda: Parameter("prior", np.zeros(2)), "a prior needs a value and its sigma"),
        (lambda: Parameter("free", np.zeros(2), np.ones(2)), "sigma belongs to a prior"),
        (lambda: Parameter("held", np.zeros(2)), "not 'held'"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_nonsense_is_refused_in_one_sentence(make: Callable[[], Parameter], words: str):
    with pytest.raises(RigError, match=words) as raised:
        make()
    assert str(raised.value).endswith(".") and "\n" not in str(raised.value)


@each(
    ("make", "words"),
    [
        (lambda p: Camera("c", "c", "eucm", (9, 9), distortion=p), "c: distortion needs 2 numbers"),
        (lambda p: Camera("c", "c", "eucm", (9, 9), rotation=p), "c: rotation needs a 3x3 rotation matrix"),
        (lambda p: Camera("c", "c", "eucm", (9, 9), intrinsics=p), "c: intrinsics needs 4 numbers"),
        (lambda p: Lidar("l", "l", time_offset=p), "l: time_offset needs 1 number, but"),
        (lambda p: Wheels("w", "w", radii=p), "w: radii needs 2 numbers"),
        (lambda p: PoseSensor("p", "p", translation=p), "p: translation needs 3 numbers"),
        (lambda p: ImuSensor("i", "i", ImuNoise(1, 1, 1, 1), intrinsics=p), "i: intrinsics needs 24 numbers"),
    ],
)
def test_a_value_of_another_size_is_refused_by_the_sensor(make: Callable[[Parameter], object], words: str):
    with pytest.raises(RigError, match=re.escape(words)):
        make(icalib.guess(np.arange(5.0)))


def test_with_changes_one_thing_and_names_what_there_is():
    rig = Rig(
        by_name(
            ImuSensor("imu0", "imu0", ImuNoise(1, 1, 1, 1)),
            Camera("cam0", "cam0", "eucm", (9, 9)),
            Camera("cam1", "cam1", "eucm", (9, 9)),
            Lidar("lidar0", "lidar0"),
        )
    )
    kept = icalib.fixed([1.0, 2.0, 3.0, 4.0])
    changed = rig.with_("cam1", intrinsics=kept).with_("settings", loss="cauchy").with_(gravity=9.80665)
    assert changed.cameras == (rig.cameras[0], Camera("cam1", "cam1", "eucm", (9, 9), intrinsics=kept))
    assert changed.settings == Settings(loss="cauchy") and changed.gravity == 9.80665
    assert (changed.imu, changed.lidars, rig.gravity) == (rig.imu, rig.lidars, 9.806)
    assert rig.with_("imu0", gyro_unit="deg/s").imu == ImuSensor(
        "imu0", "imu0", ImuNoise(1, 1, 1, 1), gyro_unit="deg/s"
    )
    assert rig.with_(cameras=(), imu=None).sensors == {"lidar0": rig.lidars[0]}
    with pytest.raises(RigError, match=r"no sensor cam2; the rig has settings, imu0, cam0, cam1, lidar0\."):
        rig.with_("cam2", intrinsics=kept)
    with pytest.raises(RigError, match=r"cam1 has no field intrinsic, did you mean 'intrinsics'; available are "):
        rig.with_("cam1", intrinsic=kept)
    with pytest.raises(RigError, match=r"cam1: intrinsics must be a parameter; write icalib.guess"):
        rig.with_("cam1", intrinsics=[1.0, 2.0, 3.0, 4.0])
    with pytest.raises(RigError, match=r"settings: loss is none, huber, cauchy, not 'cachy'; use one of these\."):
        rig.with_("settings", loss="cachy")


def test_sensors_stand_by_kind_and_within_a_kind_as_given():
    imu, poses = ImuSensor("imu0", "", ImuNoise(1, 1, 1, 1)), PoseSensor("mocap0", "")
    rear, front, wheels = Lidar("rear", ""), Lidar("front", ""), Wheels("wheel0", "")
    rig = Rig(by_name(poses, rear, wheels, imu, front))
    assert list(rig.sensors) == ["imu0", "rear", "front", "wheel0", "mocap0"]
    assert rig.mounted == (rear, front, wheels, poses) and rig.of(Lidar) == rig.lidars == (rear, front)
    assert list(rig.only("front", "imu0", gravity=9.8).sensors) == ["imu0", "front"]
    fewer = rig.without("imu0", "rear", "wheel0", gravity=9.8)
    assert list(fewer.sensors) == ["front", "mocap0"] and (fewer.gravity, fewer.imu) == (9.8, None)
    there = icalib.fixed([1.0, 2.0, 3.0])
    moved = rig.with_sensors(Lidar("rear", "", translation=there), Lidar("roof", ""))
    assert [x.name for x in moved.lidars] == ["rear", "front", "roof"] and moved.lidars[0].translation is there
    with pytest.raises(RigError, match="the rig has two sensors called rear; rename one"):
        by_name(rear, poses, PoseSensor("rear", ""))
