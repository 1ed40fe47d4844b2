"""The rigid bodies that a target consists of: their shapes, their poses in the scene, and where their points are.

The first body in use is the reference: its frame is the scene's, in which the others have poses that are estimated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icalib.geometry.targets import Target
from icalib.geometry.targets.base import BOARD
from icalib.optim.state import Entry, Key, Layout
from icalib.rig import scene
from icalib.rig.scene import BOW_LABELS, IN_PLANE_LABELS, SHAPE_LABELS

SIZE: Key = (BOARD, scene.SIZE.name)  # (1,) true lengths over those of the target as stated
# Standard deviations of the prior: boards are flat to a few millimetres, and printed to about one.
SHAPE_SIGMA_M = np.array([3e-3] * len(BOW_LABELS) + [1e-3] * len(IN_PLANE_LABELS))


@dataclass(frozen=True)
class Bodies:
    """The bodies of a target that are in use.

    used: their indices, the reference first; left_out: bodies that were seen, but in too few images with others; bent:
    whether their shapes are estimated; size: true lengths over those of the target; sized: whether a factor on `size`
    is a parameter as well."""

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
        """Names of the bodies in use."""
        return tuple(self.target.bodies[k] for k in self.used)

    @property
    def bending(self) -> tuple[str, ...]:
        """Names of those whose shape is estimated."""
        return tuple(self.target.bodies[k] for k in self.used if self.bent and self.target.bends[k])

    @cached_property
    def basis(self) -> np.ndarray:
        """(n_points, s, 3) m: displacement of each point, in its body's frame, by unit of its shape parameters."""
        return shape_basis(self.target, self.bent)

    @cached_property
    def deformation(self) -> np.ndarray:
        """(n_points, s or s + 1, 3) m: `basis`, then displacement by unit of the size, if that is a parameter."""
        grown = self.size * self.target.points[:, None, :]
        return np.concatenate([self.basis, grown], axis=1) if self.sized else self.basis

    def size_entries(self) -> list[Entry]:
        """Entry of the size, which all bodies share, in a layout; empty if it is no parameter."""
        return [scene.SIZE.entry(BOARD)] if self.sized and self.used else []

    def shape_entries(self) -> list[Entry]:
        """Entries of the shapes of bending bodies in a layout."""
        return [scene.SHAPE.entry(name) for name in self.bending]

    def pose_entries(self) -> list[Entry]:
        """Entries of the poses in the scene in a layout, that of the reference fixed; empty for one body."""
        names = self.names if self.several else ()
        return [spec.entry(name, name != self.names[0]) for name in names for spec in scene.BODY]

    def columns(self, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
        """Calibration columns of all bodies of the target, -1 where there are none: of the pose (n, 6, or 0 if only one
        is in use), and of shape and size (n, s or s + 1) as in `deformation`."""
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


def shape_basis(target: Target, bent: bool) -> np.ndarray:
    """(n_points, s, 3) displacement in the frame of each point's body by unit of the body's shape parameters [m]; zeros
    for bodies that do not bend, s = 0 where none may."""
    if not (bent and target.bends.any()):
        return np.zeros((len(target.points), 0, 3))
    basis = np.zeros((len(target.points), len(SHAPE_LABELS), 3))
    for k in np.flatnonzero(target.bends):
        own = target.body == k
        basis[own] = _basis_of_one(target.points[own, :2])
    return basis


def _basis_of_one(xy: np.ndarray) -> np.ndarray:
    """(n, s, 3) of the body with points xy (n, 2).

    With x and y from -1 to 1 over it: the bow z = a x^2 + b x y + c y^2; stretch (x, -y) and shear (y, x); and x or y
    moved by x^2, x y, y^2.
    """
    low, high = xy.min(axis=0), xy.max(axis=0)
    x, y = ((xy - 0.5 * (low + high)) / (0.5 * (high - low))).T
    o = np.zeros_like(x)
    squares = (x * x, x * y, y * y)
    fields = [(o, o, q) for q in squares] + [(x, -y, o), (y, x, o)]
    for q in squares:
        fields += [(q, o, o), (o, q, o)]
    return np.stack([np.stack(f, axis=1) for f in fields], axis=1)
