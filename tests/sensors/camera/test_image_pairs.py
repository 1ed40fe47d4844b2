"""Sets of images that count as simultaneous but are not: which are rejected, and what is said of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each
from tests.typed import not_none

from icalib.optim.rows import LOSSES, robust_weights
from icalib.rig import Settings
from icalib.sensors.camera.assess import late_words
from icalib.sensors.camera.corner_factor import CornerFactor, CornerNoise, CornerOutput
from icalib.sensors.camera.image_times import not_simultaneous

NOISE_PX = 0.1


@pytest.fixture
def cameras(unlike, setup_of, factor_of) -> list[CornerFactor]:
    """Three cameras with an image each at every keyframe, and different stamps."""
    first = factor_of(setup_of(unlike), 0)
    keyframe = np.arange(len(first.keyframe))
    streams = [replace(first.stream, name=f"cam{k}", stamps_ns=first.stream.stamps_ns + k) for k in range(3)]
    return [replace(first, stream=stream, keyframe=keyframe) for stream in streams]


def output(camera: CornerFactor, late: tuple[int, ...], tau: float) -> tuple[CornerFactor, CornerOutput]:
    """Normal errors, and 5 px more in `late` images; with a common error per image of `tau` px, none if it is zero."""
    n, m, rng = len(camera.stream.uv), 2 if tau else 0, np.random.default_rng(3)
    camera = replace(camera, noise=CornerNoise(np.full(n, 0.2), np.full(m, tau), np.tile(np.eye(2)[:, :m], (n, 1, 1))))
    out = camera.output(np.float64)
    out.residual[:] = NOISE_PX * rng.standard_normal((n, 2))
    out.residual[np.isin(camera.stream.image, late), 0] += 5.0
    noise, keep = camera.noise, np.ones(n, dtype=bool)
    for v, shared in enumerate(out.shared):
        rows = camera.corners_of(v, v + 1)
        robust_weights(
            out.residual[rows], keep[rows], noise.field[rows], noise.tau**-2.0, noise.sigma[rows], LOSSES[noise.loss],
            noise.loss_scale, out.root[rows], shared,
        )  # fmt: skip
    return camera, out


@each("tau", [0.0, 1.0])
@each("late", [(), (0,), (5,)])
def test_late_images_are_found_whether_or_not_a_common_error_compensates_them(cameras, late, tau):
    """With tau of 1 px, the common error compensates nearly all of the 5 px."""
    pairs = [output(camera, late if k == 2 else (), tau) for k, camera in enumerate(cameras)]
    if tau and late:
        camera, out = pairs[2]
        assert np.abs(camera.errors(out)[camera.stream.image == late[0]]).max() < 1.0
    apart = not_simultaneous([c for c, _ in pairs], [out for _, out in pairs], Settings())
    assert [np.flatnonzero(bad).tolist() for bad in apart] == [list(late)] * 3


def test_the_sentence_names_the_cameras_and_stamps_of_the_rejected_sets(cameras):
    """Also of sets without an image of the first camera."""
    keyframe = cameras[0].keyframe
    cameras[0] = replace(cameras[0], keyframe=keyframe + (keyframe >= 2))  # none at keyframe 2
    late = [np.isin(camera.keyframe, [2]) for camera in cameras]
    first, stamps = cameras[0].stream.stamps_ns, cameras[1].stream.stamps_ns
    words = not_none(late_words(cameras, late))
    assert words.startswith("1 sets of images of cam1 and cam2 ") and words.endswith(f": at {stamps[2]} ns.")
    words = not_none(late_words(cameras, [np.isin(camera.keyframe, [2, 4]) for camera in cameras]))
    assert words.startswith("2 sets of images of cam0 and cam1 and cam2 ")
    assert words.endswith(f": at {stamps[2]} ns, at {first[3]} ns.")
    assert late_words(cameras, [np.zeros(len(camera.keyframe), dtype=bool) for camera in cameras]) is None
