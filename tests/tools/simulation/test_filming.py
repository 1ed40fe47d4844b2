"""Films: stamps and readings of the simulation, images that repeat, and files that hold them."""

from __future__ import annotations

import sys
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.typed import instance, not_none

from icalib.data.measurements import ImuStream
from icalib.data.recordings import open_recording
from icalib.errors import CalibrationError, RecordingError, RigError
from icalib.rig import ImuSensor
from icalib.sensors.imu.read import readings as imu_readings
from icalib.tools.simulation import ADIS16448, Film, Imaging, Scenario, film, handheld, simulate, write_film
from icalib.tools.simulation.writing import FORMS, Form

pytest.importorskip("cv2")

QUIET = Imaging(blur_px=0.5, noise=2.0)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """Two small cameras that take turns, with jitter and a gap, on clocks of their own."""
    base = handheld(1.0, asynchronous=True)
    cameras = tuple(
        replace(c, resolution=(64, 48), intrinsics=(50.0, 50.0, 31.5, 23.5), jitter_s=0.002) for c in base.cameras
    )
    late = replace(cameras[1], clock_origin_ns=7_000_000_000, dropouts=((0.3, 0.5),))
    return replace(base, cameras=(cameras[0], late), imu_gaps=((0.6, 0.62),))


@pytest.fixture(scope="module")
def filmed(scenario: Scenario) -> Film:
    return film(scenario, 3, QUIET)


def test_readings_and_stamps_are_those_of_the_simulation(scenario: Scenario, filmed: Film):
    data = simulate(scenario, 3)
    np.testing.assert_array_equal(filmed.imu.stamps_ns, not_none(data.measurements.imu).stamps_ns)
    np.testing.assert_array_equal(filmed.imu.gyro, not_none(data.measurements.imu).gyro)
    shots = list(filmed.shots())
    assert [s.seconds for s in shots] == sorted(s.seconds for s in shots) and len(shots) == filmed.count()
    for stream in data.measurements.cameras:
        mine = [s for s in shots if s.camera == stream.name]
        assert [s.stamp_ns for s in mine] == stream.stamps_ns.tolist()
        truth = data.truth.corners[stream.name]
        np.testing.assert_array_equal([s.seconds for s in mine], truth.seconds)
        for i, shot in enumerate(mine):
            rows = slice(stream.start[i], stream.start[i + 1])
            np.testing.assert_array_equal(np.flatnonzero(shot.target.seen), stream.point[rows])
            np.testing.assert_allclose(shot.target.uv[shot.target.seen], truth.uv[rows], atol=1e-8)


def test_images_repeat_on_any_number_of_threads_and_their_noise_does_not(filmed: Film):
    one, two = ([s.pixels for s in filmed.shots(workers)] for workers in (1, 3))
    np.testing.assert_array_equal(one, two)
    assert one[0].shape == (48, 64) and one[0].dtype == np.uint8
    clean = [s.pixels for s in replace(filmed, imaging=replace(QUIET, noise=0.0)).shots()]
    noise = np.array(one, dtype=float) - np.array(clean, dtype=float)
    assert noise.std() == pytest.approx(2.0, rel=0.05)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.1


def test_an_exposure_blurs_what_moves(scenario: Scenario, filmed: Film):
    sharp, long = (list(film(scenario, 3, Imaging(blur_px=0.5), t).shots()) for t in (0.0, 0.03))
    contrast = [np.mean([np.abs(np.diff(s.pixels.astype(float))).mean() for s in shots]) for shots in (sharp, long)]
    assert contrast[1] < 0.97 * contrast[0]


def test_an_image_is_rendered_when_it_is_asked_for(filmed: Film, monkeypatch: pytest.MonkeyPatch):
    rendered = []
    whole = Film._shot
    monkeypatch.setattr(Film, "_shot", lambda self, *a: rendered.append(1) or whole(self, *a))
    shots = instance(filmed.shots(workers=2), Generator)
    for _ in range(3):
        next(shots)
    assert len(rendered) <= 8
    shots.close()


def test_a_bent_board_cannot_be_filmed(scenario: Scenario):
    with pytest.raises(RigError, match="rendered flat"):
        film(replace(scenario, bow=(0.001, 0.0, 0.0)), 0)
    rolling = tuple(replace(c, readout_s=0.01) for c in scenario.cameras)
    with pytest.raises(RigError, match=r"^cam0: images are rendered with a global shutter; simulate tables, or remove"):
        film(replace(scenario, cameras=rolling), 0)


def test_every_format_holds_the_same_images_and_readings(filmed: Film, tmp_path: Path):
    pytest.importorskip("rosbags")
    paths: dict[Form, Path] = {form: tmp_path / form for form in FORMS}
    write_film(filmed, paths)
    shots = list(filmed.shots())
    sensor = ImuSensor("imu0", "imu0/data.csv", ADIS16448)
    for form, path in paths.items():
        recording = open_recording(path)
        imu = imu_readings(recording, sensor)
        np.testing.assert_array_equal(instance(imu, ImuStream).stamps_ns, filmed.imu.stamps_ns)
        for name in ("gyro", "accel"):  # tables are read to the last bit but one
            np.testing.assert_allclose(getattr(imu, name), getattr(filmed.imu, name), rtol=1e-15, err_msg=form)
        for camera in ("cam0", "cam1"):
            frames = list(recording.images(camera if form == "euroc" else f"/{camera}/image_raw"))
            mine = [s for s in shots if s.camera == camera]
            assert [f.stamp_ns for f in frames] == [s.stamp_ns for s in mine]
            np.testing.assert_array_equal([f.image for f in frames], [s.pixels for s in mine])
        assert recording.notes() == ()


def test_what_exists_is_not_overwritten(filmed: Film, tmp_path: Path):
    (tmp_path / "there").mkdir()
    with pytest.raises(RecordingError, match="exists already"):
        write_film(filmed, {"mcap": tmp_path / "new", "euroc": tmp_path / "there"})
    assert not (tmp_path / "new").exists()


def test_a_missing_package_is_named(filmed: Film, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(CalibrationError, match=r"pip install .\.\[bags\]"):
        write_film(filmed, {"mcap": tmp_path / "new"})
