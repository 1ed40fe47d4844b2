"""Short recordings: the printed standard deviations cover errors that an image's corners share, from few images too."""

from __future__ import annotations

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest
from tests.remarks import named, names
from tests.typed import not_none

from icalib.data.measurements import CornerStream, Measurements
from icalib.geometry.targets import Checkerboard
from icalib.pipeline import calibrate_measurements
from icalib.report.page import size_words
from icalib.result import Calibration
from icalib.rig import Camera, PoseSensor, Rig, by_name
from icalib.tools.simulation import handheld, rig_for, simulate
from icalib.validation.assess import few_factor, few_segments_notes

LENS = {"intrinsics": (458.7, 457.3, 367.2, 248.4), "distortion": (-0.28, 0.07, 2e-4, 2e-5)}
CAMERA, POSE_SENSOR = Camera("cam0", "", "pinhole-radtan", (752, 480)), PoseSensor("mocap", "")


# Images; so few that their spread tells little, and in `full` so many that it tells more.
COUNTS = [9, *(pytest.param(n, marks=pytest.mark.full) for n in (4, 16))]


def stills(count: int, seed: int, shared_px: float) -> Calibration:
    rig, stream = taken(count, seed, shared_px)
    return calibrate_measurements(rig, Measurements.of_streams(stream))


def taken(count: int, seed: int, shared_px: float) -> tuple[Rig, CornerStream]:
    """One camera alone, `count` images, corners with noise of 0.2 px and an error that those of an image share: linear
    and quadratic in the image, no pose makes up for it."""
    scenario = handheld(20.0)
    camera = dataclasses.replace(scenario.cameras[0], **LENS)
    simulation = simulate(dataclasses.replace(scenario, cameras=(camera,)), seed)
    whole, rng = simulation.measurements.cameras[0], np.random.default_rng(seed)
    kept = np.sort(rng.choice(len(whole.stamps_ns), count, replace=False))
    rows = np.isin(whole.image, kept)
    start = np.concatenate([[0], np.cumsum(np.diff(whole.start)[kept])])
    x, y = (2.0 * whole.uv[rows] / np.array([752.0, 480.0]) - 1.0).T
    field = np.stack([x, y, x * x, x * y, y * y], axis=1)
    sizes = shared_px * rng.normal(size=(count, 5, 2))[np.repeat(np.arange(count), np.diff(start))]
    uv = whole.uv[rows] + np.einsum("nk,nkj->nj", field, sizes)
    rig = rig_for(simulation.scenario, intrinsics="start", distortion="start")
    own = dataclasses.replace(rig.cameras[0], corner_noise_px=None)
    rig = rig.with_(imu=None, cameras=(own,), settings=dataclasses.replace(rig.settings, segments=8))
    return rig, CornerStream("cam0", whole.stamps_ns[kept], start, whole.point[rows], uv)


def in_deviations(result: Calibration, formal: bool) -> list[float]:
    out: list[float] = []
    for name, truth in LENS.items():
        group = result.group("cam0", name)
        out += ((group.value - np.array(truth)) / (group.std_formal if formal else group.std)).tolist()
    return out


def rms(values: list[list[float]]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("count", COUNTS)
def test_errors_that_an_image_shares_are_covered(count: int):
    results = [stills(count, seed, 0.15) for seed in range(6)]
    assert rms([in_deviations(r, formal=True) for r in results]) > 1.7
    assert rms([in_deviations(r, formal=False) for r in results]) < 1.5
    assert not any("recording_too_short" in names(r.warnings) for r in results)


@pytest.mark.parametrize("count", COUNTS)
def test_white_noise_costs_little_more_than_students_t(count: int):
    results = [stills(count, seed, 0.0) for seed in range(6)]
    factors = [float(not_none(r.group("cam0", "intrinsics").factor)[0]) for r in results]
    assert 1.0 <= np.mean(factors) < 1.25 * few_factor(count - 1)
    assert 0.6 < rms([in_deviations(r, formal=False) for r in results]) < 1.4


def test_few_images_say_how_much_their_spread_can_tell():
    result = stills(6, 1, 0.1)
    assert "5 parts" in (note := named("few_segments", result.notes)) and note.endswith("record more images.")
    assert "few_segments" not in names(stills(40, 1, 0.1).notes)


def test_pictures_without_a_clock_have_names_and_no_seconds():
    """Of 40 the lens of the last 15 is longer by 3 %."""
    rig, stream = taken(40, 1, 0.0)
    numbers = np.arange(1, 41)
    longer = np.where(stream.image[:, None] < 25, 1.0, 1.03)
    stream = dataclasses.replace(
        stream,
        stamps_ns=numbers * 1_000_000_000,
        uv=(stream.uv - LENS["intrinsics"][2:]) * longer + LENS["intrinsics"][2:],
        files={int(k) * 1_000_000_000: f"{k:04d}.png" for k in numbers},
    )
    result = calibrate_measurements(rig, Measurements.of_streams(stream))
    assert result.reasons[0].name == "lens_changes" and re.search(r"^cam0 .* image 00(2\d).png:", result.reasons[0])
    sentences = " ".join([*result.reasons, *result.notes])
    assert "--from" not in sentences and not re.search(r"\d s\b", sentences)
    assert not result.rates and size_words(result).startswith("40 images")
    several = calibrate_measurements(rig, [Measurements.of_streams(stream, name=name) for name in "ab"])
    assert "recording 2, b: 40 images." in several.notes
    assert size_words(several).startswith("2 recordings, 80 images")


@pytest.mark.parametrize(
    ("imu", "sensor", "words"),
    [
        ("imu0", CAMERA, "record longer, and leave `segments` at 8 or more."),
        ("imu0", POSE_SENSOR, "record longer, and leave `segments` at 8 or more."),
        (None, CAMERA, "record more images."),
        (None, POSE_SENSOR, "record more poses."),
    ],
)
def test_the_advice_for_few_parts_is_about_what_the_rig_has(imu, sensor, words):
    inputs = SimpleNamespace(imu=imu, rig=Rig(by_name(sensor), Checkerboard(6, 7, 0.1)))
    (note,) = few_segments_notes(inputs, SimpleNamespace(count=5))  # pyright: ignore[reportArgumentType]
    assert note.endswith(words)
    assert not list(few_segments_notes(inputs, SimpleNamespace(count=8)))  # pyright: ignore[reportArgumentType]


def test_the_factor_of_few_parts_is_students():
    """Tables of Student's distribution: 68.27 % lie within 1.84, 1.32, 1.20 and 1.09 standard deviations."""
    assert [few_factor(n) for n in (2, 3, 4, 7)] == pytest.approx([1.837, 1.321, 1.197, 1.091], abs=1e-3)
    assert few_factor(8) == few_factor(50) == 1.0
