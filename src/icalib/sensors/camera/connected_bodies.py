"""Selects the bodies of a target whose poses are estimated: those that shared images connect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry.targets import Target
from icalib.model.bodies import Bodies
from icalib.motion.keyframe_placement import MERGED_WITHIN_S
from icalib.rig import Rig

MIN_SHARED_IMAGES = 3  # that show both of two bodies, for their relative pose to count as observed
MAX_NAMED_BODIES = 8  # in a sentence


def choose_bodies(target: Target, recordings: Sequence[Measurements], bent: bool, rig: Rig | None = None) -> Bodies:
    """The bodies in use: the one with most corners, which is the reference, and all that images connect to it.

    An image connects all bodies that it shows; connections through other bodies count. In a `rig` of cameras alone,
    simultaneous images of different cameras connect bodies, too. bent: whether shapes of bodies are estimated.

    Raises EstimationError if no corner was seen, or if a camera saw only bodies without connection to the reference.
    """
    streams = [c for m in recordings for c in m.cameras]
    n = len(target.bodies)
    if n == 0:
        return Bodies(target, ())
    count = sum((np.bincount(target.body[s.point], minlength=n) for s in streams), np.zeros(n, dtype=np.int64))
    if not count.any():
        raise EstimationError("no camera saw the target; check the target in the rig file.")
    together = _in_images(target.body, recordings, n)
    if rig is not None and rig.cameras_alone:
        together += sum(_at_once(target.body, rig, m, n) for m in recordings)
    reached = _tied_to(int(np.argmax(count)), together)
    lost = tuple(int(k) for k in np.flatnonzero(count) if k not in reached)
    _check_cameras(target, streams, reached, rig is not None and rig.imu is not None)
    return Bodies(target, reached, lost, bent, sized=target.size_sigma > 0.0)


def tied_by_images(bodies: Bodies, recordings: Sequence[Measurements]) -> list[tuple[int, ...]]:
    """The bodies in use, grouped by connection through images. The first group has the reference."""
    together = _in_images(bodies.target.body, recordings, len(bodies.target.bodies))
    left, groups = list(bodies.used), []
    while left:
        groups.append(_tied_to(left[0], together))
        left = [k for k in left if k not in groups[-1]]
    return groups


def _tied_to(first: int, together: np.ndarray) -> tuple[int, ...]:
    """Indices of the body `first`, then in increasing order of all bodies connected to it.

    together (n, n): number of images that show both bodies of a pair."""
    reached = [first]
    for k in reached:
        reached += [int(j) for j in np.flatnonzero(together[k] >= MIN_SHARED_IMAGES) if j not in reached]
    return (first, *sorted(reached[1:]))


def _in_images(body: np.ndarray, recordings: Sequence[Measurements], n: int) -> np.ndarray:
    """(n, n) number of images, of all recordings and cameras, that show both bodies of a pair.

    body (n_points,): index of the body of each point."""
    return sum((_together(body, c, n) for m in recordings for c in m.cameras), np.zeros((n, n), dtype=np.int64))


def _check_cameras(target: Target, streams: Sequence[CornerStream], used: Sequence[int], imu: bool) -> None:
    """Raises EstimationError naming a camera that saw bodies, but none of those in use.

    used: indices of these; imu: whether the rig has an IMU."""
    for name in dict.fromkeys(s.name for s in streams):
        bodies = np.unique(np.concatenate([target.body[s.point] for s in streams if s.name == name]))
        if len(bodies) and not np.isin(bodies, used).any():
            how = (
                "calibrate the cameras without the IMU, whose images may be synchronised"
                if imu
                else ("take images of all cameras at the same instants")
            )
            names, first = _listed([target.bodies[k] for k in bodies]), target.bodies[used[0]]
            raise EstimationError(
                f"{name} sees {names} only, and fewer than {MIN_SHARED_IMAGES} images determine its pose relative "
                f"to {first}; show both in the same images, or {how}."
            )


def _together(body: np.ndarray, stream: CornerStream, n: int) -> np.ndarray:
    """(n, n) number of images of `stream` that show both bodies of a pair."""
    pairs = np.unique(stream.image * n + body[stream.point])
    image, which = np.divmod(pairs, n)
    shows = np.zeros((len(stream.stamps_ns), n), dtype=np.float32)
    shows[image, which] = 1.0
    return np.rint(shows.T @ shows).astype(np.int64)


def _at_once(body: np.ndarray, rig: Rig, recording: Measurements, n: int) -> np.ndarray:
    """(n, n) number of instants at which one camera sees body i while another camera sees body j."""
    count, shows = np.zeros((n, n), dtype=np.int64), []
    for stream in recording.cameras:
        rows = np.zeros((len(stream.stamps_ns), n), dtype=np.int64)
        rows[stream.image, body[stream.point]] = 1
        shows.append(rows)
    times = camera_times(rig, recording, recording.origin_ns)
    for a, b in permutations(range(len(shows)), 2):
        i, j = taken_at_once(times[a], times[b])
        count += shows[a][i].T @ shows[b][j]
    return count


def camera_times(rig: Rig, recording: Measurements, origin_ns: int) -> list[np.ndarray]:
    """For each camera (M,) instants of its images [s since `origin_ns`], by the time offset of the rig file or zero."""
    given = [c.time_offset.value for c in rig.cameras]
    offsets_ns = [0 if v is None else round(float(v[0]) * 1e9) for v in given]
    pairs = zip(recording.cameras, offsets_ns, strict=True)
    return [(s.stamps_ns - origin_ns + offset_ns) * 1e-9 for s, offset_ns in pairs]


def taken_at_once(ta: np.ndarray, tb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices i and j (k,) of images at ta (n,) and tb (m,) s that are at most `MERGED_WITHIN_S` apart."""
    j = np.clip(np.searchsorted(tb, ta - MERGED_WITHIN_S), 0, len(tb) - 1)
    i = np.flatnonzero(np.abs(tb[j] - ta) <= MERGED_WITHIN_S)
    return i, j[i]


def restrict(bodies: Bodies, recording: Measurements) -> Measurements:
    """The recording without corners of bodies that are not in use; corners of each image are sorted by body."""
    if len(bodies.target.bodies) == 1:
        return recording
    return recording.with_streams(*(_restricted(bodies, c) for c in recording.cameras))


def without_bodies(target: Target, names: Sequence[str], recording: Measurements) -> Measurements:
    """The recording without corners of the bodies called `names`, with a note on them."""
    kept = tuple(k for k, name in enumerate(target.bodies) if name not in names)
    cameras = [_restricted(Bodies(target, kept), c) for c in recording.cameras]
    note = f"ignored, because no image determines their poses relative to the others: {_listed(names)}."
    return replace(recording.with_streams(*cameras), notes=(*recording.notes, note))


def _restricted(bodies: Bodies, stream: CornerStream) -> CornerStream:
    """The corners of bodies in use, sorted by body in each image. Images without such corners are left out."""
    body = bodies.target.body[stream.point]
    order = np.lexsort((body, stream.image))
    order = order[np.isin(body[order], bodies.used)]
    count = np.bincount(stream.image[order], minlength=len(stream.stamps_ns))
    return stream.of_rows(order, stream.stamps_ns[count > 0], count[count > 0])


def words_on_left_out(bodies: Bodies) -> str:
    """A sentence on the bodies that were seen but are not used; empty if there are none."""
    if not bodies.left_out:
        return ""
    names = [bodies.target.bodies[k] for k in bodies.left_out]
    return (
        f"ignored, because fewer than {MIN_SHARED_IMAGES} images show them together with the others: {_listed(names)}."
    )


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - MAX_NAMED_BODIES} more" if len(names) > MAX_NAMED_BODIES else ""
    return f"{', '.join(names[:MAX_NAMED_BODIES])}{more}"
