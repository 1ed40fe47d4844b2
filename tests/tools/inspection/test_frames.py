"""The frames of transforms: they are listed, and a pose sensor of two of them is suggested."""

from __future__ import annotations

import json

import numpy as np
import pytest

from icalib.cli import main
from icalib.data.recordings import open_recording
from icalib.rig.file import load_rig
from icalib.sensors.pose.read import readings as pose_readings
from icalib.tools.inspection import inspect_recording

STEP = 20_000_000
KIND = "tf2_msgs/msg/TFMessage"


def transform(bags, stamp_ns, parent, child, angle):
    turn = bags.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, float(np.sin(angle / 2)), float(np.cos(angle / 2)))
    pose = bags.make("geometry_msgs/msg/Transform", bags.make("geometry_msgs/msg/Vector3", 0.1, 0.2, 0.3), turn)
    return bags.make("geometry_msgs/msg/TransformStamped", bags.header(stamp_ns, parent), child, pose)


@pytest.fixture
def arm(bags, tmp_path):
    """A camera beside an arm of two joints on a cart, whose tool and finger do not move."""
    messages = bags.noise("/cam0/image_raw")
    for k in range(50):
        t = bags.origin_ns + k * STEP
        links = [("base", "upper", 0.02 * k), ("upper", "flange", 0.01 * k), ("flange", "finger", 0.1)]
        moved = [transform(bags, t, *link) for link in links]
        messages.append(("/arm/tf", KIND, t, bags.make(KIND, moved)))
    fixed = [transform(bags, bags.origin_ns, *link, 0.5) for link in (("cart", "base"), ("flange", "tool"))]
    messages.append(("/arm/tf_static", KIND, bags.origin_ns, bags.make(KIND, fixed)))
    return bags.write(tmp_path / "run", messages)


def test_frames_are_listed(arm, tmp_path, capsys):
    found = {f"{f.parent} {f.child}": f for f in inspect_recording(arm).frames}
    assert list(found) == ["base upper", "cart base", "flange finger", "flange tool", "upper flange"]
    assert [f.moves for f in found.values()] == [True, False, False, False, True]
    assert "frames of /arm/tf are aligned to the cameras" in inspect_recording(arm).findings[0].sentence
    assert [f.count for f in found.values()] == [50, 1, 50, 1, 50]
    assert (found["base upper"].rate_hz, found["cart base"].rate_hz) == (50.0, None)
    path = tmp_path / "figures.json"
    main(["inspect", str(arm), "--json", str(path)])
    shown = capsys.readouterr().out
    assert "Frames" in shown and "upper -> flange" in shown
    first = json.loads(path.read_text())["frames"][0]
    assert first == {
        "topic": "/arm/tf",
        "parent": "base",
        "child": "upper",
        "count": 50,
        "rate_hz": 50.0,
        "moves": True,
    }


def test_a_pose_sensor_is_suggested(arm, tmp_path):
    path = tmp_path / "rig.yaml"
    assert main(["inspect", str(arm), "--rig", str(path), "-q"]) == 0
    text = path.read_text()
    for name, value in (("rows", "7"), ("cols", "6"), ("tag_size", "0.088"), ("tag_spacing", "0.3")):
        text = text.replace(f"  {name}: ", f"  {name}: {value} ", 1)
    path.write_text(text)
    assert load_rig(path).poses == ()
    commented = text.split("docs/rig-file.md#pose-sensor).\n")[1].splitlines()[:5]
    path.write_text(text.replace("\n".join(commented), "\n".join("  " + line[4:] for line in commented)))
    (sensor,) = load_rig(path).poses
    assert (sensor.name, sensor.topic, sensor.frames, sensor.kind) == ("tf0", "/arm/tf", ("base", "flange"), "absolute")
    assert len(pose_readings(open_recording(arm), sensor).stamps_ns) == 50


def test_beside_an_imu_frames_are_enough(bags, brief, tmp_path):
    messages = bags.imu("/imu0", brief)
    for k in range(100):
        link = transform(bags, bags.origin_ns + k * STEP, "odom", "base", 0.02 * k)
        messages.append(("/tf", KIND, bags.origin_ns + k * STEP, bags.make(KIND, [link])))
    bag, path = bags.write(tmp_path / "run", messages), tmp_path / "rig.yaml"
    assert not any("only an IMU" in f.sentence for f in inspect_recording(bag).findings)
    assert main(["inspect", str(bag), "--rig", str(path), "-q"]) == 0
    (sensor,) = load_rig(path).poses
    assert (sensor.topic, sensor.frames, sensor.kind) == ("/tf", ("odom", "base"), "relative")


def test_transforms_that_cannot_be_read(bags, tmp_path):
    """A note says so; the rest is inspected."""
    messages = bags.noise("/cam0/image_raw")
    for k in range(3):
        broken = transform(bags, bags.origin_ns + k, "base", "flange", np.nan)
        messages.append(("/tf", KIND, bags.origin_ns + k, bags.make(KIND, [broken])))
    found = inspect_recording(bags.write(tmp_path / "run", messages))
    assert found.frames == () and list(found.sources.of("camera")) == ["cam0"]
    assert any("the transform base -> flange at" in note for note in found.notes)
