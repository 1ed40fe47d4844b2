"""Tables of tracks, and the sentences on what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.cases import each

from icalib.data.recordings import open_recording, read_measurements
from icalib.errors import RecordingError, RigError
from icalib.rig.file import load_rig, rig_to_dict
from icalib.sensors.camera.read import read_tracks

GOOD = "#t [ns],feature,u [px],v [px]\n1000000000,7,10.5,20\n1000000000,3,11,21\n1050000000,7,10.75,20.25\n"
RIG = """
sensors:
  imu0: {type: imu}
  cam0:
    type: camera
    model: pinhole-radtan
    resolution: [752, 480]
    tracks: cam0/tracks.csv
    track_noise: 1.5
    intrinsics: {guess: [460, 460, 370, 240]}
"""


def read(tmp_path: Path, text: str):
    path = tmp_path / "tracks.csv"
    path.write_text(text)
    return read_tracks("cam0", path, (752, 480))


def test_a_table_is_read(tmp_path):
    stream = read(tmp_path, GOOD)
    assert stream.stamps_ns.tolist() == [1_000_000_000, 1_050_000_000]
    assert stream.start.tolist() == [0, 2, 3] and stream.feature.tolist() == [7, 3, 7]
    np.testing.assert_array_equal(stream.uv, [[10.5, 20.0], [11.0, 21.0], [10.75, 20.25]])


@each(
    ("old", "new", "words"),
    [
        ("1050000000,7", "950000000,7", "the image at 950000000 ns comes after the one at 1000000000 ns; sort"),
        ("1000000000,3", "1000000000,7", "the image at 1000000000 ns has feature 7 twice"),
        ("10.75,20.25", "10.75,nan", "tracks.csv"),
        ("10.75,20.25", "10.75,20.25,4", "tracks.csv"),
        ("10.75,20.25", "10.75", "tracks.csv"),
        ("10.75,20.25", "10.75,900", "feature 7 lies at (10.8, 900.0), outside the image of 752 x 480 px"),
        ("1050000000,7", "1050000000,8", "no feature is in more than one image"),
        (GOOD, "", "is empty"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, old, new, words):
    with pytest.raises(RecordingError, match=r"tracks\.csv") as error:
        read(tmp_path, GOOD.replace(old, new))
    assert words in str(error.value) and "\n" not in str(error.value)


def test_single_points_outside_the_image_are_left_out(tmp_path):
    rows = [(10**9 + 50_000_000 * k, n, 10.0 + k, 20.0 + n) for k in range(10) for n in range(3)]
    for at, uv in ((4, (900.0, 20.0)), (29, (1.0, -1e250))):
        rows[at] = (*rows[at][:2], *uv)
    path, notes = tmp_path / "tracks.csv", []
    path.write_text("".join(f"{t},{n},{u!r},{v!r}\n" for t, n, u, v in rows))
    stream = read_tracks("cam0", path, (752, 480), note=notes.append)
    kept = [row for k, row in enumerate(rows) if k not in (4, 29)]
    assert stream.uv.tolist() == [list(row[2:]) for row in kept]
    assert stream.stamps_ns[stream.image].tolist() == [row[0] for row in kept]
    assert len(notes) == 1 and "feature 1 lies at (900.0, 20.0), outside the image of 752 x 480 px; 2 of 30" in notes[0]


def test_an_image_whose_only_point_is_outside_is_gone(tmp_path):
    rows = [(10**9 + 50_000_000 * k, 7, 10.0 + k, 20.0) for k in range(12)]
    rows[5] = (*rows[5][:2], -99.0, 20.0)
    stream = read(tmp_path, "".join(f"{t},{n},{u!r},{v!r}\n" for t, n, u, v in rows))
    assert stream.stamps_ns.tolist() == [row[0] for k, row in enumerate(rows) if k != 5]
    assert stream.start.tolist() == list(range(12))


def test_a_rig_without_a_target(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(RIG)
    rig = load_rig(path)
    assert not rig.has_target and not rig.blooms
    assert rig.cameras[0].tracks == "cam0/tracks.csv" and rig.cameras[0].track_noise_px == 1.5
    again = rig_to_dict(rig)
    assert "target" not in again and again["sensors"]["cam0"]["tracks"] == "cam0/tracks.csv"


def test_a_camera_without_tracks_needs_a_target(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(RIG.replace("    tracks: cam0/tracks.csv\n", ""))
    with pytest.raises(RigError, match="target is missing; add target, targets .*, or tracks .* of cam0"):
        load_rig(path)


def test_a_folder_of_readings_and_tracks_alone_is_read(tmp_path):
    """Nothing of it names corners or images, which have even stamps, too."""
    stamps = 10**9 + 5_000_000 * np.arange(200)
    for name in ("imu0", "cam0"):
        (tmp_path / name).mkdir()
    readings = "".join(f"{t},0.1,{0.01 * (k % 7)},0.3,0,{0.1 * (k % 3)},9.81\n" for k, t in enumerate(stamps))
    (tmp_path / "imu0" / "data.csv").write_text("#t [ns],wx,wy,wz,ax,ay,az\n" + readings)
    rows = "".join(f"{t},7,{10.0 + k},20\n" for k, t in enumerate(stamps[::10]))
    (tmp_path / "cam0" / "tracks.csv").write_text("#t [ns],feature,u [px],v [px]\n" + rows)
    (tmp_path / "rig.yaml").write_text(RIG.replace("{type: imu}", "{type: imu, noise: consumer}"))
    (stream,) = read_measurements(open_recording(tmp_path), load_rig(tmp_path / "rig.yaml")).tracks
    assert stream.stamps_ns.tolist() == stamps[::10].tolist()
