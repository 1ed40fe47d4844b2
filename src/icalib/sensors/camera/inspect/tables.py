"""Tables of cameras for the terminal."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table
from rich.text import Text

from icalib.sensors.camera.inspect.facts import camera_views
from icalib.tools.inspection.console import plain_table
from icalib.tools.inspection.facts import Inspection


def target_table(inspection: Inspection) -> Table:
    """One row for each camera: number of images with the target, coverage of the image, tilts and distances."""
    table = plain_table(
        f"Target ({inspection.target.target.type} of {inspection.target.file})" if inspection.target else "",
        ("camera", "images", "with target", "corners", "cells covered", "tilt [deg]", "farthest / nearest"),
        right=1,
        caption=(
            "tilt: 10th to 90th percentile of the images; tilt and distances are rough, for the intrinsics are unknown."
        ),
    )
    for name, v in camera_views(inspection).items():
        share = f" ({v.seen / v.images:.0%})" if v.images else ""
        filled = sum(n > 0 for row in v.cells for n in row) if v.cells else None
        table.add_row(
            *map(
                Text,
                (
                    name,
                    "" if v.images is None else str(v.images),
                    f"{v.seen}{share}",
                    str(v.corners),
                    f"{filled} of {len(v.cells) * len(v.cells[0])}" if v.cells else "",
                    f"{v.tilt_deg[0]:.0f} to {v.tilt_deg[2]:.0f}" if v.tilt_deg else "",
                    f"{v.distance_ratio:.1f}" if v.distance_ratio else "",
                ),
            )
        )
    return table


def coverage_maps(inspection: Inspection) -> Iterator[Text]:
    """The number of corners in each part of the image of each camera, with a heading."""
    for name, view in camera_views(inspection).items():
        if view.cells:
            yield Text(f"Corners over the image of {name} (. none, 1 to 9 the share of the fullest cell):")
            yield Text(coverage_map(view.cells))


def coverage_map(cells: tuple[tuple[int, ...], ...]) -> str:
    """The grid of cells as lines of text."""
    most = max(max(row) for row in cells) or 1
    return "\n".join("  " + " ".join(_digit(n, most) for n in row) for row in cells)


def _digit(count: int, most: int) -> str:
    return str(max(1, round(9 * count / most))) if count else "."
