"""The tracker on images whose points are known, and on those of ordinary mishaps."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.detection.tracker import MOST_VIEWS, Observations, Tracker

from .conftest import SIZE, Turning


def track(images: list[np.ndarray]) -> list[Observations]:
    tracker = Tracker()
    return [tracker.add(image) for image in images]


def errors(seen: list[Observations], scene: Turning) -> np.ndarray:
    """(n, 2) px: from where the first view of each feature lies on the scene, of all later views."""
    places: dict[int, np.ndarray] = {}
    out = []
    for k, one in enumerate(seen):
        inverse = np.linalg.inv(scene.homographies[k])
        on_first = np.column_stack([one.uv, np.ones(len(one.uv))]) @ inverse.T
        for feature, place in zip(one.feature.tolist(), on_first[:, :2] / on_first[:, 2:], strict=True):
            places.setdefault(feature, place)
        ours = np.array([places[f] for f in one.feature.tolist()])
        out.append((one.uv - scene.moved(ours, k))[one.views > 0])
    return np.concatenate(out)


def test_points_are_followed_to_a_tenth_of_a_pixel(scene):
    seen = track(scene.images)
    error = errors(seen, scene)
    assert np.median(np.linalg.norm(error, axis=1)) < 0.05
    assert np.quantile(np.linalg.norm(error, axis=1), 0.99) < 0.3
    assert np.abs(error.mean(axis=0)).max() < 0.02
    assert min(len(s.feature) for s in seen) > 60


def test_views_count_the_images_that_showed_a_feature(scene):
    seen = track(scene.images)
    shown: dict[int, int] = {}
    for one in seen:
        for feature, views in zip(one.feature.tolist(), one.views.tolist(), strict=True):
            assert views == shown.get(feature, 0)
            shown[feature] = views + 1
    assert max(shown.values()) <= MOST_VIEWS


def test_an_image_that_is_passed_over_counts_as_no_view(scene):
    """Every other image, as at a high rate."""
    tracker, seen = Tracker(), []
    for k, image in enumerate(scene.images):
        if k % 2:
            tracker.pass_over(image)
        else:
            seen.append(tracker.add(image))
    assert max(int(one.views.max()) for one in seen) == len(seen) - 1
    half = Turning(scene.images[::2], scene.homographies[::2])
    assert np.median(np.linalg.norm(errors(seen, half), axis=1)) < 0.05


def test_tracks_that_begin_together_do_not_end_together(scene):
    """The scene seen to and fro, twice as long as a track."""
    seen = track((scene.images + scene.images[::-1]) * 2)
    ended = [len(np.setdiff1d(a.feature, b.feature)) for a, b in zip(seen, seen[1:], strict=False)]
    assert max(ended) < 0.3 * len(seen[0].feature)


def test_the_same_images_give_the_same_tracks(scene):
    a, b = (track(scene.images) for _ in range(2))
    assert all((p.feature == q.feature).all() and (p.uv == q.uv).all() for p, q in zip(a, b, strict=True))


@pytest.mark.parametrize("gain", [0.5, 1.6])
def test_a_jump_of_the_exposure_ends_few_tracks(scene, gain):
    images = list(scene.images)
    images[6:] = [np.clip(gain * (i.astype(float) - 128.0) + 100.0, 0, 255).astype(np.uint8) for i in images[6:]]
    seen = track(images)
    kept = len(np.intersect1d(seen[5].feature, seen[6].feature))
    assert kept > 0.8 * len(seen[5].feature)
    assert np.median(np.linalg.norm(errors(seen, scene), axis=1)) < 0.08


def test_an_even_image_has_no_points_and_ends_all_tracks(scene):
    grey = np.full(SIZE[::-1], 90, np.uint8)
    seen = track([scene.images[0], grey, scene.images[2]])
    assert len(seen[1].feature) == 0
    assert len(seen[2].feature) > 60 and not np.isin(seen[2].feature, seen[0].feature).any()
