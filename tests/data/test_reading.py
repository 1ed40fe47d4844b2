"""A folder and a rig -> measurements, and every complaint on the way."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each
from tests.remarks import named
from tests.typed import not_none

from icalib.data.measurements import CornerStream, Measurements
from icalib.data.recordings import open_recording, read_measurements
from icalib.errors import RecordingError
from icalib.geometry.targets import AprilGrid
from icalib.rig import Camera, ImuSensor, Rig, by_name
from icalib.sensors.camera.read.detected_corners import checked_corners
from icalib.sensors.imu.spec import class_noise

ORIGIN = 1_404_733_405_732_800_001
IMU_STEP, IMAGE_STEP = 5_000_000, 50_000_000


def a_rig(cameras: int = 1) -> Rig:
    imu = ImuSensor("imu0", "imu0/data.csv", class_noise("consumer"))
    names = [f"cam{k}" for k in range(cameras)]
    cams = tuple(Camera(n, f"{n}/corners.csv", "pinhole-radtan", (752, 480)) for n in names)
    return Rig(by_name(imu, *cams), AprilGrid(6, 6, 0.088, 0.3))


def imu_rows(n: int = 200) -> list[list[float]]:
    rng = np.random.default_rng(0)
    gyro, accel = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)) + [0, 0, 9.81]
    return [[ORIGIN + k * IMU_STEP, *gyro[k], *accel[k]] for k in range(n)]


def corner_rows(images: int = 5, corners: int = 8) -> list[list[float]]:
    return [
        [ORIGIN + i * IMAGE_STEP, c // 4, c % 4, 100.0 + 10 * c + i, 200.0 + i]
        for i in range(images)
        for c in range(corners)
    ]


def write(path: Path, rows: list[list[float]], header: str = "") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(header + "".join(",".join(repr(x) for x in map(_plain, row)) + "\n" for row in rows))


def _plain(x: float) -> float:
    return int(x) if isinstance(x, int | np.integer) else float(x)


def read(folder: Path, imu: list[list[float]] | None = None, corners: list[list[float]] | None = None) -> Measurements:
    write(folder / "imu0/data.csv", imu_rows() if imu is None else imu)
    write(folder / "cam0/corners.csv", corner_rows() if corners is None else corners, "t_ns,tag_id,corner,u,v\n")
    return read_measurements(open_recording(folder), a_rig())


def complaint(folder: Path, **tables: list[list[float]]) -> str:
    with pytest.raises(RecordingError) as error:
        read(folder, **tables)
    sentence = str(error.value)
    assert "\n" not in sentence and sentence.endswith(".")
    return sentence


def test_reads_what_was_written(tmp_path):
    m = read(tmp_path)
    assert m.notes == ()
    assert not_none(m.imu).stamps_ns.tolist() == [row[0] for row in imu_rows()]
    np.testing.assert_allclose(
        np.hstack([not_none(m.imu).gyro, not_none(m.imu).accel]), [r[1:] for r in imu_rows()], rtol=1e-15
    )
    cam = m.cameras[0]
    assert cam.stamps_ns[cam.image].tolist() == [row[0] for row in corner_rows()]
    assert cam.point.tolist() == [4 * r[1] + r[2] for r in corner_rows()]
    assert cam.uv.tolist() == [r[3:] for r in corner_rows()]


def test_files_are_those_read_each_once(tmp_path):
    read(tmp_path)
    recording = open_recording(tmp_path)
    assert recording.files() == []
    for _ in range(2):
        read_measurements(recording, a_rig())
    assert recording.files() == [tmp_path / "imu0/data.csv", tmp_path / "cam0/corners.csv"]


def test_euroc_folder_and_gzip(tmp_path):
    header = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],y,z\r\n"
    write(tmp_path / "mav0/imu0/data.csv", imu_rows(), header)
    plain = tmp_path / "mav0/cam0/corners.csv"
    write(plain, corner_rows())
    (tmp_path / "mav0/cam0/corners.csv.gz").write_bytes(gzip.compress(plain.read_bytes()))
    plain.unlink()
    recording = open_recording(tmp_path)
    assert len(not_none(read_measurements(recording, a_rig()).imu).stamps_ns) == 200
    assert [p.name for p in recording.files()] == ["data.csv", "corners.csv.gz"]


def test_whole_real_recording_is_read_exactly(euroc):
    m = read_measurements(open_recording(euroc), a_rig(2))
    assert [len(c.uv) for c in m.cameras] == [179524, 178764]
    rows = [r.split(",") for r in gzip.decompress((euroc / "imu0/data.csv.gz").read_bytes()).decode().split()[1:]]
    assert not_none(m.imu).stamps_ns.tolist() == [int(r[0]) for r in rows]
    assert not_none(m.imu).gyro[:, 2].tolist() == [float(r[3]) for r in rows]
    assert m.notes == ()


class TestFolder:
    def test_missing_recording_lists_its_neighbours(self, tmp_path):
        (tmp_path / "drive1").mkdir()
        with pytest.raises(RecordingError, match=r"drive2 does not exist; .* holds drive1"):
            open_recording(tmp_path / "drive2")

    def test_file_instead_of_folder(self, tmp_path):
        (tmp_path / "a.csv").write_text("1")
        with pytest.raises(RecordingError, match=r"a\.csv is neither a ROS 1 bag nor .*folder of tables"):
            open_recording(tmp_path / "a.csv")

    def test_missing_table_lists_what_there_is(self, tmp_path):
        write(tmp_path / "imu1/data.csv", imu_rows())
        with pytest.raises(
            RecordingError, match=r"has no imu0/data.csv \(nor .*\); it holds imu1/data.csv; set `path`"
        ):
            read_measurements(open_recording(tmp_path), a_rig())

    def test_empty_folder(self, tmp_path):
        with pytest.raises(RecordingError, match="the folder holds no files"):
            read_measurements(open_recording(tmp_path), a_rig())

    def test_unreadable_table(self, tmp_path, monkeypatch):
        read(tmp_path)

        def refuse(path: Path) -> bytes:
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr(Path, "read_bytes", refuse)
        with pytest.raises(RecordingError, match=r"data\.csv cannot be read \(Permission denied\)"):
            read_measurements(open_recording(tmp_path), a_rig())


class TestImu:
    def test_one_reading(self, tmp_path):
        assert "only 1 reading" in complaint(tmp_path, imu=imu_rows(1))

    def test_out_of_order_names_the_first_instant(self, tmp_path):
        rows = imu_rows()
        rows[50], rows[51] = rows[51], rows[50]
        sentence = complaint(tmp_path, imu=rows)
        assert f"{ORIGIN + 50 * IMU_STEP} ns comes after the one at {ORIGIN + 51 * IMU_STEP} ns" in sentence
        assert "imu0/data.csv" in sentence

    def test_exact_repeats_are_dropped_with_a_note(self, tmp_path):
        rows = imu_rows()
        m = read(tmp_path, imu=rows[:10] + rows[9:20] + rows[19:])
        assert len(not_none(m.imu).stamps_ns) == 200 and (np.diff(not_none(m.imu).stamps_ns) > 0).all()
        assert m.notes[0].name == "readings_repeated" and f" {ORIGIN + 9 * IMU_STEP} ns" in m.notes[0]

    def test_different_readings_at_one_instant(self, tmp_path):
        rows = imu_rows()
        rows[10][0] = rows[9][0]
        m = read(tmp_path, imu=rows)
        assert not_none(m.imu).stamps_ns.tolist() == [row[0] for row in rows if row[0] != rows[9][0]]
        assert m.notes[0].name == "readings_share_stamps"
        assert f"the first at {ORIGIN + 9 * IMU_STEP} ns" in m.notes[0]

    @pytest.mark.parametrize(("divisor", "unit"), [(1000, "microseconds"), (1_000_000, "milliseconds")])
    def test_other_units_of_time(self, tmp_path, divisor, unit):
        rows = [[r[0] // divisor, *r[1:]] for r in imu_rows()]
        m = read(tmp_path, imu=rows)
        assert not_none(m.imu).stamps_ns.tolist() == [r[0] * divisor for r in rows]
        assert f"the stamps are read as {unit}, as their rate shows" in m.notes[0]

    def test_whole_seconds(self, tmp_path):
        rows = [[r[0] // 1_000_000_000, *r[1:]] for r in imu_rows()]
        assert "as if stamps were truncated to whole seconds" in complaint(tmp_path, imu=rows)

    def test_too_slow(self, tmp_path):
        rows = [[ORIGIN + k * 500_000_000, *r[1:]] for k, r in enumerate(imu_rows())]
        assert "a rate of 2 Hz (10 to 20000 Hz expected)" in complaint(tmp_path, imu=rows)

    def test_degrees(self, tmp_path):
        rows = [[r[0], *np.rad2deg(r[1:4]), *r[4:]] for r in imu_rows()]
        assert "looks like deg/s; set gyro_unit: deg/s" in complaint(tmp_path, imu=rows)

    def test_g(self, tmp_path):
        rows = [[*r[:4], *(np.array(r[4:]) / 9.80665)] for r in imu_rows()]
        found = read(tmp_path, imu=rows)
        assert "9.80665 m/s^2" in named("accelerometer_in_g", found.notes)

    @pytest.mark.parametrize("factor", [0.01, 1000.0])
    def test_far_from_gravity(self, tmp_path, factor):
        rows = [[*r[:4], *(np.array(r[4:]) * factor)] for r in imu_rows()]
        assert "far from gravity" in complaint(tmp_path, imu=rows)

    def test_accelerometer_before_gyroscope(self, tmp_path):
        rows = [[r[0], *r[4:], 0.1 * r[1], 0.1 * r[2], 0.1 * r[3]] for r in imu_rows()]
        assert "The columns must be t [ns], gyroscope x, y, z" in complaint(tmp_path, imu=rows)

    @pytest.mark.parametrize(("columns", "kind"), [(slice(1, 4), "gyroscope"), (slice(4, 7), "accelerometer")])
    def test_frozen(self, tmp_path, columns, kind):
        rows = imu_rows()
        for row in rows:
            row[columns] = rows[0][columns]
        assert f"the {kind} gives the same reading from start to end" in complaint(tmp_path, imu=rows)

    @pytest.mark.parametrize(("column", "value", "name"), [(2, -4.36, "gyroscope y"), (6, 19.6, "accelerometer z")])
    def test_saturation_is_noted(self, tmp_path, column, value, name):
        rows = imu_rows()
        for row in rows[30:37]:
            row[column] = value
        note = read(tmp_path, imu=rows).notes[0]
        assert f"the {name} looks saturated, 7 readings in a row at {value:.4g}" in note
        assert f"from {ORIGIN + 30 * IMU_STEP} ns on" in note

    def test_four_equal_extremes_are_no_saturation(self, tmp_path):
        rows = imu_rows()
        for row in rows[30:34]:
            row[1] = 4.36
        assert read(tmp_path, imu=rows).notes == ()

    def test_coarse_readings_are_no_saturation(self, tmp_path):
        rows = [[r[0], *np.clip(np.round(r[1:4]), -1, 1), *r[4:]] for r in imu_rows()]
        rows[3:10] = [[r[0], 1.0, 1.0, 1.0, *r[4:]] for r in rows[3:10]]
        assert read(tmp_path, imu=rows).notes == ()


class TestCorners:
    def test_none(self, tmp_path):
        assert "cam0/corners.csv holds no rows" in complaint(tmp_path, corners=[])

    def test_out_of_order(self, tmp_path):
        rows = corner_rows()
        sentence = complaint(tmp_path, corners=rows[:8] + rows[16:24] + rows[8:16])
        assert f"the image at {ORIGIN + IMAGE_STEP} ns comes after the one at {ORIGIN + 2 * IMAGE_STEP} ns" in sentence

    def test_corner_twice_in_an_image(self, tmp_path):
        rows = corner_rows()
        rows[13][1:3] = rows[10][1:3]
        sentence = complaint(tmp_path, corners=rows)
        assert f"the image at {ORIGIN + IMAGE_STEP} ns has corner 2 of tag 0 twice" in sentence
        assert "cam0/corners.csv" in sentence

    @each(("column", "value", "words"), [(1, 36, "tag 36"), (1, -1, "tag -1"), (2, 4, "corner 4")])
    def test_not_on_the_target(self, tmp_path, column, value, words):
        rows = corner_rows()
        rows[17][column] = value
        rows[30][1] = 99
        sentence = complaint(tmp_path, corners=rows)
        assert f"in the image at {ORIGIN + 2 * IMAGE_STEP} ns, {words} is not" in sentence
        assert "cam0/corners.csv" in sentence

    @each(("u", "v"), [(-1.6, 0.0), (752.6, 0.0), (0.0, 480.6), (0.0, -1.6)])
    def test_outside_the_image(self, tmp_path, u, v):
        rows = corner_rows()
        for row in rows[9:14]:
            row[3:] = [u, v]
        sentence = complaint(tmp_path, corners=rows)
        assert f"corner 1 of tag 0 lies at ({u}, {v}), outside the image of 752 x 480 px; check" in sentence
        assert f"{ORIGIN + IMAGE_STEP} ns" in sentence

    @each(("u", "v"), [(-1.6, 0.0), (1e9, 200.0), (100.0, -1e300), (-4.2e4, 9e9)])
    def test_single_corners_outside_the_image_are_left_out(self, tmp_path, u, v):
        rows = corner_rows()
        rows[9][3:] = rows[17][3:] = [u, v]
        m = read(tmp_path, corners=rows)
        assert m.cameras[0].uv.tolist() == [r[3:] for k, r in enumerate(rows) if k not in (9, 17)]
        assert np.diff(m.cameras[0].start).tolist() == [8, 7, 7, 8, 8]
        assert "outside the image of 752 x 480 px; 2 of 40 such points were left out" in m.notes[0]

    @pytest.mark.parametrize(("u", "v"), [(-1.4, 0.0), (752.4, 480.4)])
    def test_a_step_over_the_edge_is_kept(self, tmp_path, u, v):
        rows = corner_rows()
        rows[9][3:] = [u, v]
        assert read(tmp_path, corners=rows).cameras[0].uv[9].tolist() == [u, v]

    def test_poor_images_are_dropped_with_a_note(self, tmp_path):
        rows = corner_rows()
        m = read(tmp_path, corners=rows[:8] + rows[8:11] + rows[16:20] + rows[24:26] + rows[32:])
        cam = m.cameras[0]
        assert np.diff(cam.start).tolist() == [8, 4, 8]
        assert cam.uv.tolist() == [r[3:] for r in rows[:8] + rows[16:20] + rows[32:]]
        assert f"2 images with fewer than 4 corners were dropped, the first at {ORIGIN + IMAGE_STEP} ns" in m.notes[0]

    def test_standard_deviations_stay_with_their_corners(self):
        start, uv = np.array([0, 4, 7, 15]), np.arange(30.0).reshape(15, 2)
        uv[2] = [-40.0, 5.0]
        sigma = 0.1 + np.arange(15.0)
        stamps = ORIGIN + IMAGE_STEP * np.arange(3)
        found = CornerStream("cam0", stamps, start, np.arange(15) % 8, uv, sigma=sigma)
        corners, notes = checked_corners(found, "here", (752, 480))
        assert corners.start.tolist() == [0, 8] and corners.stamps_ns.tolist() == [stamps[2]]
        assert corners.sigma.tolist() == sigma[7:].tolist() and corners.uv.tolist() == uv[7:].tolist()
        assert len(notes) == 2

    def test_only_poor_images(self, tmp_path):
        assert "no image has 4 corners or more" in complaint(tmp_path, corners=corner_rows(corners=3))

    def test_microseconds(self, tmp_path):
        rows = [[r[0] // 1000, *r[1:]] for r in corner_rows()]
        m = read(tmp_path, corners=rows)
        assert m.cameras[0].stamps_ns.tolist() == sorted({r[0] * 1000 for r in rows})
        assert "the stamps are read as microseconds" in m.notes[0]

    def test_one_image_is_for_later_stages_to_judge(self, tmp_path):
        assert len(read(tmp_path, corners=corner_rows(images=1)).cameras[0].stamps_ns) == 1
