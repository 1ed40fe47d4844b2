"""Reduced normal equations of the calibration parameters, all keyframes eliminated: steps, draws and inverses in units
of the tolerances. Unobservable directions are fixed."""

from __future__ import annotations

import numpy as np

from icalib.optim.state import Layout

# Information in units of 1 / tolerance^2: a standard deviation of ten tolerances. Directions with less are fixed.
UNOBSERVABLE_BELOW = 1e-2
DETERMINED_ABOVE = 1.0  # in the same units: a standard deviation of one tolerance
MIN_INFORMATION = 1e-4  # in the same units: floor that keeps variances finite
NO_DIRECTIONS = np.zeros((0, 0))  # no direction is fixed


def calib_step(
    information: np.ndarray,
    gradient: np.ndarray,
    tolerance: np.ndarray,
    fixed_directions: np.ndarray = NO_DIRECTIONS,
    essential: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Step (B,) of the calibration parameters and its predicted decrease of half the chi^2.

    information (B, B), gradient (B,): of half the chi^2, chain marginalised. essential: columns of all but nuisance
    parameters (default: all). Fixed are the orthonormal columns of `fixed_directions` (B, m), and eigenvectors below
    UNOBSERVABLE_BELOW of the information of the essential parameters in units of `tolerance` (B,). Nuisance parameters
    count as known there: their priors bound a direction that only they move.
    """
    free, root = _free_root(information, tolerance, fixed_directions, essential)
    projected = root.T @ (free.T @ (tolerance * gradient))
    return -tolerance * (free @ (root @ projected)), float(0.5 * projected @ projected)


def _free_root(
    information: np.ndarray, tolerance: np.ndarray, fixed_directions: np.ndarray, essential: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal directions (B, n) that are not fixed, and a root (n, k) of the inverse of the information within
    them, in units of `tolerance`. Arguments as in `calib_step`."""
    n = len(tolerance)
    columns = np.arange(n) if essential is None else essential
    others = np.setdiff1d(np.arange(n), columns)
    scaled = information * tolerance[:, None] * tolerance
    candidates = complement(fixed_directions[columns] if fixed_directions.size else NO_DIRECTIONS, len(columns))
    values, vectors = np.linalg.eigh(candidates.T @ scaled[np.ix_(columns, columns)] @ candidates)
    kept = vectors[:, values > UNOBSERVABLE_BELOW]
    free = np.zeros((n, kept.shape[1] + len(others)))
    free[columns, : kept.shape[1]] = candidates @ kept
    free[others, kept.shape[1] :] = np.eye(len(others))
    values, vectors = np.linalg.eigh(free.T @ scaled @ free)
    regular = values > MIN_INFORMATION  # far from the solution rounding may leave less
    return free, vectors[:, regular] / np.sqrt(values[regular])


def least_information(information: np.ndarray, tolerance: np.ndarray) -> float:
    """Smallest eigenvalue of `information` (B, B) in units of `tolerance` (B,)."""
    return float(np.linalg.eigvalsh(tolerance[:, None] * information * tolerance).min(initial=np.inf))


def essential_information(information: np.ndarray, tolerance: np.ndarray, layout: Layout) -> float:
    """`least_information` without the rows and columns of nuisance parameters, which their priors bound."""
    essential = layout.essential
    return least_information(information[np.ix_(essential, essential)], tolerance[essential])


def complement(fixed_directions: np.ndarray, n: int) -> np.ndarray:
    """Orthonormal basis (n, n - m) of the orthogonal complement of the columns of `fixed_directions` (n, m)."""
    if not fixed_directions.size:
        return np.eye(n)
    full, _, _ = np.linalg.svd(fixed_directions, full_matrices=True)
    return full[:, fixed_directions.shape[1] :]


def restricted_root(information: np.ndarray, fixed_directions: np.ndarray) -> np.ndarray:
    """Root A (B, n) of the `restricted_inverse` A A^T; arguments as there."""
    free = complement(fixed_directions, len(information))
    values, vectors = np.linalg.eigh(free.T @ information @ free)
    return free @ vectors / np.sqrt(np.maximum(values, MIN_INFORMATION))


def restricted_inverse(information: np.ndarray, fixed_directions: np.ndarray) -> np.ndarray:
    """Inverse (B, B) of `information` (B, B) within the directions orthogonal to the orthonormal `fixed_directions` (B,
    m); all in tolerance units."""
    root = restricted_root(information, fixed_directions)
    return root @ root.T


def calib_draws(
    information: np.ndarray,
    tolerance: np.ndarray,
    fixed_directions: np.ndarray,
    white: np.ndarray,
    essential: np.ndarray | None = None,
) -> np.ndarray:
    """Draws (B, m) with the inverse information as covariance, from standard normal numbers `white` (B, m). Directions
    that `calib_step` fixes are zero. The root of the covariance is symmetric: signs of eigenvectors do not matter."""
    free, root = _free_root(information, tolerance, fixed_directions, essential)
    axes = free @ root
    return tolerance[:, None] * (axes @ ((axes / np.linalg.norm(axes, axis=0)).T @ white))
