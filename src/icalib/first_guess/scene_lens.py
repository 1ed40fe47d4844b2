"""A lens from a scene of several bodies: one flat body alone often leaves it unsure, all together do not."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from icalib.errors import EstimationError
from icalib.estimation.assembly import assemble, image_times, nodes_for, start_values
from icalib.estimation.bodies import Bodies, choose_bodies, restrict
from icalib.estimation.corner_noise import first_noise
from icalib.estimation.inputs import inputs_for
from icalib.estimation.solver import minimise
from icalib.estimation.state import State
from icalib.first_guess.intrinsics import camera_params
from icalib.first_guess.scene import Placed, place_bodies, scene_poses
from icalib.first_guess.without_imu import guess_without_imu, trajectory_without_imu
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets.base import Target
from icalib.joining import join_corners
from icalib.measurements import CornerStream, Measurements
from icalib.rig import Camera, Rig

MOST_IMAGES = 150
OF_EACH_BODY = 6  # images at least, where there are as many
APART_NS = 100_000_000  # images are given instants of their own: those of several recordings may share one
ROUGH_DECREASE = 0.5  # of half the chi^2


def find_scene(rig: Rig, bodies: Bodies, recordings: Sequence[Measurements]) -> Placed:
    """How the bodies stand to each other, from the images of all recordings, whose streams hold corners of these bodies
    only. Raises EstimationError where images do not tell."""
    if not bodies.several:
        return Placed(bodies)
    streams = [join_corners([(r.cameras[i], 0) for r in recordings]) for i in range(len(rig.cameras))]
    params = {
        c.name: refined_params(rig, c, s, camera_params(c, s, rig.target))
        for c, s in zip(rig.cameras, streams, strict=True)
    }
    return place_bodies(bodies, streams, [camera_model(c.model) for c in rig.cameras], params)


def lens_of(camera: Camera, stream: CornerStream, target: Target, scene: Placed) -> np.ndarray:
    """(P,) parameters: what the scene has, or else a camera by itself."""
    return scene.params[camera.name] if camera.name in scene.params else camera_params(camera, stream, target)


def refined_params(rig: Rig, camera: Camera, stream: CornerStream, params: np.ndarray) -> np.ndarray:
    """(P,) parameters from bodies and lens adjusted together, every image free to stand where it likes; those that were
    given stay. As they were where the camera shows one body only, or nothing can be solved."""
    if camera.intrinsics.value is not None and camera.distortion.value is not None:
        return params
    alone = dataclasses.replace(
        rig,
        imu=None,
        cameras=(camera,),
        settings=dataclasses.replace(rig.settings, loss="huber", bloom=False, board_shape=False, common_error=False),
    )
    with suppress(EstimationError):
        return _adjusted(alone, _spread(stream, rig.target.body), params)
    return params


def _adjusted(rig: Rig, stream: CornerStream, params: np.ndarray) -> np.ndarray:
    camera, model = rig.cameras[0], camera_model(rig.cameras[0].model)
    everything = Measurements(None, (stream,))
    bodies = choose_bodies(rig.target, [everything], bent=False)
    if not bodies.several:
        return params
    inputs = inputs_for(rig, [restrict(bodies, everything)])
    seen = inputs.measurements.cameras[0]
    scene = place_bodies(bodies, [seen], [model], {camera.name: params})
    guess = guess_without_imu(
        rig, inputs.measurements, [params], [scene_poses(seen, model, params, scene)], scene.values
    )  # fmt: skip
    values = start_values(inputs, guess.values())
    nodes = nodes_for(inputs, image_times(inputs, values))
    path = trajectory_without_imu(guess, inputs.measurements, nodes)
    state = State(nodes, *path, guess.biases(len(nodes)), values)
    noise = first_noise(camera).noise(seen, camera, rig.settings)
    found = minimise(
        assemble(inputs, state, [noise], [np.ones(len(seen.uv), dtype=bool)]), state, tolerance=ROUGH_DECREASE
    )
    solved = found.state.values
    return np.concatenate([solved[camera.name, "intrinsics"], solved[camera.name, "distortion"]])


def _spread(stream: CornerStream, body: np.ndarray) -> CornerStream:
    """Images spread over the recording, and of each body (n_points,) those that show it with most corners; each at an
    instant of its own."""
    n, m = len(stream.stamps_ns), int(body.max()) + 1
    chosen = set(np.linspace(0, n - 1, min(n, MOST_IMAGES)).astype(int).tolist())
    shown, own = np.diff(stream.start), body[stream.point]
    pairs = np.unique(own * n + stream.image)
    for k in range(m):
        images = pairs[(pairs >= k * n) & (pairs < (k + 1) * n)] - k * n
        chosen.update(images[np.argsort(-shown[images], kind="stable")[:OF_EACH_BODY]].tolist())
    rows = np.isin(stream.image, sorted(chosen))
    start = np.concatenate([[0], np.cumsum(shown[sorted(chosen)])])
    stamps = APART_NS * np.arange(len(chosen), dtype=np.int64)
    return CornerStream(stream.name, stamps, start, stream.point[rows], stream.uv[rows])
