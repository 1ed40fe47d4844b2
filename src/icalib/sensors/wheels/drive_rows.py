"""Residual rows of the increment factor for each kind of wheels.

A row is g_X X + g_T T - measured. X [m] is the displacement and T [rad] the rotation vector of the wheel frame over an
interval, in its axes at the start. The first two rows of each kind, with names and units of their residuals:

    pair      (e_1 X -+ b/2 e_3 T) / r - angle             left, right                [rad]
    twist     e_1 X / s_v - distance,  e_3 T / s_w - yaw   speed, yaw                 [m], [rad]
    steered   e_1 X / r - angle                            wheel                      [rad]
              L cos(d) e_3 T - sin(d) e_1 X                steering                   [m]

b: baseline; r: radius; s_v, s_w: scales of speed and yaw rate; -+: left, right wheel. The steering row is the kinematic
bicycle model: the front axle, a wheelbase L ahead, moves along its wheels, which point to d = steering angle + offset.
The model L e_3 T = tan(d) e_1 X is multiplied by cos(d), so that it also holds for steep angles and standstill. The
noise of the angle then enters the derivative by L through cos(d) alone. cos and sin are means over the interval.

All kinds have the rows e_2 X and e_3 X, the lateral and the vertical slip [m]. Their noise and that of steering are
lengths that no sensor measures. The rows are divided by the unit of length of an assumed motion, see `ImuData`; else it
is 1 m.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.rig import WheelKind

N_DRIVE = 4  # largest number of parameters of a kind, and the unit of length
UNIT = N_DRIVE - 1  # its index
LEFT, RIGHT = -0.5, 0.5  # factor of baseline * e_3 T in the row of each wheel
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
    """Coefficients of the four rows in wheel axes, for each of k = n intervals, or for all of them (k = 1).

    g_X, g_T (k, 4, 3); J_g_X, J_g_T (k, 4, N_DRIVE, 3): their derivatives by the drive parameters, indexed by interval,
    row, parameter and axis.
    """

    g_X: np.ndarray
    g_T: np.ndarray
    J_g_X: np.ndarray
    J_g_T: np.ndarray


def coefficients(kind: WheelKind, drive: np.ndarray, mean: np.ndarray) -> Coefficients:
    """The coefficients at the drive parameters `drive` (N_DRIVE,), padded with zeros, the last the unit of length.

    mean (n, m - 1): means over each interval of the signals whose integrals are columns 1: of `integrals_of`.
    """
    k = len(mean) if kind == "steered" else 1
    g, J_g = (k, 4, 3), (k, 4, N_DRIVE, 3)
    c = Coefficients(np.zeros(g), np.zeros(g), np.zeros(J_g), np.zeros(J_g))
    {"pair": _pair, "twist": _twist, "steered": _steered}[kind](c, drive, mean)
    c.g_X[:, 2, 1] = c.g_X[:, 3, 2] = 1.0
    for row in (1, 2, 3) if kind == "steered" else (2, 3):
        for x, J in ((c.g_X[:, row], c.J_g_X[:, row]), (c.g_T[:, row], c.J_g_T[:, row])):
            x /= drive[UNIT]
            J /= drive[UNIT]
            J[:, UNIT] = -x / drive[UNIT]
    return c


def _pair(c: Coefficients, drive: np.ndarray, mean: np.ndarray) -> None:
    """Fills the first two rows of a pair."""
    del mean
    b = drive[2]
    for q, side in enumerate((LEFT, RIGHT)):
        r = drive[q]
        c.g_X[:, q, 0], c.g_T[:, q, 2] = 1.0 / r, side * b / r
        c.J_g_X[:, q, q, 0], c.J_g_T[:, q, q, 2] = -1.0 / r**2, -side * b / r**2
        c.J_g_T[:, q, 2, 2] = side / r


def _twist(c: Coefficients, drive: np.ndarray, mean: np.ndarray) -> None:
    """Fills the first two rows of a twist."""
    del mean
    speed, yaw = drive[:2]
    c.g_X[:, 0, 0], c.g_T[:, 1, 2] = 1.0 / speed, 1.0 / yaw
    c.J_g_X[:, 0, 0, 0], c.J_g_T[:, 1, 1, 2] = -1.0 / speed**2, -1.0 / yaw**2


def _steered(c: Coefficients, drive: np.ndarray, mean: np.ndarray) -> None:
    """Fills the first two rows of a steered vehicle; mean (n, 2 or more): mean cos and sin of the steering angle."""
    r, base, offset = drive[:UNIT]
    c.g_X[:, 0, 0], c.J_g_X[:, 0, 0, 0] = 1.0 / r, -1.0 / r**2
    cosine = mean[:, 0] * np.cos(offset) - mean[:, 1] * np.sin(offset)
    sine = mean[:, 1] * np.cos(offset) + mean[:, 0] * np.sin(offset)
    c.g_X[:, 1, 0], c.g_T[:, 1, 2] = -sine, base * cosine
    c.J_g_T[:, 1, 1, 2] = cosine
    c.J_g_X[:, 1, 2, 0], c.J_g_T[:, 1, 2, 2] = -cosine, -base * sine
