"""Every option of the rig file, on six seconds of the shipped excerpt."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from tests.typed import not_none

from icalib.geometry import so3
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, Rig
from icalib.sensors.imu.spec import class_imperfections

CAMERAS = ("cam0", "cam1")
GROUPS = ("rotation", "translation", "time_offset", "intrinsics", "distortion", "bloom")
STEP = {
    "rotation": 2e-3,
    "translation": 2e-3,
    "time_offset": 2e-4,
    "intrinsics": 1.0,
    "distortion": 1e-3,
    "bloom": 0.05,
}
SETTINGS = {
    "scheme pose": {"scheme": "pose"},
    "scheme kinematic": {"scheme": "kinematic"},
    "keyframes at the first camera": {"keyframes": "first-camera"},
    "loss none": {"loss": "none"},
    "loss cauchy": {"loss": "cauchy"},
    "tight loss": {"loss_scale": 1.5},
    "no outlier rule": {"outlier_std": 0.0},
    "strict outlier rule": {"outlier_std": 2.0, "outlier_min_px": 0.2},
    "no bloom": {"bloom": False},
    "flat board": {"board_shape": False},
    "no blur": {"blur_noise": False},
    "common error": {"common_error": True},
    "split": {"segments": 4},
    "dense keyframes": {"keyframe_spacing_s": 0.025},
    "no bridging": {"max_gap_s": 0.02},
}


@pytest.fixture(scope="module")
def short(excerpt, cut):
    return cut(excerpt, 0.0, 1.0 / 6.0)


@pytest.fixture(scope="module")
def base(rig) -> Rig:
    return dataclasses.replace(rig, settings=dataclasses.replace(rig.settings, segments=0))


@pytest.fixture(scope="module")
def reference(base, short):
    return calibrate_measurements(base, short)


def is_near(found, reference, cameras=CAMERAS) -> None:
    """Within what the models may differ by on real data: half a degree, 3 cm, 1 ms."""
    assert found.converged, found.status
    for camera in cameras:
        R, S = (c.group(camera, "rotation").value for c in (found, reference))
        assert np.rad2deg(np.linalg.norm(so3.log(np.ascontiguousarray(R.T @ S)))) < 0.5
        p, q = (c.group(camera, "translation").value for c in (found, reference))
        assert np.linalg.norm(p - q) < 0.03
        t, u = (c.group(camera, "time_offset").value for c in (found, reference))
        assert abs(t[0] - u[0]) < 1e-3


@pytest.mark.parametrize("name", SETTINGS)
def test_setting(base, short, reference, name):
    rig = dataclasses.replace(base, settings=dataclasses.replace(base.settings, **SETTINGS[name]))
    found = calibrate_measurements(rig, short)
    is_near(found, reference)
    changes = [np.abs(found.group(c, n).value - reference.group(c, n).value).max() for c in CAMERAS for n in GROUPS[:3]]
    assert name in ("split", "no bridging") or max(changes) > 1e-10  # the option does something


@pytest.mark.parametrize("camera", [0, 1])
def test_one_camera(base, short, reference, camera):
    rig = base.with_(cameras=base.cameras[camera : camera + 1])
    measurements = short.only(*rig.sensors)
    is_near(calibrate_measurements(rig, measurements), reference, (f"cam{camera}",))


def test_imu_intrinsics(base, short, reference):
    intrinsics = Parameter("prior", np.zeros(24), np.repeat([1e-3, 1e-3, 1e-3, 1e-4], [6, 6, 3, 9]))
    rig = base.with_(imu=dataclasses.replace(base.imu, intrinsics=intrinsics))
    found = calibrate_measurements(rig, short)
    is_near(found, reference)
    assert 0.0 < np.abs(found.group("imu0", "intrinsics").value).max() < 0.05


def with_each(rig: Rig, names: tuple[str, ...], parameter: Callable[[str, str], Parameter]) -> Rig:
    """The groups `names` of each camera as `parameter` of the names of camera and group."""
    cameras = (dataclasses.replace(c, **{name: parameter(c.name, name) for name in names}) for c in rig.cameras)
    return rig.with_(cameras=tuple(cameras))


# Two groups at once: each keeps its own value whatever the other one does.
PAIRS = [("rotation", "intrinsics"), ("translation", "distortion"), ("time_offset", "bloom")]


@pytest.mark.parametrize("names", PAIRS, ids=" and ".join)
def test_fixed_stays_exactly_fixed(base, short, reference, names):
    """Away from where it would go: a step that other parameters have to make up for."""

    def value(camera: str, name: str) -> np.ndarray:
        return moved(reference.group(camera, name).value, name)

    found = calibrate_measurements(with_each(base, names, lambda c, n: Parameter("fixed", value(c, n))), short)
    assert found.converged, found.status
    for camera, name in product(CAMERAS, set(names) - {"bloom"}):
        group = found.group(camera, name)
        if name == "time_offset":  # held as a difference of clock origins inside
            assert abs(group.value[0] - value(camera, name)[0]) < 1e-9
        else:
            np.testing.assert_array_equal(group.value, value(camera, name))
        assert group.columns is None
        assert set(group.verdict) == {"fixed"}
        np.testing.assert_array_equal(group.std, 0.0)
    assert not any(f".{name}." in column for column in found.covariance_names for name in names)


def moved(value: np.ndarray, name: str) -> np.ndarray:
    return value @ so3.exp(np.array([STEP[name], 0.0, 0.0])) if name == "rotation" else value + STEP[name]


def distance(a: np.ndarray, b: np.ndarray, name: str) -> float:
    return float(np.abs(so3.log(np.ascontiguousarray(a.T @ b)) if name == "rotation" else a - b).max())


@pytest.mark.parametrize("names", PAIRS, ids=" and ".join)
def test_a_tight_prior_wins(base, short, reference, names):
    found = calibrate_measurements(with_each(base, names, lambda c, n: prior_beside(reference, c, n, 1e-6)), short)
    assert found.converged, found.status
    for camera, name in product(CAMERAS, names):
        group = found.group(camera, name)
        assert group.mode == "prior"
        assert distance(group.value, moved(reference.group(camera, name).value, name), name) < 0.01 * STEP[name]


def test_a_broad_prior_leaves_the_answer_to_the_data(base, short, reference):
    names = ("rotation", "translation", "time_offset", "bloom")
    found = calibrate_measurements(with_each(base, names, lambda c, n: prior_beside(reference, c, n, 1e2)), short)
    assert found.converged, found.status
    for camera, name in product(CAMERAS, names):
        a, b = (x.group(camera, name).value for x in (found, reference))
        assert 0.0 < distance(a, b, name) < 0.02 * STEP[name]


def prior_beside(reference: Calibration, camera: str, name: str, steps: float) -> Parameter:
    """A prior a step away from the answer without it, of a standard deviation of so many steps."""
    value = reference.group(camera, name).value
    sigma = np.full(3 if name == "rotation" else value.size, steps * STEP[name])
    return Parameter("prior", moved(value, name), sigma)


def test_what_is_free_fits_at_least_as_well(base, short, reference):
    """By what the solver minimises: the RMS counts the few corners in full that the loss gives up for all others."""
    names = ("intrinsics", "distortion")
    found = calibrate_measurements(with_each(base, names, lambda *_: Parameter()), short)
    assert found.converged, found.status
    for before, after in zip(reference.corner_residuals, found.corner_residuals, strict=True):
        camera = before.sensor
        assert all(found.group(camera, name).columns is not None for name in names)
        used = before.used & after.used
        assert used.mean() > 0.99
        sigma, bend = before.sigma[used], base.settings.loss_scale
        assert huber(after.residual[used], sigma, bend) < huber(before.residual[used], sigma, bend)
        focal = [x.group(camera, "intrinsics").value[:2] for x in (found, reference)]
        np.testing.assert_allclose(*focal, rtol=0.03)


def huber(residual: np.ndarray, sigma: np.ndarray, bend: float) -> float:
    """Half the robust chi^2 of residuals (n, 2) with standard deviations (n,), linear beyond `bend` of these."""
    size = np.linalg.norm(residual, axis=1) / sigma
    return float(np.where(size < bend, 0.5 * size**2, bend * (size - 0.5 * bend)).sum())


def test_what_the_data_do_not_know_of_the_imu_stays_as_its_class_says(rig, excerpt):
    """Its prior weighs as much as all else errs: the segments of this recording scatter several times more than white
    noise."""
    sigma = class_imperfections("industrial").sigma
    imu = dataclasses.replace(rig.imu, intrinsics=Parameter("prior", np.zeros(24), sigma))
    found = calibrate_measurements(rig.with_(imu=imu), excerpt)
    group = found.group("imu0", "intrinsics")
    assert not_none(group.factor).min() > 3.0
    assert (group.std < 1.3 * sigma).all() and np.abs(group.value / group.std).max() < 4.0
    assert np.abs(group.value[15:] / sigma[15:]).max() < 1.0  # g-sensitivity
