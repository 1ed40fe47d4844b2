"""URDF: written and updated files as ROS's own parser reads them, with forward kinematics by hand."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from urdf_parser_py.urdf import URDF

from icalib.cli import main
from icalib.errors import CalibrationError
from icalib.export.formats import export
from icalib.export.ros import read_urdf
from icalib.result import Calibration

ROBOT = """\
<?xml version="1.0" encoding="utf-8"?>
<!-- The rover. Kept by hand: "do > not" touch <!- -->
<robot name="rover">
\t<material name="grey"><color rgba="1 1 1 1"/></material>   <!-- odd   spacing -->
  <link name='base_link' />
  <link name="imu0"><visual><origin xyz="9 9 9" rpy="1 1 1"/><geometry><box size="1 1 1"/></geometry></visual></link>
  <joint name="imu_joint" type="fixed">
    <origin rpy="0.1 -0.2 1.3"   xyz="0.5 0.1 0.3"/>
    <parent link="base_link"/><child link="imu0"/>
  </joint>
  <link name="mast"/>
  <joint name="mast_joint" type="fixed"><parent link="base_link"/><child link="mast"/><origin xyz="0 0 1"/></joint>
  <link name="cam0"/>
  <joint name="cam0_joint" type="fixed">
    <!-- measured with a ruler -->
    <parent link="mast"/>
    <child link="cam0"/>
    <origin
        xyz='0.1   0 0'
        rpy="0 0 0" ></origin>
  </joint>
  <link name="right_eye"/>
  <joint name="right_eye_joint" type="fixed">
    <parent link="cam0"/>
    <child link="right_eye"/>
  </joint>
  <link name="lidar0"/>
  <joint type="fixed" name="a > b"><parent link="imu0"/><child link="lidar0"/><origin/></joint>
  <link name="wheel"/>
  <joint name="drive" type="continuous"><parent link="base_link"/><child link="wheel"/><axis xyz="0 1 0"/></joint>
  <transmission name="t">
    <type>simple</type>
    <joint name="drive"><hardwareInterface>effort</hardwareInterface></joint>
    <actuator name="motor"/>
  </transmission>
</robot>
"""
FRAMES = {"cam1": "right_eye"}


def T_of(urdf: URDF, frame: str, link: str) -> np.ndarray:
    """p_frame = T p_link by the joints from the root, all movable ones at zero."""

    def from_root(name: str) -> np.ndarray:
        if name not in urdf.parent_map:
            return np.eye(4)
        joint_name, parent = urdf.parent_map[name]
        origin = urdf.joint_map[joint_name].origin
        T = np.eye(4)
        if origin is not None:
            T[:3, 3] = origin.xyz or [0, 0, 0]
            T[:3, :3] = Rotation.from_euler("xyz", origin.rpy or [0, 0, 0]).as_matrix()
        return from_root(parent) @ T

    return np.linalg.inv(from_root(frame)) @ from_root(link)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "rover.urdf"
    path.write_text(ROBOT)
    return path


def updated(c: Calibration, file: Path, frames: dict[str, str] | None = None) -> str:
    return export(c, "urdf", FRAMES if frames is None else frames, file).files[file.name]


def masked(text: str) -> str:
    """Without the values of xyz and rpy of joints' origins."""
    return re.sub(r"(xyz|rpy)(\s*=\s*)([\"'])[^\"']*\3", r"\1\2\3\3", text)


def test_a_robot_of_the_sensors(robot: Calibration):
    found = export(robot, "urdf", {"imu0": "imu_link", "cam0": "left & right"})
    text = found.files["sensors.urdf"]
    urdf = URDF.from_xml_string(text.encode())
    assert urdf.get_root() == "imu_link" and len(urdf.links) == 5
    for name in robot.mounted:
        link = {"cam0": "left & right"}.get(name, name)
        np.testing.assert_allclose(T_of(urdf, "imu_link", link), robot.T_imu_sensor(name), atol=1e-12)
    assert any("URDF has no place for the time offset of cam0" in s for s in found.sentences)
    assert "p_parent = T p_child" in text


def test_an_existing_file_gets_the_calibrated_poses(robot: Calibration, file: Path):
    """Through the mast, below another sensor that moves, without an origin, with an empty one."""
    text = updated(robot, file)
    urdf = URDF.from_xml_string(text.encode())
    for sensor, link in (("cam0", "cam0"), ("cam1", "right_eye"), ("lidar0", "lidar0")):
        np.testing.assert_allclose(T_of(urdf, "imu0", link), robot.T_imu_sensor(sensor), atol=1e-12)
    before = URDF.from_xml_string(ROBOT.encode())
    for link in ("imu0", "mast", "wheel"):
        np.testing.assert_array_equal(T_of(urdf, "base_link", link), T_of(before, "base_link", link))


def test_nothing_else_changes(robot: Calibration, file: Path):
    text = updated(robot, file)
    inserted = re.sub(r'\n    <origin xyz="[^"]*" rpy="[^"]*"/>(?=\n    <parent link="cam0"/>)', "", text)
    assert inserted != text
    last = '</joint>\n  <link name="wheel"'
    lidar = re.sub(rf'<origin xyz="[^"]*" rpy="[^"]*"/>{last}', f"<origin/>{last}", inserted)
    assert masked(lidar) == masked(ROBOT)
    kept = [line for line in ROBOT.splitlines() if "xyz" not in line and "rpy" not in line and "origin" not in line]
    assert set(kept) <= set(text.splitlines())
    kept = ('rpy="0.1 -0.2 1.3"   xyz="0.5 0.1 0.3"', '<origin xyz="9 9 9" rpy="1 1 1"/>', '<origin xyz="0 0 1"/>')
    for untouched in kept:
        assert untouched in text


def test_updating_twice_is_updating_once(robot: Calibration, file: Path):
    once = updated(robot, file)
    file.write_text(once)
    twice = updated(robot, file)
    one, two = (URDF.from_xml_string(text.encode()) for text in (once, twice))
    for link in ("cam0", "right_eye", "lidar0"):
        np.testing.assert_allclose(T_of(one, "imu0", link), T_of(two, "imu0", link), atol=1e-14)
    assert masked(once) == masked(twice)


def test_line_ends_and_other_encodings_stay(robot: Calibration, tmp_path: Path):
    robot.save(tmp_path / "out")
    file, out = tmp_path / "rover.urdf", tmp_path / "new.urdf"
    old = ROBOT.replace("utf-8", "iso-8859-1").replace("The rover", "Der Käfer").replace("\n", "\r\n").encode("latin-1")
    file.write_bytes(old)
    arguments = ["export", str(tmp_path / "out"), "--to", "urdf", "-o", str(out), "--urdf", str(file), "-q"]
    assert main([*arguments, "--frame", "cam1=right_eye"]) == 0
    new = out.read_bytes()
    assert "Der Käfer".encode("latin-1") in new and new.count(b"\r\n") == new.count(b"\n") == old.count(b"\r\n") + 2
    assert file.read_bytes() == old
    np.testing.assert_allclose(T_of(URDF.from_xml_string(new), "imu0", "cam0"), robot.T_imu_sensor("cam0"), atol=1e-12)
    # In place.
    assert main([*arguments[:5], str(file), *arguments[6:], "--frame", "cam1=right_eye"]) == 0
    assert file.read_bytes() == new


def test_a_xacro_file_is_updated_and_still_expands(robot: Calibration, tmp_path: Path):
    file = tmp_path / "rover.urdf.xacro"
    text = ROBOT.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ')
    text = text.replace("<material", '<xacro:property name="height" value="${0.5 * 2}"/>\n  <material')
    text = text.replace("""xyz='0.1   0 0'""", """xyz='${height} 0 0'""")
    file.write_text(text)
    new = updated(robot, file)
    assert '<xacro:property name="height" value="${0.5 * 2}"/>' in new and "${height}" not in new
    (tmp_path / "new.xacro").write_text(new)
    command = [
        sys.executable,
        "-c",
        "import sys, xacro; print(xacro.process(sys.argv[1]))",
        str(tmp_path / "new.xacro"),
    ]
    expanded = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for sensor, link in (("cam0", "cam0"), ("cam1", "right_eye"), ("lidar0", "lidar0")):
        np.testing.assert_allclose(
            T_of(URDF.from_xml_string(expanded.encode()), "imu0", link), robot.T_imu_sensor(sensor), atol=1e-12
        )


def test_sensors_without_a_link_are_said(robot: Calibration, file: Path):
    found = export(robot, "urdf", {}, file)
    assert "rover.urdf has no link cam1, so cam1 was left out." in found.sentences
    assert "rover.urdf has no link wheel0, so wheel0 was left out." in found.sentences


def test_poses_in_a_file_are_read_as_ros_does(file: Path):
    tree, urdf = read_urdf(file), URDF.from_xml_string(ROBOT.encode())
    for frame, link in (("base_link", "right_eye"), ("imu0", "cam0"), ("cam0", "imu0"), ("lidar0", "mast")):
        np.testing.assert_allclose(tree.T(frame, link), T_of(urdf, frame, link), atol=1e-14)
    assert tree.links[:3] == ("base_link", "imu0", "mast")


@pytest.mark.parametrize(
    ("old", "new", "frames", "words"),
    [
        ("</robot>", "", {}, "rover.urdf:3[0-9]: this is not XML"),
        ("robot", "rob", {}, "has <rob> where a URDF has <robot>"),
        ("", "", {"cam0": "eye"}, "there is no link eye; it has base_link, .*; say which is cam0: --frame cam0=LINK"),
        ("", "", {"imu0": "imu"}, "there is no link imu; it has .*: --frame imu0=LINK"),
        ('cam0_joint" type="fixed"', 'cam0_joint" type="revolute"', {}, "joint cam0_joint above cam0 is revolute"),
        ('mast_joint" type="fixed"', 'mast_joint" type="prismatic"', {}, "joint mast_joint is prismatic, not"),
        ('xyz="0 0 1"', 'xyz="0 0 ${h}"', {}, r'joint mast_joint: xyz="0 0 \$\{h\}" is not three plain numbers'),
        *(('xyz="0 0 1"', f'xyz="0 0 {x}"', {}, "is not three plain numbers") for x in ("nan", "-inf", "1e200")),
        ("", "", {"cam0": "base_link"}, "base_link is the root, so no joint can be set for it"),
        ("", "", {"imu0": "right_eye"}, "right_eye is below cam0; the sensors' links must not be above"),
        ('<child link="mast"/>', '<child link="cam0"/>', {}, "cam0 is the child of mast_joint and cam0_joint"),
        ('<parent link="mast"/>', '<parent link="right_eye"/>', {}, "is above itself; correct the parents"),
        ('base_link"/><child link="mast"/>', 'x"/><child link="mast"/>', {}, "joined; their roots are base_link and x"),
    ],
)
def test_what_cannot_be_updated_is_one_sentence(
    robot: Calibration, file: Path, old: str, new: str, frames: dict[str, str], words: str
):
    text = ROBOT.replace(old, new) if old else ROBOT
    assert not old or text != ROBOT
    file.write_text(text)
    with pytest.raises(CalibrationError, match=words) as error:
        updated(robot, file, frames)
    assert "\n" not in str(error.value)


def test_a_macro_is_not_changed(robot: Calibration, file: Path):
    head = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="rover"><xacro:macro name="m" params="x">'
    text = ROBOT.replace('<robot name="rover">', head).replace("</robot>", "</xacro:macro></robot>")
    file.write_text(text)
    with pytest.raises(CalibrationError, match="joint cam0_joint stands in a xacro macro, where a change would be one"):
        updated(robot, file)


def test_a_file_with_none_of_the_sensors(robot: Calibration, file: Path):
    c = dataclasses.replace(robot, groups=robot.groups)
    file.write_text(ROBOT.replace('"cam0"', '"a"').replace('"lidar0"', '"b"'))
    with pytest.raises(CalibrationError, match="there is no link cam0; .*say which is cam0: --frame cam0=LINK"):
        updated(c, file, {})


def test_a_joint_further_up_is_set(robot: Calibration, file: Path):
    """The optical frame stays where it is on its camera."""
    found = export(robot, "urdf", FRAMES | {"cam0": "right_eye", "cam1": "mast"}, file, {"cam0": "cam0_joint"})
    old, new = (URDF.from_xml_string(text.encode()) for text in (ROBOT, found.files[file.name]))
    np.testing.assert_allclose(T_of(new, "imu0", "right_eye"), robot.T_imu_sensor("cam0"), atol=1e-12)
    np.testing.assert_allclose(T_of(new, "imu0", "mast"), robot.T_imu_sensor("cam1"), atol=1e-12)
    np.testing.assert_allclose(T_of(new, "cam0", "right_eye"), T_of(old, "cam0", "right_eye"), atol=1e-14)
    with pytest.raises(
        CalibrationError, match="no joint drive above cam0; above it are cam0_joint, mast_joint; correct"
    ):
        export(robot, "urdf", FRAMES, file, {"cam0": "drive"})
