"""docs/rig.svg, the picture of the README: python benchmarks/readme_picture.py

The sensors of examples/paper/table2-3d.yaml, drawn where the scenario has them, with the mean standard deviations of
docs/studies/table2-3d-none.json. `tests/test_readme.py` holds the picture against both files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "rig.svg"
SCENARIO = ROOT / "examples" / "paper" / "table2-3d.yaml"
STUDY = ROOT / "docs" / "studies" / "table2-3d-none.json"
AXES = (("#d62728", "x"), ("#2ca02c", "y"), ("#1f77b4", "z"))
SCALE, LENGTH, CENTER = 520.0, 0.07, (205.0, 150.0)  # px per m; of an axis, m; of the IMU, px
VIEW = np.array([[-0.45, -0.89, 0.0], [0.38, -0.19, -0.90]])  # world -> right and down on the page
LABELS = {
    "imu0": (10, 32),
    "cam0": (-62, 58),
    "cam1": (-66, -46),
    "cam2": (48, 42),
    "lidar0": (52, 0),
    "wheel0": (-26, 34),
}
UNITS = (("rotation", "rad", 57.29578, "deg"), ("translation", "m", 1e3, "mm"), ("time_offset", "s", 1e6, "us"))
HEAD = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 860 360" font-family="sans-serif" font-size="15">'


def main() -> None:
    PICTURE.write_text(picture(), encoding="utf-8")


def picture() -> str:
    """The SVG as text."""
    sensors = yaml.safe_load(SCENARIO.read_text(encoding="utf-8"))["sensors"]
    poses = {name: np.array(fields.get("T_imu_sensor", np.eye(4)), float) for name, fields in sensors.items()}
    lines = [HEAD, '<rect width="860" height="360" rx="8" fill="#fff"/>']
    for name, pose in poses.items():
        lines += frame(name, pose)
    lines += table(sigmas())
    return "\n".join([*lines, "</svg>"]) + "\n"


def sigmas() -> dict[str, list[str]]:
    """Mean standard deviations of each sensor's rotation, translation and time offset, as text."""
    blocks = {(b["sensor"], b["name"]): b for b in json.loads(STUDY.read_text(encoding="utf-8"))["blocks"]}
    found: dict[str, list[str]] = {}
    for name, unit, scale, shown in UNITS:
        for (sensor, block), figures in blocks.items():
            if block == name and figures["unit"] == unit:
                found.setdefault(sensor, []).append(f"{scale * figures['mean_sigma']:.2g} {shown}")
    return found


def frame(name: str, pose: np.ndarray) -> Iterator[str]:
    """The axes of a sensor, a line from the IMU to it, and its name. `pose` is T_imu_sensor."""
    origin = on_page(pose[:3, 3])
    yield f'<path d="M{_xy(CENTER)}L{_xy(origin)}" stroke="#bbb" stroke-dasharray="4 3"/>'
    for k, (colour, _) in enumerate(AXES):
        end = on_page(pose[:3, 3] + LENGTH * pose[:3, k])
        yield f'<path d="M{_xy(origin)}L{_xy(end)}" stroke="{colour}" stroke-width="3" stroke-linecap="round"/>'
    for outline in body(name):
        points = " ".join(_xy(on_page(pose[:3, :3] @ point + pose[:3, 3])) for point in outline)
        yield f'<polyline points="{points}" fill="none" stroke="#888"/>'
    x, y = np.add(origin, LABELS[name])
    yield f'<circle cx="{origin[0]:.0f}" cy="{origin[1]:.0f}" r="4" fill="#333"/>'
    yield f'<text x="{x:.0f}" y="{y:.0f}" font-weight="bold">{name}</text>'


def body(name: str) -> list[np.ndarray]:
    """(N, 3) outlines of what a sensor looks like, in its frame: a camera's view, a LiDAR's scan, two wheels."""
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    if name.startswith("cam"):
        corners = np.array([[x, y, 0.1] for x, y in ((-0.08, -0.05), (0.08, -0.05), (0.08, 0.05), (-0.08, 0.05))])
        return [np.array([corners[k], np.zeros(3), corners[k - 1], corners[k]]) for k in range(4)]
    if name.startswith("lidar"):
        return [
            np.stack([0.09 * np.cos(turn), 0.09 * np.sin(turn), np.full(49, h)], axis=1) for h in (-0.03, 0.0, 0.03)
        ]
    if name.startswith("wheel"):
        return [np.stack([0.1 * np.cos(turn), np.full(49, y), 0.1 * np.sin(turn)], axis=1) for y in (-0.21, 0.21)]
    return []


def table(found: dict[str, list[str]]) -> Iterator[str]:
    """Standard deviations, a row for each sensor."""
    columns = (440, 535, 660, 770)
    cells = [("from one recording", "rotation", "translation", "time offset"), *((n, *row) for n, row in found.items())]
    for k, row in enumerate(cells):
        y = 80 + 34 * k
        style = ' fill="#777" font-size="13"' if k == 0 else ""
        for x, cell in zip(columns, row, strict=True):
            text = cell if k == 0 or x == columns[0] else f"± {cell}"
            yield f'<text x="{x}" y="{y}"{style}>{"" if text == "from one recording" else text}</text>'
        yield f'<path d="M440 {y + 11}H848" stroke="#ddd"/>'
    text = "60 s of a simulated room, no initial guess, 100 recordings"
    yield f'<text x="440" y="{92 + 34 * len(cells)}" fill="#777" font-size="13">{text}</text>'


def on_page(point: np.ndarray) -> tuple[float, float]:
    """A point of the IMU's frame [m] on the page [px]."""
    right, down = SCALE * VIEW @ point
    return CENTER[0] + right, CENTER[1] + down


def _xy(point: tuple[float, float]) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


if __name__ == "__main__":
    main()
