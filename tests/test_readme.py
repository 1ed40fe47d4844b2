"""Every command of the README runs, the example's by `.ci/run`, and its picture is of the figures that it names."""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from icalib.geometry.targets import AprilGrid
from icalib.tools.simulation import film, handheld, write_film

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^( *)```(bash|python)\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
INSTALL = re.compile(r"\.venv/bin/pip install (?:-e )?\"?\.(?:\[([\w,]+)\])?\"?")
TESTED_BY_CI = ("<!-- calibrate-command -->", "<!-- test-command -->")  # .ci/run runs these two as they stand


def blocks(language: str) -> list[str]:
    """Code blocks of the README, without the two that `.ci/run` runs."""
    text = README
    for marker in TESTED_BY_CI:
        text = re.sub(f"{marker}.*?<!-- end -->", "", text, flags=re.DOTALL)
    return [
        re.sub(rf"^{indent}", "", code, flags=re.M) for indent, kind, code in BLOCK.findall(text) if kind == language
    ]


@pytest.fixture(scope="module")
def checkout(benchmark_program: Callable[[str], ModuleType], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the examples and commands of an installation, and 8 s of a camera and an IMU in `run.bag`."""
    folder = benchmark_program("tour_page").checkout(tmp_path_factory.mktemp("readme"))
    base = handheld(8.0)
    cam0 = replace(base.cameras[0], resolution=(376, 240), rate_hz=6.0)
    cam0 = replace(cam0, intrinsics=(229.3, 228.6, 183.4, 124.0), distortion=(0.0,) * 4)
    board = AprilGrid(6, 6, 0.022, 0.3)
    motion = replace(base.motion, distance_m=0.22, translation_scale=0.25)
    scenario = replace(base, cameras=(cam0,), target=board, motion=motion)
    write_film(film(scenario, 1), {"ros1": folder / "run.bag"})
    return folder


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the page is for a Unix shell")
def test_every_command_runs(checkout: Path, benchmark_program: Callable[[str], ModuleType]):
    tour_page, commands = benchmark_program("tour_page"), blocks("bash")
    assert len(commands) == 3
    for command in commands:
        runs = "".join(line for line in command.splitlines(keepends=True) if not INSTALL.match(line))
        run = tour_page.run(tour_page.Block(runs, 0, ""), checkout)
        assert run.returncode == 0, f"{runs}\n{run.stdout}"
    names = ("target.pdf", "rig.yaml", "result/calibration.yaml", "result/report.html", "result/camchain-imucam.yaml")
    assert all((checkout / name).is_file() for name in names)


@pytest.mark.slow
def test_the_python_code_runs(checkout: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(checkout)
    (code,) = blocks("python")
    exec(compile(code, "README.md", "exec"), {})  # what a reader would paste
    assert capsys.readouterr().out.startswith("[[")


def test_what_is_installed_can_be_installed_from_a_checkout():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    found = [match.group(1) for match in INSTALL.finditer(README)]
    assert len(found) == README.count("pip install") >= 3
    assert {name for names in found if names for name in names.split(",")} <= set(extras)


def test_the_picture_is_that_of_its_figures(benchmark_program: Callable[[str], ModuleType]):
    program = benchmark_program("readme_picture")
    assert program.PICTURE.read_text(encoding="utf-8") == program.picture()


def test_files_that_are_linked_exist():
    links = re.findall(r"\]\((?!https?:)([^)#]+)[^)]*\)", README)
    assert len(links) > 20
    assert not [link for link in links if not (ROOT / link).exists()]


def test_no_page_installs_icalib_from_an_index():
    pages = {page.name: page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md")}
    assert not [name for name, text in pages.items() if re.search(r"pip install [\"']?icalib|`icalib\[", text)]


def test_programs_that_pages_name_exist():
    text = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md"))
    code = "\n".join(re.findall(r"```.*?```|`[^`\n]+`|^    .*", text, re.DOTALL | re.MULTILINE))
    named = set(re.findall(r"(?:tests|benchmarks|estimation|detection|assessment|geometry)/[\w/]*\.py", code))
    assert len(named) > 50
    assert not [name for name in sorted(named) if not any((ROOT / at / name).exists() for at in ("", "src/icalib"))]
