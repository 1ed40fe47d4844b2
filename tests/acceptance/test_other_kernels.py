"""Two machines print one number and one verdict: a result does not depend on the kernels of BLAS."""

from __future__ import annotations

import gzip
import json
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
JUMP_NS, FROM_NS = 30_000_000, 1404733440782799872  # 18 s after the first image
CALIBRATE = """
import json, sys
from icalib.pipeline import calibrate
from threadpoolctl import threadpool_info

c = calibrate(*sys.argv[1:])
kernels = sorted({x.get("architecture", "") for x in threadpool_info() if x["internal_api"] == "openblas"})
groups = [[f"{g.sensor}.{g.name}", g.value.ravel().tolist(), g.std.tolist(), list(g.verdict)] for g in c.groups]
print(json.dumps([kernels, groups, [[f.chi2, f.rms or 0.0] for f in c.fits], c.verdict, c.reasons[0]]))
"""


@pytest.fixture
def jumped(tmp_path: Path) -> Path:
    """The example, in which the clock of the second camera jumps: no result, but everybody's is the same."""
    folder = tmp_path / "recording"
    shutil.copytree(ROOT / "examples" / "euroc" / "recording", folder)
    packed = folder / "cam1" / "corners.csv.gz"
    header, *rows = gzip.decompress(packed.read_bytes()).decode().splitlines()
    split = [row.split(",", 1) for row in rows]
    late = [f"{int(stamp) + JUMP_NS * (int(stamp) > FROM_NS)},{rest}" for stamp, rest in split]
    packed.with_suffix("").write_text("\n".join([header, *late]) + "\n", encoding="utf-8")
    packed.unlink()
    return folder


def calibrated(recording: Path, *kernels: str) -> list[list[Any]]:
    """What CALIBRATE prints with each of these kernels of OpenBLAS, all at once."""
    command = [sys.executable, "-c", CALIBRATE, str(ROOT / "examples" / "euroc" / "rig.yaml"), str(recording)]
    running = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"OPENBLAS_CORETYPE": name})
        for name in kernels
    ]
    return [json.loads(process.communicate()[0]) for process in running]


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="kernels of x86-64")
def test_other_kernels_give_the_same_result(jumped: Path):
    found, other = calibrated(jumped, "Haswell", "Nehalem")
    (kernels, groups, fits, *words), (others, other_groups, other_fits, *other_words) = found, other
    assert kernels != others
    np.testing.assert_allclose(other_fits, fits, rtol=1e-4)
    for (name, value, std, verdict), (other_name, other_value, other_std, other_verdict) in zip(
        groups, other_groups, strict=True
    ):
        assert (other_name, other_verdict) == (name, verdict)
        np.testing.assert_allclose(other_std, std, rtol=0.01, err_msg=name)
        np.testing.assert_allclose(other_value, value, atol=0.01 * max([*std, 1e-12]), err_msg=name)
    assert other_words == words
