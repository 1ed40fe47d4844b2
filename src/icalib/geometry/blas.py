"""BLAS and LAPACK for compiled kernels, on blocks of row-major arrays, without Python's global interpreter lock.

BLAS assumes column-major order and therefore reads the transpose of a row-major matrix. Upper triangles here are lower
triangles for BLAS.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
import numpy as np
from numba import types
from numba.extending import get_cython_function_address

from icalib.base.compiled import njit

_TEXT, _INT, _REAL = types.CPointer(types.uint8), types.CPointer(types.int32), types.CPointer(types.float64)


def _external(module: str, name: str, *arguments: types.Type) -> Any:
    """The function `name` of scipy's BLAS or LAPACK, under a symbol that cached kernels find again."""
    llvm.add_symbol(f"icalib_{name}", get_cython_function_address(f"scipy.linalg.cython_{module}", name))
    return types.ExternalFunction(f"icalib_{name}", types.void(*arguments))


_dsyrk = _external("blas", "dsyrk", _TEXT, _TEXT, _INT, _INT, _REAL, _REAL, _INT, _REAL, _REAL, _INT)
_dgemm = _external("blas", "dgemm", _TEXT, _TEXT, _INT, _INT, _INT, _REAL, _REAL, _INT, _REAL, _INT, _REAL, _REAL, _INT)
_dtrsm = _external("blas", "dtrsm", _TEXT, _TEXT, _TEXT, _TEXT, _INT, _INT, _REAL, _REAL, _INT, _REAL, _INT)
_dpotrf = _external("lapack", "dpotrf", _TEXT, _INT, _REAL, _INT, _INT)


@njit(cache=True, nogil=True)
def _stride(A):
    """Distance between rows in numbers. A matrix with one row may have any stride, so that it is bounded from below."""
    return max(A.strides[0] // 8, A.shape[1], 1)


@njit(cache=True, nogil=True)
def _letters(a, b, c, d):
    """ASCII codes of the option characters of a BLAS call."""
    return np.array([ord(a), ord(b), ord(c), ord(d)], dtype=np.uint8)


@njit(cache=True, nogil=True)
def subtract_gram(W, C):
    """Upper triangle of C (n, n) <- C - W^T W, for W (k, n)."""
    k, n = W.shape
    if k == 0 or n == 0:
        return
    sizes, factors = np.array([n, k, _stride(W), _stride(C)], dtype=np.int32), np.array([-1.0, 1.0])
    t = _letters("L", "N", " ", " ")
    _dsyrk(
        t[0:].ctypes,
        t[1:].ctypes,
        sizes[0:].ctypes,
        sizes[1:].ctypes,
        factors[0:].ctypes,
        W.ctypes,
        sizes[2:].ctypes,
        factors[1:].ctypes,
        C.ctypes,
        sizes[3:].ctypes,
    )


@njit(cache=True, nogil=True)
def subtract_product(A, B, C):
    """C (m, n) <- C - A^T B, for A (k, m) and B (k, n)."""
    k, m, n = A.shape[0], A.shape[1], B.shape[1]
    if k == 0 or m == 0 or n == 0:
        return
    sizes = np.array([n, m, k, _stride(B), _stride(A), _stride(C)], dtype=np.int32)
    factors, t = np.array([-1.0, 1.0]), _letters("N", "T", " ", " ")
    _dgemm(
        t[0:].ctypes,
        t[1:].ctypes,
        sizes[0:].ctypes,
        sizes[1:].ctypes,
        sizes[2:].ctypes,
        factors[0:].ctypes,
        B.ctypes,
        sizes[3:].ctypes,
        A.ctypes,
        sizes[4:].ctypes,
        factors[1:].ctypes,
        C.ctypes,
        sizes[5:].ctypes,
    )


@njit(cache=True, nogil=True)
def factorise(A):
    """Overwrite the upper triangle of A (n, n) with its Cholesky factor U, A = U^T U. False if A is not positive
    definite or not finite."""
    n = len(A)
    if n == 0:
        return True
    sizes, t = np.array([n, _stride(A), 0], dtype=np.int32), _letters("L", " ", " ", " ")
    _dpotrf(t.ctypes, sizes[0:].ctypes, A.ctypes, sizes[1:].ctypes, sizes[2:].ctypes)
    for i in range(n):
        if not A[i, i] > 0.0 or not np.isfinite(A[i, i]):
            return False
    return sizes[2] == 0


@njit(cache=True, nogil=True)
def solve_transposed(U, X):
    """X (p, n) <- U^-T X, for the upper triangle of U (p, p)."""
    p, n = X.shape
    if p == 0 or n == 0:
        return
    sizes, one = np.array([n, p, _stride(U), _stride(X)], dtype=np.int32), np.ones(1)
    t = _letters("R", "L", "T", "N")
    _dtrsm(
        t[0:].ctypes,
        t[1:].ctypes,
        t[2:].ctypes,
        t[3:].ctypes,
        sizes[0:].ctypes,
        sizes[1:].ctypes,
        one.ctypes,
        U.ctypes,
        sizes[2:].ctypes,
        X.ctypes,
        sizes[3:].ctypes,
    )


@njit(cache=True, nogil=True)
def solve_upper(U, x):
    """x (p,) <- U^-1 x, for the upper triangle of U (p, p)."""
    for i in range(len(x) - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, len(x)):
            s -= U[i, k] * x[k]
        x[i] = s / U[i, i]
