"""One case of the fuzzer in a forked process, and what was wrong with how it ended."""

from __future__ import annotations

import contextlib
import faulthandler
import hashlib
import json
import os
import re
import resource
import select
import shutil
import signal
import sys
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path

from fuzz_cases import Case
from fuzz_mutators import mutate

from icalib.cli import main

MOST_BYTES = 2_000_000_000
_ADDRESS_SPACE = 12 << 30  # what asks for more has lost its measure
_NOT_FINITE = re.compile(r"(?<![A-Za-z0-9_.])(\.nan|-?\.inf|nan)(?![A-Za-z0-9_])")
_MADE = ("made", "made.json", "made.yaml", "made.bag", "made.rrd", "made.urdf")


@dataclass(frozen=True)
class Found:
    """code: of the exit, -1 where there was none. faults: what must not be, in words."""

    code: int
    said: str
    how: str
    faults: tuple[str, ...]

    def described(self) -> str:
        return f"{self.how}\n    {' | '.join(self.faults)}\n    code {self.code}: {self.said.strip()[-1500:]}"


def warm(good: Path, place: Path) -> None:
    """Imports and compiles in this process what the forked ones would have to, each time."""
    import cv2

    cv2.setNumThreads(0)
    for k, command in enumerate(
        (
            ("inspect", "rec", "-q"), ("inspect", "run.bag", "-q"), ("allan", "still", "-o", "made", "-q"),
            ("calibrate", "pose.yaml", "rec", "-o", "made2", "--splits", "0", "-q"),
            ("calibrate", "cam.yaml", "rec", "-o", "made3", "--splits", "0", "-q"),
            ("calibrate", "lidar.yaml", "rec", "-o", "made4", "--splits", "0", "-q"),
            ("compare", "out", "good-out", "-q"),
        )
    ):  # fmt: skip
        shutil.copytree(good, place / str(k))
        before = Path.cwd()
        os.chdir(place / str(k))
        with contextlib.redirect_stderr(sys.stdout):
            code = main(list(command))
        os.chdir(before)
        print(f"good input: icalib {' '.join(command)}: {code}", flush=True)


def run_case(case: Case, good: Path, place: Path, seconds: float) -> Found:
    """Changes a copy of the workspace, runs the command in it, and looks at what is there then."""
    work = place / "a" / "b" / "work"
    shutil.copytree(good, work)
    try:
        how = mutate(work / case.file, case.rng())
        before = _contents(place)
        code, said, peak = _forked(work, list(case.command), seconds)
        faults = [*_faults_of_end(code, said, peak), *_faults_of_files(before, _contents(place))]
        result = work / "made" / "calibration.yaml"
        if result.is_file() and _NOT_FINITE.search(result.read_text(encoding="utf-8")):
            faults.append("NO NUMBER IN A RESULT")
        return Found(code, said, how, tuple(faults))
    finally:
        shutil.rmtree(place)


def _forked(work: Path, command: list[str], seconds: float) -> tuple[int, str, int]:
    """Exit code (-1: none), what was said on stderr, and the most memory."""
    readable, writable = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(readable)
        _child(work, command, writable, seconds)
    os.close(writable)
    ends, text = time.monotonic() + seconds, b""
    while (left := ends - time.monotonic()) > 0 and select.select([readable], [], [], left)[0]:
        block = os.read(readable, 1 << 16)
        if not block:
            break
        text += block
    hung = time.monotonic() >= ends
    os.close(readable)
    if hung:
        os.kill(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    code, said = -1, f"no answer within {seconds:g} s" if hung else f"died: status {status}"
    if hung:
        said += "\n" + (work.parent.parent.parent / "said").read_text(errors="replace")
    if text.endswith(b"\n"):
        found = json.loads(text)
        code, said = found["code"], found["said"]
    return code, said, usage.ru_maxrss * 1024


def _child(work: Path, command: list[str], writable: int, seconds: float) -> None:
    """Never returns."""
    os.chdir(work)
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    code = -1
    with open(os.devnull, "w") as nowhere, open(work.parent.parent.parent / "said", "w+") as said:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(said.fileno(), 2)
        sys.stdout, sys.stderr = nowhere, said
        faulthandler.dump_traceback_later(0.9 * seconds, file=said)  # says where a command hangs
        warnings.simplefilter("ignore", RuntimeWarning)  # as at a terminal
        try:
            code = main(command)
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else -1
        except BaseException:
            traceback.print_exc()
        faulthandler.cancel_dump_traceback_later()
        said.flush()
        said.seek(0)
        answer = json.dumps({"code": code, "said": said.read()[-20000:]}) + "\n"
    with open(writable, "w") as pipe:
        pipe.write(answer)
    os._exit(0)


def _faults_of_end(code: int, said: str, peak: int) -> list[str]:
    faults = ["FAULT OF ICALIB"] if "is a fault of icalib" in said else []
    if code not in (0, 1, 2):
        faults.append("TRACEBACK" if "Traceback" in said else "NO END")
    elif "Traceback" in said or "Warning:" in said:
        faults.append("NOISE")
    elif code and not re.fullmatch(r"icalib: [^\n]*\n|usage: (.|\n)*", said) and (said or code != 1):
        faults.append("NOT ONE SENTENCE")  # compare, and fleets with a failed job, say it on standard output
    if re.search(r"(?<![.'])\bnan\b(?!')", said):
        faults.append("NAN SAID")
    if peak > MOST_BYTES:
        faults.append(f"{peak / 1e9:.1f} GB")
    return faults


def _contents(place: Path) -> dict[str, str]:
    """Every file below `place` with its hash."""
    found = {}
    for path in sorted(place.rglob("*")):
        if path.is_file() and path != place / "said":
            found[str(path.relative_to(place))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _faults_of_files(before: dict[str, str], after: dict[str, str]) -> list[str]:
    faults = [f"CHANGED {name}" for name in before if after.get(name) != before[name] and "/out/" not in name]
    for name in after.keys() - before.keys():
        top = name.removeprefix("a/b/work/").split("/")[0]
        if not name.startswith("a/b/work/") or (top not in (*_MADE, "out") and not top.startswith(".lock")):
            faults.append(f"WROTE {name}")
    return sorted(faults)
