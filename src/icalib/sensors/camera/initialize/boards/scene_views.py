"""Selects the images and corners from which a scene of several bodies is reconstructed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree

from icalib.data.measurements import CornerStream
from icalib.model.bodies import Bodies
from icalib.sensors.camera.corner_factor import Views
from icalib.sensors.camera.initialize.boards.bundle_adjustment import SceneViews
from icalib.sensors.camera.initialize.boards.target_poses import MAX_POSE_CORNERS

MAX_SCENE_IMAGES = 60  # of a camera, spread over the recording; the cost of bundle adjustment grows with the number
IMAGES_PER_PAIR = 4  # images of each pair of bodies in the spanning tree, so that one bad image does not separate them


def informative_images(stream: CornerStream, body: np.ndarray) -> CornerStream:
    """Images spread over the recording, and images that connect the bodies; body: (n_points,) the body of each point.

    In the graph of bodies, the weight of an edge is the number of images that show both bodies. For each edge of the
    maximum spanning forest, at least `IMAGES_PER_PAIR` images with both bodies are used, if there are so many.
    """
    n, m = len(stream.stamps_ns), int(body.max()) + 1
    shows = np.zeros((n, m), dtype=np.float32)
    shows[stream.image, body[stream.point]] = 1
    chosen = np.zeros(n, dtype=bool)
    chosen[np.linspace(0, n - 1, min(n, MAX_SCENE_IMAGES)).astype(int)] = True
    tree = minimum_spanning_tree(-np.triu(shows.T @ shows, 1)).tocoo()
    for a, b in zip(tree.row, tree.col, strict=True):
        both = np.flatnonzero(shows[:, a] * shows[:, b])
        lacking = min(IMAGES_PER_PAIR, len(both)) - int(chosen[both].sum())
        if lacking > 0:
            rest = both[~chosen[both]]
            chosen[rest[np.argsort(-np.diff(stream.start)[rest], kind="stable")[:lacking]]] = True
    rows = chosen[stream.image]
    return stream.of_rows(rows, stream.stamps_ns[chosen], np.diff(stream.start)[chosen])


def scene_views(bodies: Bodies, streams: Sequence[CornerStream], begins: np.ndarray) -> SceneViews:
    """All views of all cameras, with up to `MAX_POSE_CORNERS` corners each.

    begins: (C + 1,) number of the first image of each camera, then the number of all images.
    """
    columns = []
    for c, stream in enumerate(streams):
        views = Views.of(stream, bodies.target.body)
        keep = _spread_corners(views)
        count = np.add.reduceat(keep.astype(np.int64), views.start[:-1])
        points = bodies.target.points[stream.point[keep]]
        columns.append((count, views.image + begins[c], views.body, points, stream.uv[keep]))
    count, image, body, points, uv = (np.concatenate(column) for column in zip(*columns, strict=True))
    camera = np.repeat(np.arange(len(streams)), np.diff(begins))
    return SceneViews(np.concatenate([[0], np.cumsum(count)]), image, body, points, uv, camera)


def _spread_corners(views: Views) -> np.ndarray:
    """(N,) bool: selects at most `MAX_POSE_CORNERS` corners of each view, evenly spaced in its list of corners."""
    length = np.diff(views.start)
    place = np.arange(int(views.start[-1])) - np.repeat(views.start[:-1], length)
    length = np.repeat(length, length)
    most = np.minimum(length, MAX_POSE_CORNERS)
    return (place * most) // length != ((place - 1) * most) // length
