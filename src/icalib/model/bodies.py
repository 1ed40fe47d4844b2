"""Rigid bodies of a target: shapes, poses in the scene, and points.

The first body in use is the reference. Its frame is the frame of the scene, in which the poses of all other bodies are
estimated.
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

SIZE: Key = (BOARD, scene.SIZE.name)  # (1,) factor on the lengths of the target
# Prior standard deviations: boards are flat to a few millimetres, and printed to about one.
SHAPE_SIGMA_M = np.array([3e-3] * len(BOW_LABELS) + [1e-3] * len(IN_PLANE_LABELS))


@dataclass(frozen=True)
class Bodies:
    """Bodies of a target that are in use.

    used: indices of the bodies, the reference first. left_out: observed bodies that share too few images with others.
    bent: whether shapes are estimated. sized: whether true over stated lengths of the target are.
    """

    target: Target
    used: tuple[int, ...]
    left_out: tuple[int, ...] = ()
    bent: bool = False
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
        """Names of the bodies whose shape is estimated."""
        return tuple(self.target.bodies[k] for k in self.used if self.bent and self.target.bends[k])

    @cached_property
    def basis(self) -> np.ndarray:
        """(n_points, s, 3) displacement [m] of each point in the frame of its body, per unit of each shape
        parameter."""
        return shape_basis(self.target, self.bent)

    @cached_property
    def deformation(self) -> np.ndarray:
        """(n_points, s or s + 1, 3) `basis` [m], followed by the displacement per unit of the size factor if that is
        estimated."""
        return np.concatenate([self.basis, self.target.points[:, None, :]], axis=1) if self.sized else self.basis

    def size_entries(self) -> list[Entry]:
        """Layout entry of the size factor, which all bodies share; empty if it is not estimated."""
        return [scene.SIZE.entry(BOARD)] if self.sized and self.used else []

    def shape_entries(self) -> list[Entry]:
        """Layout entries of the estimated shapes."""
        return [scene.SHAPE.entry(name) for name in self.bending]

    def pose_entries(self) -> list[Entry]:
        """Layout entries of the poses of bodies in the scene, the reference fixed; empty for a single body."""
        names = self.names if self.several else ()
        return [spec.entry(name, name != self.names[0]) for name in names for spec in scene.BODY]

    def columns(self, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
        """Calibration columns for all bodies of the target, -1 where not estimated. Pose (n, 6), or (n, 0) if only one
        body is in use; shape and size (n, s or s + 1), in the order of `deformation`."""
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
        """R_scene_body (n, 3, 3) and p_scene_body (n, 3) [m] of all bodies of the target; the identity for the
        reference and bodies not in use."""
        n = len(self.target.bodies)
        R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        for k in self.used[1:]:
            name = self.target.bodies[k]
            R[k], p[k] = values[name, "rotation"], values[name, "translation"]
        return R, p

    def points(self, values: dict[Key, np.ndarray]) -> np.ndarray:
        """(n_points, 3) points of the target in the scene [m], shapes included. The size factor is 1 if `values` has
        none."""
        points, body = self.target.points, self.target.body
        if self.sized and SIZE in values:
            points = values[SIZE][0] * points
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
    """(n_points, s, 3) displacement [m] in the frame of each point's body, per unit of each shape parameter. Zero for
    bodies that do not bend; s = 0 if none bends or not `bent`."""
    if not (bent and target.bends.any()):
        return np.zeros((len(target.points), 0, 3))
    basis = np.zeros((len(target.points), len(SHAPE_LABELS), 3))
    for k in np.flatnonzero(target.bends):
        of_body = target.body == k
        basis[of_body] = _basis_of_one(target.points[of_body, :2])
    return basis


def _basis_of_one(xy: np.ndarray) -> np.ndarray:
    """(n, s, 3) shape basis of a body with points xy (n, 2).

    x and y are scaled to -1..1 over the body. Basis fields: bow z = x^2, x y, y^2; stretch (x, -y); shear (y, x);
    in-plane displacement of x or y by x^2, x y, y^2.
    """
    low, high = xy.min(axis=0), xy.max(axis=0)
    x, y = ((xy - 0.5 * (low + high)) / (0.5 * (high - low))).T
    o = np.zeros_like(x)
    squares = (x * x, x * y, y * y)
    fields = [(o, o, q) for q in squares] + [(x, -y, o), (y, x, o)]
    for q in squares:
        fields += [(q, o, o), (o, q, o)]
    return np.stack([np.stack(f, axis=1) for f in fields], axis=1)
