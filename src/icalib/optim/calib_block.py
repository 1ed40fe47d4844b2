"""The calibration parameters, everything else marginalised: steps, draws and inverses in units of the tolerances, with
what is not determined held."""

from __future__ import annotations

import numpy as np

from icalib.optim.state import Layout

# information in tolerance units: a direction known to less than ten tolerances stays where it is
UNOBSERVABLE_BELOW = 1e-2
DETERMINED_ABOVE = 1.0  # in the same units: known to one tolerance
MIN_INFORMATION = 1e-4  # of information in tolerance units; keeps variances finite
NO_DIRECTIONS = np.zeros((0, 0))


def calib_step(
    information: np.ndarray, gradient: np.ndarray, tolerance: np.ndarray, held: np.ndarray = NO_DIRECTIONS
) -> tuple[np.ndarray, float]:
    """Step (B,) of the calibration parameters and the decrease of half the chi^2 it promises; undetermined directions
    are held, and those in the columns of `held` (B, m), orthonormal.

    Directions are those of the information in units of `tolerance` (B,).
    """
    free, values, vectors = _directions(information, tolerance, held)
    projected = vectors.T @ (free.T @ (tolerance * gradient))
    step = np.where(values > UNOBSERVABLE_BELOW, -projected / np.maximum(values, UNOBSERVABLE_BELOW), 0.0)
    return tolerance * (free @ (vectors @ step)), float(-0.5 * projected @ step)


def _directions(
    information: np.ndarray, tolerance: np.ndarray, held: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns (B, n) that are free, and the eigenvalues and -vectors of the information among them, in units of
    `tolerance`."""
    free = complement(held, len(tolerance))
    scaled = information * tolerance[:, None] * tolerance
    values, vectors = np.linalg.eigh(free.T @ scaled @ free)
    return free, values, vectors


def least_information(information: np.ndarray, tolerance: np.ndarray) -> float:
    """The least of `information` (B, B), in units of `tolerance` (B,), on any direction."""
    return float(np.linalg.eigvalsh(tolerance[:, None] * information * tolerance).min(initial=np.inf))


def essential_information(information: np.ndarray, tolerance: np.ndarray, layout: Layout) -> float:
    """`least_information` where nuisance parameters are known: what their priors bound does not wander."""
    own = layout.essential
    return least_information(information[np.ix_(own, own)], tolerance[own])


def complement(held: np.ndarray, n: int) -> np.ndarray:
    """(n, n - m) orthonormal columns, all at right angles to those of `held` (n, m)."""
    if not held.size:
        return np.eye(n)
    full, _, _ = np.linalg.svd(held, full_matrices=True)
    return full[:, held.shape[1] :]


def restricted_root(information: np.ndarray, held: np.ndarray) -> np.ndarray:
    """(B, n) whose product with its transpose is the `restricted_inverse`."""
    free = complement(held, len(information))
    values, vectors = np.linalg.eigh(free.T @ information @ free)
    return free @ vectors / np.sqrt(np.maximum(values, MIN_INFORMATION))


def restricted_inverse(information: np.ndarray, held: np.ndarray) -> np.ndarray:
    """(B, B) inverse of the information within the directions that are not held, both in tolerance units."""
    root = restricted_root(information, held)
    return root @ root.T


def calib_draws(information: np.ndarray, tolerance: np.ndarray, held: np.ndarray, white: np.ndarray) -> np.ndarray:
    """(B, m) from white noise (B, m): what has the inverse of the information for its covariance, what `calib_step`
    holds held."""
    free, values, vectors = _directions(information, tolerance, held)
    scaled = np.where(values > UNOBSERVABLE_BELOW, 1.0 / np.sqrt(np.maximum(values, UNOBSERVABLE_BELOW)), 0.0)
    return tolerance[:, None] * (free @ (vectors @ (scaled[:, None] * white[: len(values)])))
