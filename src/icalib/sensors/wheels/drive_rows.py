"""What each kind of wheels measures: the rows of the increment factor.

A row is g_X X + g_T T - measured, with X the way of the wheels' frame and T its turn over an interval, in its own axes.
The first two rows of an interval, by kind, and what they are called:

    pair      (e_1 X -+ b/2 e_3 T) / r - turned            left, right                [rad]
    twist     e_1 X / s_v - path,  e_3 T / s_w - yaw       speed, yaw                 [m], [rad]
    steered   e_1 X / r - turned                           wheel                      [rad]
              L cos(d) e_3 T - sin(d) e_1 X                steering                   [m]

The last says that the front axle, L ahead, moves along its wheels, which point to d = steering angle + offset: the
kinematic bicycle. It is L e_3 T = tan(d) e_1 X, times cos(d), so that neither a steep angle nor standing still is
special, and so that the noise of the angle enters the derivative by L through cos(d) alone. cos and sin are means over
the interval. The other two rows, e_2 X and e_3 X, are the slip sideways and upwards [m], of all kinds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.rig import WheelKind

N_DRIVE = 3  # the most parameters of a kind
LEFT, RIGHT = -0.5, 0.5
Kinds = dict[str, slice]
SLIP: Kinds = {"lateral slip": slice(2, 3), "vertical slip": slice(3, 4)}
KINDS: dict[WheelKind, Kinds] = {
    "pair": {"wheels": slice(0, 2), **SLIP},
    "twist": {"speed": slice(0, 1), "yaw": slice(1, 2), **SLIP},
    "steered": {"wheel": slice(0, 1), "steering": slice(1, 2), **SLIP},
}
UNITS = {
    "wheels": "rad", "speed": "m", "yaw": "rad", "wheel": "rad", "steering": "m", "lateral slip": "m",
    "vertical slip": "m",
}  # fmt: skip


class Coefficients(NamedTuple):
    """Of k = n intervals, or of one for all: X, T (k, 4, 3) are g_X, g_T of each row, in wheel axes; by_X, by_T
    (k, 4, 3, 3) their derivatives: row, parameter, axis."""

    X: np.ndarray
    T: np.ndarray
    by_X: np.ndarray
    by_T: np.ndarray


def coefficients(kind: WheelKind, drive: np.ndarray, mean: np.ndarray) -> Coefficients:
    """At the parameters drive (3,), zeros where a kind has fewer; mean (n, m - 1): means over each interval of the
    rates whose integrals are the columns of `integrals_of` after the first."""
    c = _slip_rows(len(mean) if kind == "steered" else 1)
    {"pair": _pair, "twist": _twist, "steered": _steered}[kind](c, drive, mean)
    return c


def _slip_rows(k: int) -> Coefficients:
    c = Coefficients(np.zeros((k, 4, 3)), np.zeros((k, 4, 3)), np.zeros((k, 4, 3, 3)), np.zeros((k, 4, 3, 3)))
    c.X[:, 2, 1] = c.X[:, 3, 2] = 1.0
    return c


def _pair(c: Coefficients, drive: np.ndarray, mean: np.ndarray) -> None:
    del mean
    b = drive[2]
    for q, side in enumerate((LEFT, RIGHT)):
        r = drive[q]
        c.X[:, q, 0], c.T[:, q, 2] = 1.0 / r, side * b / r
        c.by_X[:, q, q, 0], c.by_T[:, q, q, 2] = -1.0 / r**2, -side * b / r**2
        c.by_T[:, q, 2, 2] = side / r


def _twist(c: Coefficients, drive: np.ndarray, mean: np.ndarray) -> None:
    del mean
    speed, yaw = drive[:2]
    c.X[:, 0, 0], c.T[:, 1, 2] = 1.0 / speed, 1.0 / yaw
    c.by_X[:, 0, 0, 0], c.by_T[:, 1, 1, 2] = -1.0 / speed**2, -1.0 / yaw**2


def _steered(c: Coefficients, drive: np.ndarray, mean: np.ndarray) -> None:
    r, base, offset = drive
    c.X[:, 0, 0], c.by_X[:, 0, 0, 0] = 1.0 / r, -1.0 / r**2
    cosine = mean[:, 0] * np.cos(offset) - mean[:, 1] * np.sin(offset)
    sine = mean[:, 1] * np.cos(offset) + mean[:, 0] * np.sin(offset)
    c.X[:, 1, 0], c.T[:, 1, 2] = -sine, base * cosine
    c.by_T[:, 1, 1, 2] = cosine
    c.by_X[:, 1, 2, 0], c.by_T[:, 1, 2, 2] = -cosine, -base * sine
