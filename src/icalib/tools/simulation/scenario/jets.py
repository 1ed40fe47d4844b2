"""Functions of time with their derivatives, by arithmetic of truncated Taylor series (automatic differentiation)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Vector = tuple["Jet", "Jet", "Jet"]
Rows = tuple[Vector, Vector, Vector]  # a matrix, row by row


@dataclass(frozen=True, eq=False)
class Jet:
    """A function of time at N instants. c (K + 1, N): Taylor coefficients f, f', f''/2, ... f^(K)/K! at each."""

    c: np.ndarray

    @staticmethod
    def time(seconds: np.ndarray, order: int) -> Jet:
        """The function t at seconds (N,), with derivatives up to `order`, at least 1."""
        c = np.zeros((order + 1, len(seconds)))
        c[0], c[1] = seconds, 1.0
        return Jet(c)

    def constant(self, value: float) -> Jet:
        """The constant function `value`, with the instants and the order of this one."""
        c = np.zeros_like(self.c)
        c[0] = value
        return Jet(c)

    def derivative(self) -> Jet:
        """The derivative f', with an order lower by one."""
        return Jet(self.c[1:] * np.arange(1, len(self.c))[:, None])

    def shortened(self, order: int) -> Jet:
        return Jet(self.c[: order + 1])

    def at(self, order: int) -> np.ndarray:
        """(N,) derivative of order 0, 1 or 2 at each instant."""
        return self.c[order] * (1.0, 1.0, 2.0)[order]

    def __add__(self, other: Jet | float) -> Jet:
        return Jet(self.c + (other.c if isinstance(other, Jet) else self.constant(other).c))

    def __neg__(self) -> Jet:
        return Jet(-self.c)

    def __sub__(self, other: Jet | float) -> Jet:
        return self + (-other)

    def __mul__(self, other: Jet | float) -> Jet:
        if not isinstance(other, Jet):
            return Jet(self.c * other)
        return Jet(np.stack([_folded(self.c, other.c, range(k + 1), k) for k in range(len(self.c))]))

    __rmul__ = __mul__
    __radd__ = __add__

    def __truediv__(self, other: Jet) -> Jet:
        c = np.empty_like(self.c)
        for k in range(len(c)):
            c[k] = (self.c[k] - _folded(c, other.c, range(k), k)) / other.c[0]
        return Jet(c)

    def sqrt(self) -> Jet:
        c = np.empty_like(self.c)
        c[0] = np.sqrt(self.c[0])
        for k in range(1, len(c)):
            c[k] = (self.c[k] - _folded(c, c, range(1, k), k)) / (2.0 * c[0])
        return Jet(c)

    def sine_cosine(self) -> tuple[Jet, Jet]:
        """sin(f) and cos(f), coefficient by coefficient from s' = c f' and c' = -s f'."""
        sine, cosine = np.empty_like(self.c), np.empty_like(self.c)
        sine[0], cosine[0] = np.sin(self.c[0]), np.cos(self.c[0])
        slope = self.derivative().c
        for k in range(1, len(sine)):
            sine[k] = _folded(slope, cosine, range(k), k - 1) / k
            cosine[k] = -_folded(slope, sine, range(k), k - 1) / k
        return Jet(sine), Jet(cosine)


def _folded(a: np.ndarray, b: np.ndarray, terms: range, k: int) -> np.ndarray:
    """(N,) sum of a[i] b[k - i] over the indices i in `terms`."""
    total = np.zeros(a.shape[1])
    for i in terms:
        total += a[i] * b[k - i]
    return total


def dot(a: Vector, b: Vector) -> Jet:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def unit(a: Vector) -> Vector:
    length = dot(a, a).sqrt()
    return a[0] / length, a[1] / length, a[2] / length


def cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def values(vector: Vector, order: int) -> np.ndarray:
    """(N, 3) derivative of order 0, 1 or 2 of a vector."""
    return np.stack([component.at(order) for component in vector], axis=1)


def matrices(rows: Rows, order: int) -> np.ndarray:
    """(N, 3, 3) derivative of order 0, 1 or 2 of a matrix."""
    return np.stack([values(row, order) for row in rows], axis=1)
