"""Grids of circles: found, numbered, and calibrated without the bias of their centres."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import CornerStream, Measurements
from icalib.detection.decoding import corner_stream
from icalib.detection.detectors import detector_of
from icalib.errors import RigError
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import Checkerboard, Circles, Scene
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig.file import load_rig, load_target
from icalib.sensors.camera.corner_bias import ellipse_shift
from icalib.tools.inspection import read_target
from icalib.tools.simulation import Imaging, Renderer, Sheet
from icalib.tools.simulation.scenario import SimCamera

pytestmark = pytest.mark.slow

SYMMETRIC, ASYMMETRIC = Circles(7, 8, 0.04, 0.024), Circles(11, 4, 0.03, 0.026, asymmetric=True)
PINHOLE = SimCamera(
    "cam0", "pinhole-radtan", (752, 480), (460.0, 459.0, 375.0, 240.0), (-0.28, 0.07, 2e-4, 2e-5), np.eye(4)
)
FISHEYE = SimCamera(
    "cam0", "pinhole-equidistant", (752, 480), (230.0, 229.5, 372.2, 241.4), (0.0035, 7e-4, -0.0021, 2e-4), np.eye(4)
)
DISTANCE = {PINHOLE.model: 0.45, FISHEYE.model: 0.22}


def pose(target: Circles, distance: float, tilt: float, turn: float, roll: float) -> np.ndarray:
    """T_target_cam that looks at the middle; tilt, turn and roll in degrees."""
    a, b, c = np.radians([tilt, turn, roll])
    z = np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), -np.cos(a)])
    x = np.array([np.cos(c), np.sin(c), 0.0])
    x -= (x @ z) * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = target.points.mean(axis=0) - distance * z
    return T


def poses(target: Circles, camera: SimCamera, seed: int, count: int) -> list[np.ndarray]:
    rng, far = np.random.default_rng(seed), DISTANCE[camera.model]
    views = []
    for _ in range(count):
        how = far * rng.uniform(0.9, 1.2), rng.uniform(5.0, 40.0), rng.uniform(0.0, 360.0), rng.uniform(-60.0, 60.0)
        views.append(pose(target, *how))
    return views


@each(
    ("camera", "target"),
    [(PINHOLE, SYMMETRIC), (FISHEYE, ASYMMETRIC)],
    full=[(PINHOLE, ASYMMETRIC), (FISHEYE, SYMMETRIC)],
)
def test_centres_are_those_of_the_projected_circles(camera, target):
    """Each under its number, and away from the projection of its centre as perspective and lens say."""
    renderer, detector = Renderer(camera, Imaging(blur_px=0.8, noise=2.0)), detector_of(target)
    model = camera_model(camera.model)
    params, errors, shifts = np.array([*camera.intrinsics, *camera.distortion]), [], []
    for k, T in enumerate(poses(target, camera, 0, 6)):
        picture = renderer.picture([Sheet(target)], T, np.random.default_rng(k))
        found = detector.detect(picture.pixels)
        X = (target.points - T[:3, 3]) @ T[:3, :3]
        plane = np.tile(T[:3, :3].T[:, :2], (len(X), 1, 1))
        shift = ellipse_shift(model, params, X, plane, target.radii)
        errors.append((found.uv - picture.sheets[0].uv[found.point])[found.kept])
        shifts.append(shift[found.point][found.kept])
    error, shift = np.concatenate(errors), np.concatenate(shifts)
    assert len(error) > 0.8 * 6 * len(target.points)
    assert np.sqrt((shift**2).mean()) > 0.05  # what is left out otherwise
    assert np.abs(((error - shift) * shift).sum() / (shift**2).sum()) < 0.01
    assert np.sqrt(((error - shift) ** 2).mean()) < 0.006


@pytest.mark.parametrize("target", [SYMMETRIC, ASYMMETRIC], ids=["symmetric", "asymmetric"])
def test_white_circles_on_black_are_found_as_well(target):
    renderer, detector, before = Renderer(PINHOLE, Imaging(blur_px=0.8, noise=2.0)), detector_of(target), []
    for k in range(3):  # the third is predicted by the others
        T = pose(target, 0.5, 20.0, 30.0, 10.0 + k)
        pixels = renderer.picture([Sheet(target)], T, np.random.default_rng(0)).pixels
        dark, white = detector.detect(pixels), detector.detect(255 - pixels, before)
        assert dark.kept.sum() > 0.9 * len(target.points)
        np.testing.assert_allclose(white.uv, dark.uv, atol=1e-6)
        before.append(white)


NEAR = [
    (PINHOLE, Circles(4, 5, 0.05, 0.03, True), (0.25, 0.0, 0.0, 0.0)),
    (PINHOLE, Circles(4, 5, 0.05, 0.03, True), (0.45, 55.0, 200.0, 0.0)),
    (PINHOLE, ASYMMETRIC, (0.45, 55.0, 200.0, 0.0)),
    (FISHEYE, ASYMMETRIC, (0.14, 45.0, 45.0, 60.0)),
    (FISHEYE, SYMMETRIC, (0.1, 0.0, 0.0, 0.0)),
]


@each(("camera", "target", "view"), NEAR)
def test_a_grid_is_found_from_very_near(camera, target, view):
    """Neighbouring circles differ in size by up to a half, and the grid fills up to 140 degrees."""
    picture = Renderer(camera, Imaging(blur_px=0.8, noise=2.0)).picture(
        [Sheet(target)], pose(target, *view), np.random.default_rng(0)
    )
    found, truth = detector_of(target).detect(picture.pixels), picture.sheets[0].uv
    assert found.kept.sum() > 0.85 * len(truth)
    # No image shows which turn of the grid it is.
    apart = min(float(np.abs(found.uv - truth[turn[found.point]]).max()) for turn in target.turns)
    assert apart < 2.5  # centres of ellipses are not the projected centres


def test_a_grid_that_the_image_cuts_is_not_found():
    """What lies between the paper and the border of the image is no circle."""
    target = Circles(7, 3, 0.05, 0.06, True)
    picture = Renderer(PINHOLE, Imaging(blur_px=0.8, noise=2.0)).picture(
        [Sheet(target)], pose(target, 0.35, 55.0, 200.0, 0.0), np.random.default_rng(0)
    )
    assert not len(detector_of(target).detect(picture.pixels).point)


def test_the_shift_under_perspective_is_that_of_the_conic():
    """Of a pinhole camera the ellipse is known in closed form: that of the circle's conic under the homography."""
    camera = camera_model("pinhole-radtan")
    params, radius = np.array([500.0, 480.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0]), 0.05
    K = np.array([[500.0, 0.0, 320.0], [0.0, 480.0, 240.0], [0.0, 0.0, 1.0]])
    T = pose(SYMMETRIC, 0.4, 50.0, 30.0, 20.0)
    R, centre = T[:3, :3].T, T[:3, :3].T @ (np.array([0.1, 0.02, 0.0]) - T[:3, 3])
    H = K @ np.column_stack([R[:, :2], centre])
    C = np.linalg.inv(H).T @ np.diag([1.0, 1.0, -(radius**2)]) @ np.linalg.inv(H)
    expected = np.linalg.solve(C[:2, :2], -C[:2, 2]) - (H[:2, 2] / H[2, 2])
    shift = ellipse_shift(camera, params, centre[None], R[None, :, :2], np.array([radius]))
    assert np.linalg.norm(expected) > 1.0
    np.testing.assert_allclose(shift[0], expected, atol=2e-3 * float(np.linalg.norm(expected)))


@pytest.mark.parametrize(
    ("camera", "target", "moved"),
    [pytest.param(PINHOLE, SYMMETRIC, 3.0, marks=pytest.mark.full), (FISHEYE, ASYMMETRIC, 20.0)],
    ids=["pinhole", "fisheye"],
)
def test_the_lens_comes_out_without_bias(tmp_path, camera, target, moved):
    """Without the correction, intrinsics are wrong by more than `moved` standard deviations."""
    renderer, detector = Renderer(camera, Imaging(blur_px=0.8, noise=2.0)), detector_of(target)
    views = poses(target, camera, 1, 14)
    rng = np.random.default_rng(3)
    found = [detector.detect(renderer.picture([Sheet(target)], T, rng).pixels) for T in views]
    stream = corner_stream("cam0", np.arange(len(found)) * 10**9, found)
    result = calibrated(target, camera, stream, tmp_path)
    for name, truth in (("intrinsics", camera.intrinsics), ("distortion", camera.distortion)):
        group = result.group("cam0", name)
        assert np.abs((group.value - truth) / group.std).max() < 3.5, name
    assert result.group("cam0", "intrinsics").std[0] < 2e-4 * camera.intrinsics[0]
    # Circles of no size have no shift: without the correction the lens is wrong.
    without = calibrated(replace(target, diameter=1e-6), camera, stream, tmp_path).group("cam0", "intrinsics")
    group = result.group("cam0", "intrinsics")
    assert np.abs((without.value - group.value) / group.std).max() > moved


def calibrated(target: Circles, camera: SimCamera, stream: CornerStream, folder: Path) -> Calibration:
    """A calibration of the camera, from nothing but its model and the target."""
    fields = ", ".join(f"{name}: {str(value).lower()}" for name, value in target.plain().items())
    text = f"{{type: camera, model: {camera.model}, resolution: [752, 480]}}\ntarget: {{{fields}}}\n"
    (folder / "rig.yaml").write_text(f"sensors:\n  cam0: {text}settings: {{board_shape: false}}\n")
    return calibrate_measurements(load_rig(folder / "rig.yaml"), Measurements.of_streams(stream))


@each(
    ("target", "turns"),
    [(SYMMETRIC, 2), (Circles(6, 6, 0.04, 0.02), 4), (ASYMMETRIC, 1), (Circles(4, 5, 0.03, 0.02, True), 2)],
)
def test_turns_put_circles_on_circles(target, turns):
    assert len(target.turns) == turns
    at = target.points[:, :2] - target.points[:, :2].mean(axis=0)
    rotations = [np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in 0.5 * np.pi * np.arange(4)]
    alike = sum(all(np.abs(at - p).sum(axis=1).min() < 1e-9 for p in at @ R) for R in rotations)
    assert alike == turns
    for turn in target.turns:
        R = np.linalg.lstsq(at, at[turn], rcond=None)[0]
        np.testing.assert_allclose(at @ R, at[turn], atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0)


def test_rig_files_and_kalibrs(tmp_path):
    for target in (SYMMETRIC, ASYMMETRIC):
        plain = ", ".join(f"{name}: {str(value).lower()}" for name, value in target.plain().items())
        (tmp_path / "target.yaml").write_text(f"{{{plain}}}")
        assert load_target(tmp_path / "target.yaml") == target
    (tmp_path / "target.yaml").write_text("{type: circles, rows: 4, cols: 5, spacing: 0.02, diameter: 0.03}")
    with pytest.raises(RigError, match="touch; correct diameter or spacing"):
        load_target(tmp_path / "target.yaml")
    text = "target_type: circlegrid\ntargetRows: 4\ntargetCols: 11\nspacingMeters: 0.02\nasymmetricGrid: true\n"
    (tmp_path / "kalibr.yaml").write_text(text)
    words = r"type: circles, rows: 4, cols: 11, spacing: 0.02, diameter: ..., asymmetric: true"
    with pytest.raises(RigError, match=words):
        read_target(tmp_path / "kalibr.yaml")
    with pytest.raises(RigError, match="both are grids of circles"):
        Scene(("a", "b"), (SYMMETRIC, ASYMMETRIC))
    assert Scene(("a", "b"), (SYMMETRIC, Checkerboard(4, 5, 0.1))).radii.tolist() == [0.012] * 56 + [0.0] * 20
