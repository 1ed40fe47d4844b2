"""The figures of docs/tour.md: parts of the reports of its calibrations, as a browser draws them. And docs/report.png,
the first screen of the first of them, for the README.

python benchmarks/tour_figures.py FOLDER      FOLDER is where the commands of the page were run
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

FIGURES = Path(__file__).resolve().parent.parent / "docs" / "tour"
FIRST_SCREEN = FIGURES.parent / "report.png"
WIDTH, TALLEST = 1100, 1600  # px
SCREEN = 1280, 800  # px
COLOURS = 256  # of the palette: keeps a figure below 150 kB
FLAGS = (
    "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--hide-scrollbars --virtual-time-budget=8000"
)


@dataclasses.dataclass(frozen=True)
class Figure:
    """A section of the report in the folder `result`, without the elements that match `hidden` (CSS)."""

    name: str
    result: str
    section: str
    hidden: str = ""


FIGURES_OF_THE_PAGE = (
    Figure("trust", "out-published", "trust"),
    Figure("corners", "out-published", "images", "#images > :nth-child(n + 5), figure:has(#time-0)"),
    Figure("corners-lens", "out", "images", "#images > :nth-child(n + 5), figure:has(#time-0)"),
    Figure("jump", "out-jump", "images", "#images > p, figure:has(:is(#plane-0, #image-0, #plane-1, #image-1))"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    chromium = installed_browser()
    FIGURES.mkdir(exist_ok=True)
    for figure in FIGURES_OF_THE_PAGE:
        draw(chromium, folder / figure.result / "report.html", figure, FIGURES / f"{figure.name}.png")
    text = (folder / "out" / "report.html").read_text(encoding="utf-8")
    save(shot(chromium, text, SCREEN), FIRST_SCREEN)


def installed_browser() -> str:
    """Path of chromium."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        raise SystemExit("no chromium is installed; install one to have the reports drawn.")
    return chromium


def draw(chromium: str, report: Path, figure: Figure, file: Path) -> None:
    """Write the part of `report` that `figure` says."""
    hidden = f"header, nav, main > section:not(#{figure.section}){', ' + figure.hidden if figure.hidden else ''}"
    style = (
        f"<style>body {{ background: #fff; display: block; }} {hidden} {{ display: none !important; }}</style></head>"
    )
    text = report.read_text(encoding="utf-8").replace("</head>", style, 1)
    image = shot(chromium, text, (WIDTH, TALLEST))
    rows = np.flatnonzero((np.asarray(image) != 255).any(axis=(1, 2)))
    save(image.crop((0, max(int(rows[0]) - 8, 0), WIDTH, min(int(rows[-1]) + 9, TALLEST))), file)


def shot(chromium: str, text: str, size: tuple[int, int]) -> Image.Image:
    """A page as a window of this size [px] shows it."""
    with tempfile.TemporaryDirectory() as scratch:
        page, image = Path(scratch) / "page.html", Path(scratch) / "image.png"
        page.write_text(text, encoding="utf-8")
        where = [f"--user-data-dir={scratch}/profile", f"--window-size={size[0]},{size[1]}", f"--screenshot={image}"]
        command = [chromium, *FLAGS.split(), *where, page.as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=300)
        return Image.open(image).convert("RGB")


def save(image: Image.Image, file: Path) -> None:
    image.quantize(COLOURS).save(file, optimize=True)
    print(f"{file.name}: {file.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
