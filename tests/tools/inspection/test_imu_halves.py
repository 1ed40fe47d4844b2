"""An IMU whose gyroscope and accelerometer have separate stamps: found in a bag, drafted, joined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.data.measurements import ImuStream
from icalib.data.recordings import open_recording
from icalib.data.stamps import ClockJumps
from icalib.errors import EstimationError, RecordingError
from icalib.rig import ImuSensor, TableLayout, TwoSources
from icalib.sensors.imu.inspect import imu_lines
from icalib.sensors.imu.read import read_imu
from icalib.sensors.imu.read import readings as imu_readings
from icalib.sensors.imu.spec import class_noise
from icalib.tools.allan.analysis import study_recording
from icalib.tools.inspection import draft_rig, inspect_recording

IMU = ImuSensor("imu0", "imu0/data.csv", class_noise("consumer"))
HALVES = TwoSources("/d435/gyro/sample", "/d435/accel/sample")
OFFSET = 1_300_000  # ns between the stamps of the two


def apart(imu: ImuStream) -> tuple[ImuStream, ImuStream]:
    """As RealSense's driver sends them: the accelerometer at half the rate, the other sensor's fields at zero."""
    gyro = replace(imu, accel=np.zeros_like(imu.accel))
    stamps = imu.stamps_ns[4:-4:2] + OFFSET
    t = (stamps - imu.stamps_ns[0]).astype(float)
    accel = np.stack(
        [np.interp(t, (imu.stamps_ns - imu.stamps_ns[0]).astype(float), imu.accel[:, k]) for k in range(3)]
    )
    return gyro, ImuStream(imu.name, stamps, np.zeros((len(stamps), 3)), accel.T.copy())


@pytest.fixture()
def bag(brief, bags, tmp_path):
    gyro, accel = apart(brief)
    messages = bags.imu(HALVES.gyro, gyro) + bags.imu(HALVES.accel, accel) + bags.noise("/cam0/image_raw")
    return bags.write(tmp_path / "run", messages)


def joined(recording, sensor: ImuSensor) -> tuple[ImuStream, tuple[str, ...]]:
    return read_imu(recording, sensor, ClockJumps().cut)


@pytest.mark.parametrize("topic", [None, HALVES, HALVES.gyro, HALVES.accel])
def test_the_two_topics_are_joined(bag, brief, topic):
    found, notes = joined(open_recording(bag), replace(IMU, topic=topic))
    assert (
        "/d435/gyro/sample and /d435/accel/sample (imu0): gyroscope and accelerometer have separate stamps" in notes[0]
    )
    own = np.isin(brief.stamps_ns, found.stamps_ns)
    assert own.sum() == len(found.stamps_ns) > 0.97 * len(brief.stamps_ns)
    np.testing.assert_array_equal(found.gyro, brief.gyro[own])
    # The accelerometer's noise, and what a straight line over 10 ms leaves of the motion.
    assert np.sqrt(((found.accel - brief.accel[own]) ** 2).mean()) < 0.06


def test_two_whole_imus_are_not_mixed(brief, bags, tmp_path):
    bag = bags.write(tmp_path / "run", bags.imu("/a/imu", brief) + bags.imu("/b/imu", brief))
    with pytest.raises(RecordingError, match="imu0 may be any of /a/imu, /b/imu"):
        imu_readings(open_recording(bag), IMU)


def test_inspect_drafts_both_topics(bag):
    found = inspect_recording(bag)
    assert not any("same reading" in f.sentence for f in found.findings), found.findings
    assert list(found.sources.of("imu")) == ["imu0"]
    assert "topic: {gyro: /d435/gyro/sample, accel: /d435/accel/sample}" in draft_rig(found)


def write_tables(folder, imu: ImuStream) -> None:
    gyro, accel = apart(imu)
    folder.mkdir()
    for name, stamps, values in (("gyro", gyro.stamps_ns, gyro.gyro), ("accel", accel.stamps_ns, accel.accel)):
        lines = [f"{t},{','.join(map(repr, row))}" for t, row in zip(stamps, values.tolist(), strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["#t [ns],x,y,z", *lines]))


def test_two_tables(tmp_path, brief):
    write_tables(tmp_path / "phone", brief)
    found, notes = joined(open_recording(tmp_path), replace(IMU, path=TwoSources("phone/gyro.csv", "phone/accel.csv")))
    assert len(notes) == 1 and "interpolated" in notes[0]
    np.testing.assert_allclose(found.gyro, brief.gyro[np.isin(brief.stamps_ns, found.stamps_ns)])


def columns_moved(table, order: str) -> None:
    """Writes the columns t, x, y, z in another order, without a header."""
    rows = [line.split(",") for line in table.read_text().splitlines()[1:]]
    table.write_text("\n".join(",".join(row["txyz".index(c)] for c in order) for row in rows))


@pytest.mark.parametrize(
    ("order", "columns"), [("xyzt", ["4", "1", "2", "3"]), ("zxyt", ["4", "2", "3", "1", "2", "3", "1"])]
)
def test_columns_hold_for_both_tables(tmp_path, brief, order, columns):
    write_tables(tmp_path / "phone", brief)
    for name in ("gyro", "accel"):
        columns_moved(tmp_path / f"phone/{name}.csv", order)
    sensor = replace(IMU, path=TwoSources("phone/gyro.csv", "phone/accel.csv"), layout=TableLayout(tuple(columns)))
    recording = open_recording(tmp_path)
    recording.use_layouts([sensor])
    assert [t.first_ns for t in recording.topics()] == [brief.stamps_ns[0], brief.stamps_ns[4] + OFFSET]
    found, _ = joined(recording, sensor)
    np.testing.assert_allclose(found.gyro, brief.gyro[np.isin(brief.stamps_ns, found.stamps_ns)])


def test_tables_whose_first_column_is_no_stamp_ask_for_columns(tmp_path, brief):
    write_tables(tmp_path / "phone", brief)
    columns_moved(tmp_path / "phone/gyro.csv", "xyzt")
    found = inspect_recording(tmp_path)
    said = " ".join(f.sentence for f in found.findings if f.severity == "problem")
    assert "gyro.csv: its first column often falls, so it is no stamp; say which are t [ns], wx" in said


def test_wrong_columns_of_two_tables_are_said(tmp_path, brief):
    write_tables(tmp_path / "phone", brief)
    sensor = replace(
        IMU, path=TwoSources("phone/gyro.csv", "phone/accel.csv"), layout=TableLayout(("t [ns]", "x", "y"))
    )
    with pytest.raises(RecordingError, match=r"gyro.csv: `columns` in the rig file needs 4 names"):
        joined(open_recording(tmp_path), sensor)


@pytest.mark.parametrize("names", [("gyro", "accel"), ("rec_GYRO", "rec_ACCL"), ("gyroscope", "accelerometer")])
@pytest.mark.parametrize("folder", ["phone", "."])
def test_inspect_drafts_both_tables(tmp_path, brief, names, folder):
    write_tables(tmp_path / "made", brief)
    (tmp_path / "run" / folder).mkdir(parents=True)
    for was, name in zip(("gyro", "accel"), names, strict=True):
        (tmp_path / "made" / f"{was}.csv").rename(tmp_path / "run" / folder / f"{name}.csv")
    found = inspect_recording(tmp_path / "run")
    assert list(found.sources.of("imu")) == ["imu0"] and not found.facts["imu0"].problem
    gyro, accel = ((f"{folder}/" if folder != "." else "") + f"{name}.csv" for name in names)
    lines = "\n".join(imu_lines(found, found.sources.of("imu")))
    assert f"path: {{gyro: {gyro}, accel: {accel}}}" in lines


def test_allan_takes_both_tables(tmp_path, brief):
    write_tables(tmp_path / "phone", brief)
    with pytest.raises(EstimationError, match="at rest"):  # it is waved about
        study_recording(tmp_path)


def test_clocks_that_have_nothing_in_common(tmp_path, brief):
    write_tables(tmp_path / "phone", brief)
    table = tmp_path / "phone/accel.csv"
    table.write_text("\n".join(line.replace("17000000", "17000001") for line in table.read_text().splitlines()))
    with pytest.raises(RecordingError, match=r"less than 1 s in common"):
        joined(open_recording(tmp_path), replace(IMU, path=TwoSources("phone/gyro.csv", "phone/accel.csv")))
