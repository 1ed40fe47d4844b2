"""Stereo stills of which a few pairs were not exposed together."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from icalib.data.measurements import CornerStream, Measurements
from icalib.pipeline import calibrate_measurements
from icalib.tools.simulation import handheld, rig_for, simulate


def some_images(stream: CornerStream, kept: np.ndarray) -> CornerStream:
    rows = [np.arange(int(stream.start[i]), int(stream.start[i + 1])) for i in kept]
    start = np.concatenate([[0], np.cumsum([len(r) for r in rows])])
    every = np.concatenate(rows)
    stamps = (1 + np.arange(len(kept))) * 1_000_000_000
    files = {int(stamp): f"{stream.name}_{k}.png" for k, stamp in enumerate(stamps)}
    return CornerStream(stream.name, stamps, start, stream.point[every], stream.uv[every], files=files)


@pytest.mark.parametrize("late", [(7, 19, 20), pytest.param((), marks=pytest.mark.full)])
def test_pairs_that_were_not_exposed_together_are_left_out_and_told(late: tuple[int, ...]):
    simulation = simulate(handheld(20.0), 6)
    first, second = simulation.measurements.cameras
    chosen = np.linspace(10, 380, 30).astype(int)
    other = chosen.copy()
    other[list(late)] += 3  # 0.15 s later
    rig = rig_for(simulation.scenario, intrinsics="start", distortion="start")
    cameras = tuple(dataclasses.replace(c, corner_noise_px=None) for c in rig.cameras)
    settings = dataclasses.replace(rig.settings, loss="huber", outlier_std=4.0)
    rig = rig.with_(imu=None, cameras=cameras, settings=settings)
    result = calibrate_measurements(
        rig, Measurements.of_streams(some_images(first, chosen), some_images(second, other))
    )
    told = [n for n in result.notes if n.name == "images_not_simultaneous"]
    assert len(told) == (1 if late else 0)
    for k in late:
        assert f"cam0_{k}.png" in told[0] or f"cam1_{k}.png" in told[0]
    for residuals in result.corner_residuals:
        image = np.repeat(np.arange(30), np.diff(residuals.start))
        assert set(image[residuals.rejected].tolist()) == set(late)
    truth = np.linalg.inv(simulation.truth.T_imu_sensor["cam0"]) @ simulation.truth.T_imu_sensor["cam1"]
    group = result.group("cam1", "translation")
    assert (np.abs(group.value - truth[:3, 3]) / group.std).max() < 4.0
