"""Writes CSV tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_table(path: Path, header: str, *columns: np.ndarray) -> None:
    """Writes a CSV file with all digits of its numbers. columns: arrays (N,) or (N, k)."""
    lists = [c.tolist() for column in columns for c in (column.T if column.ndim == 2 else [column])]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        file.write(f"#{header}\n")
        file.writelines(",".join(map(repr, row)) + "\n" for row in zip(*lists, strict=True))
