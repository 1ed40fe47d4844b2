"""One case of the fuzzer in a forked process, and what was wrong with how it ended."""

from __future__ import annotations

import faulthandler
import json
import math
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

import yaml
from fuzz_cases import Case
from fuzz_inputs import QUIET, RESULTS, inside, succeed
from fuzz_mutators import mutate

from icalib.cli import main

MOST_BYTES = 2_000_000_000
_WAITS = 10.0  # times the limit of CPU time may pass on the clock: other processes run, too
_ADDRESS_SPACE = 12 << 30  # what asks for more has lost its measure
_QUOTED = re.compile(r"(?<!\w)'([^'\n]*)'")
_PLACE = re.compile(r"^icalib: \S+:\d+: [\w.\[\]-]+: ")  # file, line and field
_NO_NUMBER = re.compile(r"(?<!\w)[-+.]?(nan|inf)(?!\w)", re.IGNORECASE)
_MADE = ("made", "made.json", "made.yaml", "made.bag", "made.rig.yaml", "made.rrd", "made.urdf")


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
    """Imports and compiles in this process what the forked ones would have to, each time; fails where good input is
    refused."""
    import cv2

    cv2.setNumThreads(0)
    for command in (
        ("inspect", "rec", "-q"),
        ("inspect", "run.bag", "-q"),
        ("allan", "still", "-o", "made", "-q"),
        ("calibrate", "mocap.yaml", "rec", "-o", "made2", *QUIET),
        ("calibrate", "hand.yaml", "stops", "-o", "made3", *QUIET),
        ("compare", "out", "good-out", "-q"),
    ):
        shutil.copytree(good, place)
        with inside(place):
            succeed(*command)
        shutil.rmtree(place)


def run_case(case: Case, good: Path, place: Path, seconds: float) -> Found:
    """Changes a copy of the workspace, runs the command in it, and looks at what is there then."""
    work = place / "a" / "b" / "work"
    shutil.copytree(good, work)
    try:
        how = mutate(work / case.file, case.rng()) if case.file else "unchanged"
        content = (work / case.file).read_bytes() if case.file and (work / case.file).is_file() else b""
        before = _contents(place)
        code, said, peak = _forked(work, list(case.command), seconds)
        faults = [*_faults_of_end(code, said, peak), *_faults_of_files(before, _contents(place))]
        if says_no_number(said, content):
            faults.append("NAN SAID")
        folder = case.command[case.command.index("-o") + 1] if code == 0 and "-o" in case.command else "made"
        faults += [f"NO NUMBER IN {p.name}" for p in _texts(work, folder) if holds_no_number(p)]
        return Found(code, said, how, tuple(faults))
    finally:
        shutil.rmtree(place)


def refused_inputs(unchanged: list[Case], good: Path, place: Path, seconds: float) -> list[Case]:
    """The cases that do not succeed although nothing is changed, which are told."""
    bad: list[Case] = []
    for case in unchanged:
        found = run_case(case, good, place, seconds)
        if found.faults or found.code:
            print(f"good input: {case.described()}\n    {found.described()}", flush=True)
            bad.append(case)
    return bad


def says_no_number(said: str, content: bytes) -> bool:
    """Whether a sentence says nan or inf other than as a field's name or by quoting the changed file, its blanks made
    one."""
    there = " ".join(content.decode(errors="backslashreplace").split())

    def rest(match: re.Match[str]) -> str:
        return "" if match[1].removesuffix("...").strip() in there else match[0]

    return _NO_NUMBER.search(_QUOTED.sub(rest, _PLACE.sub("", said))) is not None


def holds_no_number(path: Path) -> bool:
    """Whether a YAML or JSON file, or a URDF, holds numbers that are not finite. Text may quote them."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".urdf":
        return re.search(r'(xyz|rpy)="[^"]*(nan|inf)', text) is not None
    if not _NO_NUMBER.search(text) and "Infinity" not in text:
        return False
    waiting = [json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)]
    while waiting:
        value = waiting.pop()
        if isinstance(value, float) and not math.isfinite(value):
            return True
        waiting += value.values() if isinstance(value, dict) else value if isinstance(value, list) else []
    return False


def _texts(work: Path, folder: str) -> list[Path]:
    """What a command wrote that is YAML, JSON or URDF."""
    found = [
        p for top in {folder, "made.json", "made.yaml", "made.urdf"} for p in (work / top, *(work / top).rglob("*"))
    ]
    return sorted(p for p in found if p.suffix in (".yaml", ".json", ".urdf") and p.is_file())


def _forked(work: Path, command: list[str], seconds: float) -> tuple[int, str, int]:
    """Exit code (-1: none), what was said on stderr, and the most memory."""
    readable, writable = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(readable)
        _child(work, command, writable, seconds)
    os.close(writable)
    ends, text = time.monotonic() + _WAITS * seconds, b""
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
    spent = usage.ru_utime + usage.ru_stime
    code, said = -1, f"no answer within {spent:.0f} s of CPU time" if hung or spent > seconds else f"died: {status}"
    if not text.endswith(b"\n"):
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
        faulthandler.register(signal.SIGXCPU, file=said, chain=False)  # says where a command hangs
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds) + 2))
        warnings.simplefilter("ignore", RuntimeWarning)  # as at a terminal
        try:
            code = main(command)
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else -1
        except BaseException:
            traceback.print_exc()
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
    if peak > MOST_BYTES:
        faults.append(f"{peak / 1e9:.1f} GB")
    return faults


def _contents(place: Path) -> dict[str, tuple[int, int, int]]:
    """Every file below `place`, and what changes when it is written: inode, size and time."""
    found = {}
    for path in sorted(place.rglob("*")):
        if path.is_file() and path != place / "said":
            stat = path.stat()
            found[str(path.relative_to(place))] = (stat.st_ino, stat.st_size, stat.st_mtime_ns)
    return found


def _faults_of_files(before: dict[str, tuple[int, int, int]], after: dict[str, tuple[int, int, int]]) -> list[str]:
    own = tuple(f"a/b/work/{out}/" for out in RESULTS)
    faults = [f"CHANGED {name}" for name in before if after.get(name) != before[name] and not name.startswith(own)]
    for name in after.keys() - before.keys():
        top = name.removeprefix("a/b/work/").split("/")[0]
        if not name.startswith("a/b/work/") or (top not in (*_MADE, *RESULTS) and not top.startswith(".lock")):
            faults.append(f"WROTE {name}")
    return sorted(faults)
