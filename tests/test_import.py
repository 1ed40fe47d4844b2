"""`import icalib` is silent, loads nothing heavy and writes no file."""

from __future__ import annotations

import subprocess
import sys

import pytest
from tests.cases import each

import icalib

_WATCHED_IMPORT = """
import os, sys
written = []

def watch(event, args):
    if event == "open" and args[2] & (os.O_WRONLY | os.O_RDWR):
        written.append(args[0])
    if event in ("os.mkdir", "os.rename", "os.remove"):
        written.append(args[0])

sys.addaudithook(watch)
import icalib
heavy = {"numpy", "numba", "yaml", "rich", "plotly"} & set(sys.modules)
assert not written, f"import icalib wrote {written}"
assert not heavy, f"import icalib loaded {heavy}"
"""


def test_import_is_silent_light_and_writes_nothing():
    # -B: compiled bytecode is Python's own doing, and would be counted as written.
    run = subprocess.run([sys.executable, "-B", "-c", _WATCHED_IMPORT], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def test_the_pipeline_does_without_what_takes_long_to_load():
    code = "import sys, icalib.pipeline; print({'scipy.stats', 'matplotlib', 'plotly', 'cv2'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "set()"


@each("name", icalib.__all__)
def test_every_public_name_is_there(name: str):
    assert getattr(icalib, name) is not None
    assert name in dir(icalib)


def test_unknown_name_lists_what_there_is():
    with pytest.raises(AttributeError, match="no attribute 'calibrat'; it has .*calibrate"):
        icalib.calibrat  # noqa: B018
