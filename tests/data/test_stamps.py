"""The stamps of a topic alone, in every kind of recording."""

from __future__ import annotations

import pytest
from tests.cases import each

from icalib.data.recordings import open_recording
from icalib.errors import RecordingError


@each("form", ["ros1", "ros2 sqlite3", "mcap"])
def test_of_a_bag(form, tmp_path, truth, write):
    recording = open_recording(write.small(form, tmp_path, truth))
    for topic in ("/cam0/image_raw", "/cam1/compressed"):
        assert recording.stamps(topic).tolist() == truth.image_stamps
    assert recording.stamps("imu0").tolist() == truth.imu_stamps
    with pytest.raises(RecordingError, match=r"has no topic /away; it holds /cam0"):
        recording.stamps("/away")


def test_of_a_folder(tmp_path, truth, write):
    root = write.euroc(tmp_path / "euroc", truth)
    corners = root / "mav0/cam1/corners.csv"
    corners.write_text("".join(f"{t},0,{c},1.0,2.0\n" for t in (5, 7) for c in (0, 1)))
    recording = open_recording(root)
    assert recording.stamps("cam0").tolist() == truth.image_stamps
    assert recording.stamps("imu0/data.csv").tolist() == truth.imu_stamps
    assert recording.stamps("cam1/corners.csv").tolist() == [5, 7]
    with pytest.raises(RecordingError, match="has no topic cam7"):
        recording.stamps("cam7")


def test_of_a_type_that_icalib_does_not_read(tmp_path, write):
    make = write.maker()
    text = make.make("std_msgs/msg/String", "hello")
    recording = open_recording(write.ros2(tmp_path / "run", [("/chatter", "std_msgs/msg/String", 5, text)]))
    with pytest.raises(RecordingError, match="icalib does not read std_msgs/msg/String; choose another topic"):
        recording.stamps("/chatter")
