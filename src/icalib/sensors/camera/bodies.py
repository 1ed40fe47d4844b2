"""The rigid bodies that a target consists of: which of them are estimated, and where their points are.

The first body in use is the reference: its frame is the scene's, in which the others have poses that are estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations

import numpy as np

from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry.targets import Target
from icalib.geometry.targets.base import BOARD
from icalib.motion.nodes import MERGED_WITHIN_S
from icalib.optim.state import Entry, Key, Layout
from icalib.rig import Rig, scene
from icalib.sensors.camera.board import shape_basis

FEWEST_TOGETHER = 3  # images with both of two bodies that tie them to each other
MOST_NAMED = 8  # bodies in a sentence
SIZE: Key = (BOARD, scene.SIZE.name)  # (1,) true lengths over those of the target as stated


@dataclass(frozen=True)
class Bodies:
    """used: indices of the target's bodies that are estimated, the reference first; left_out: those that were seen, but
    too seldom with others; bent: whether bodies may bend; size: of each body, in what the target says. sized: whether
    the size is a parameter of its own, on which `size` is a factor."""

    target: Target
    used: tuple[int, ...]
    left_out: tuple[int, ...] = ()
    bent: bool = False
    size: float = 1.0
    sized: bool = False

    @property
    def several(self) -> bool:
        return len(self.used) > 1

    @property
    def names(self) -> tuple[str, ...]:
        """Of those in use."""
        return tuple(self.target.bodies[k] for k in self.used)

    @property
    def bending(self) -> tuple[str, ...]:
        """Names of those whose shape is estimated."""
        return tuple(self.target.bodies[k] for k in self.used if self.bent and self.target.bends[k])

    @cached_property
    def basis(self) -> np.ndarray:
        """(n_points, s, 3) displacement of each point by unit of its body's shape parameters, in the body's frame."""
        return shape_basis(self.target, self.bent)

    @cached_property
    def deformation(self) -> np.ndarray:
        """(n_points, s or s + 1, 3) `basis`, and after it by unit of the size where it is a parameter."""
        grown = self.size * self.target.points[:, None, :]
        return np.concatenate([self.basis, grown], axis=1) if self.sized else self.basis

    def size_entries(self) -> list[Entry]:
        """The block of a layout for the size of all bodies together."""
        return [scene.SIZE.entry(BOARD)] if self.sized and self.used else []

    def shape_entries(self) -> list[Entry]:
        """Blocks of a layout for how bodies bend."""
        return [scene.SHAPE.entry(name) for name in self.bending]

    def pose_entries(self) -> list[Entry]:
        """Blocks of a layout for poses in the scene, the reference's fixed; none where there is one body only."""
        names = self.names if self.several else ()
        return [spec.entry(name, name != self.names[0]) for name in names for spec in scene.BODY]

    def columns(self, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
        """Border columns of each of the target's bodies: pose (n, 6, or 0 where only one is in use), and shape and size
        as in `deformation` (n, s or s + 1), -1 where there are none."""
        names, n = self.target.bodies, len(self.target.bodies)
        pose, shape = np.full((n, 6 if self.several else 0), -1), np.full((n, self.deformation.shape[1]), -1)
        for k in self.used if self.several else ():
            pose[k] = layout.columns(names[k], "rotation", "translation")
        for k in self.used:
            if names[k] in self.bending:
                shape[k, : self.basis.shape[1]] = layout.columns(names[k], "shape")
        if self.sized:
            shape[list(self.used), -1] = layout.columns(*SIZE)
        return pose, shape

    def poses(self, values: dict[Key, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """R_scene_body (n, 3, 3) and p_scene_body (n, 3) of all the target's bodies; the identity where one has
        none."""
        n = len(self.target.bodies)
        R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        for k in self.used[1:]:
            name = self.target.bodies[k]
            R[k], p[k] = values[name, "rotation"], values[name, "translation"]
        return R, p

    def points(self, values: dict[Key, np.ndarray]) -> np.ndarray:
        """(n_points, 3) the target's points in the scene, shapes included; of the stated size if `values` has none."""
        size = self.size * values[SIZE][0] if self.sized and SIZE in values else self.size
        points, body = size * self.target.points, self.target.body
        if self.bending:
            sizes = np.zeros((len(self.target.bodies), self.basis.shape[1]))
            for k in self.used:
                if self.target.bodies[k] in self.bending:
                    sizes[k] = values[self.target.bodies[k], "shape"]
            points = points + np.einsum("nsk,ns->nk", self.basis, sizes[body])
        if not self.several:
            return points
        R, p = self.poses(values)
        return np.einsum("nij,nj->ni", R[body], points) + p[body]


def choose_bodies(target: Target, recordings: Sequence[Measurements], bent: bool, rig: Rig | None = None) -> Bodies:
    """The bodies that images tie to each other, directly or through others, in whichever recording; the one with most
    corners is the reference. Of a `rig` of cameras alone, images that different cameras take at once tie bodies, too.

    Raises EstimationError where no corner was seen, or a camera saw bodies only that nothing ties to the others.
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
    """The bodies in use, in groups that images tie, directly or through others; the reference is the first."""
    together = _in_images(bodies.target.body, recordings, len(bodies.target.bodies))
    left, groups = list(bodies.used), []
    while left:
        groups.append(_tied_to(left[0], together))
        left = [k for k in left if k not in groups[-1]]
    return groups


def _tied_to(first: int, together: np.ndarray) -> tuple[int, ...]:
    """`first`, and then in order all bodies that are tied to it; together (n, n): how often two were seen together."""
    reached = [first]
    for k in reached:
        reached += [int(j) for j in np.flatnonzero(together[k] >= FEWEST_TOGETHER) if j not in reached]
    return (first, *sorted(reached[1:]))


def _in_images(body: np.ndarray, recordings: Sequence[Measurements], n: int) -> np.ndarray:
    """(n, n) number of images that show two bodies."""
    return sum((_together(body, c, n) for m in recordings for c in m.cameras), np.zeros((n, n), dtype=np.int64))


def _check_cameras(target: Target, streams: Sequence[CornerStream], used: Sequence[int], imu: bool) -> None:
    """Raises EstimationError naming a camera that saw none of the bodies in use; imu: whether the rig has one."""
    for name in dict.fromkeys(s.name for s in streams):
        seen = np.unique(np.concatenate([target.body[s.point] for s in streams if s.name == name]))
        if len(seen) and not np.isin(seen, used).any():
            how = (
                "calibrate the cameras without the IMU, whose images may be synchronised"
                if imu
                else ("take images of all cameras at the same instants")
            )
            own, first = _listed([target.bodies[k] for k in seen]), target.bodies[used[0]]
            raise EstimationError(
                f"{name} sees {own} only, and fewer than {FEWEST_TOGETHER} images determine its pose relative "
                f"to {first}; show both in the same images, or {how}."
            )


def _together(body: np.ndarray, stream: CornerStream, n: int) -> np.ndarray:
    """(n, n) number of images that show two bodies."""
    pairs = np.unique(stream.image * n + body[stream.point])
    image, which = np.divmod(pairs, n)
    seen = np.zeros((len(stream.stamps_ns), n), dtype=np.float32)
    seen[image, which] = 1.0
    return np.rint(seen.T @ seen).astype(np.int64)


def _at_once(body: np.ndarray, rig: Rig, recording: Measurements, n: int) -> np.ndarray:
    """(n, n) number of instants at which one camera sees one body, and another camera another body."""
    found, seen = np.zeros((n, n), dtype=np.int64), []
    for stream in recording.cameras:
        rows = np.zeros((len(stream.stamps_ns), n), dtype=np.int64)
        rows[stream.image, body[stream.point]] = 1
        seen.append(rows)
    times = camera_times(rig, recording, recording.origin_ns)
    for a, b in permutations(range(len(seen)), 2):
        i, j = taken_at_once(times[a], times[b])
        found += seen[a][i].T @ seen[b][j]
    return found


def camera_times(rig: Rig, recording: Measurements, origin_ns: int) -> list[np.ndarray]:
    """(M,) s since `origin_ns` of the images of each camera, by the time offsets that the rig gives or none."""
    given = [c.time_offset.value for c in rig.cameras]
    offsets_ns = [0 if v is None else round(float(v[0]) * 1e9) for v in given]
    pairs = zip(recording.cameras, offsets_ns, strict=True)
    return [(s.stamps_ns - origin_ns + offset_ns) * 1e-9 for s, offset_ns in pairs]


def taken_at_once(ta: np.ndarray, tb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of images at ta and tb [s], the indices of those that two cameras took at the same instant."""
    j = np.clip(np.searchsorted(tb, ta - MERGED_WITHIN_S), 0, len(tb) - 1)
    i = np.flatnonzero(np.abs(tb[j] - ta) <= MERGED_WITHIN_S)
    return i, j[i]


def restrict(bodies: Bodies, recording: Measurements) -> Measurements:
    """The recording without corners of bodies that are not in use, corners of an image body by body."""
    if len(bodies.target.bodies) == 1:
        return recording
    return recording.with_streams(*(_restricted(bodies, c) for c in recording.cameras))


def without_bodies(target: Target, names: Sequence[str], recording: Measurements) -> Measurements:
    """The recording without corners of the bodies given by `names`, which a note says."""
    kept = tuple(k for k, name in enumerate(target.bodies) if name not in names)
    cameras = [_restricted(Bodies(target, kept), c) for c in recording.cameras]
    note = f"ignored, because no image determines their poses relative to the others: {_listed(names)}."
    return replace(recording.with_streams(*cameras), notes=(*recording.notes, note))


def _restricted(bodies: Bodies, stream: CornerStream) -> CornerStream:
    body = bodies.target.body[stream.point]
    order = np.lexsort((body, stream.image))
    order = order[np.isin(body[order], bodies.used)]
    count = np.bincount(stream.image[order], minlength=len(stream.stamps_ns))
    return stream.of_rows(order, stream.stamps_ns[count > 0], count[count > 0])


def words_on_left_out(bodies: Bodies) -> str:
    """A sentence on the bodies that were seen but not used; empty where there are none."""
    if not bodies.left_out:
        return ""
    names = [bodies.target.bodies[k] for k in bodies.left_out]
    return f"ignored, because fewer than {FEWEST_TOGETHER} images show them together with the others: {_listed(names)}."


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"{', '.join(names[:MOST_NAMED])}{more}"
