"""Which file of the fuzzer's good workspace is changed, and which command runs on it then."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from fuzz_inputs import QUIET
from fuzz_mutators import mutated

_OUT = ("-o", "made")
_EXPORTS = ("kalibr", "openvins", "vins-fusion", "ros2-static", "camera-info", "urdf", "mins", "json")
_INSPECT = ("--json", "made.json", "-q")

Command = tuple[str, ...]


@dataclass(frozen=True)
class _Kind:
    """Files of a kind (patterns below the workspace), of which a case changes one, how often, and the commands that may
    run then. All commands succeed before anything is changed."""

    name: str
    files: tuple[str, ...]
    weight: float
    commands: tuple[Command, ...]


def _calibrate(rig: str, recording: str) -> Command:
    return ("calibrate", rig, recording, *_OUT, *QUIET)


def _of_rig(weight: float, rig: str, recording: str, *tables: str) -> tuple[_Kind, _Kind]:
    """The kinds of a rig file, and of tables of the recording that it calibrates."""
    plain = _calibrate(rig, recording)
    return (
        _Kind("rig", (rig,), weight, (plain, plain, ("inspect", recording, "--target", rig, "-q"))),
        _Kind("table", tables, 1.4 * weight, (plain, plain, ("inspect", recording, *_INSPECT))),
    )


def _of_result(weight: float, out: str, rig: str, recording: str, *exports: str) -> _Kind:
    commands = (
        ("compare", out, f"good-{out}", "--json", "made.json", "-q"),
        ("view", out, "--save", "made.rrd", "-q"),
        ("view", out, recording, "--save", "made.rrd", "-q"),
        ("calibrate", rig, recording, "-o", out, *QUIET),
        *(("export", out, "--to", to, *_OUT, "-q") for to in exports),
    )
    return _Kind("result", (f"{out}/*",), weight, commands)


_DRAFT = ("inspect", "{top}", "--rig", "made.yaml", *_INSPECT)
_LOOK = ("inspect", "{top}", *_INSPECT)
_ALLAN = ("allan", "{top}", *_OUT, "-q")
_KINDS: tuple[_Kind, ...] = (
    *_of_rig(0.8, "pose.yaml", "rec", "rec/imu0/*", "rec/pose0/*"),
    *_of_rig(0.8, "lidar.yaml", "rec", "rec/imu0/*", "rec/lidar0/*", "rec/wheel0/*"),
    *_of_rig(0.4, "mocap.yaml", "rec", "rec/pose0/*", "rec/wheel0/*"),
    *_of_rig(0.8, "cam.yaml", "board", "board/imu0/*", "board/cam0/*"),
    *_of_rig(0.4, "hand.yaml", "stops", "stops/cam0/*", "stops/pose0/*"),
    _Kind("rig", ("pose.yaml", "lidar.yaml", "cam.yaml"), 0.8, (("compare", "{file}", "{file}", "-q"),)),
    _Kind("table", ("still/imu0/*",), 1.0, (_ALLAN, _LOOK)),
    _Kind("bag", ("run.bag", "run/*.mcap", "run/metadata.yaml"), 2.0, (_DRAFT, _calibrate("pose.yaml", "{top}"))),
    _Kind("bag", ("quiet.bag", "quiet/*", "db/*"), 1.0, (_ALLAN, _LOOK)),
    _Kind("picture", ("pictures/*",), 1.0, (("inspect", "pictures", "--target", "cam.yaml", *_INSPECT),)),
    _Kind(
        "scenario",
        ("scenario.yaml",),
        2.0,
        (
            ("simulate", "{file}", *_OUT, "-q"),
            ("simulate", "{file}", "-o", "made.bag", "--level", "sensor", "-q"),
        ),
    ),
    _of_result(1.3, "out", "pose.yaml", "rec", "urdf", "ros2-static", "mins", "json"),
    _of_result(1.3, "cam-out", "cam.yaml", "board", *_EXPORTS),
    _of_result(1.3, "lidar-out", "lidar.yaml", "rec", "fast-lio", "ros2-static", "json"),
    _Kind("jobs", ("jobs.yaml",), 0.2, (("fleet", "{file}", *_OUT, "--workers", "1", "-q"),)),
    _Kind("study", ("scenario.yaml",), 0.1, (("montecarlo", "{file}", "--runs", "1", *_OUT, "--workers", "1", "-q"),)),
    _Kind(
        "others",
        ("kalibr/camchain-imucam.yaml", "kalibr/imu.yaml"),
        1.0,
        (("compare", "{file}", "good-cam-out", "-q"),),
    ),
    _Kind("others", ("kalibr/april.yaml",), 0.3, (("inspect", "rec", "--target", "{file}", "-q"),)),
    _Kind("others", ("kalibr/*",), 0.5, (("inspect", "kalibr", "--rig", "made.yaml", *_INSPECT),)),
    _Kind(
        "others",
        ("robot.urdf",),
        0.7,
        (
            ("compare", "{file}", "good-out", "-q"),
            ("export", "good-out", "--to", "urdf", "--urdf", "{file}", "-o", "made.urdf", "-q"),
        ),
    ),
)


@dataclass(frozen=True)
class Case:
    """One change and one command. file: what is changed, below the workspace; empty: nothing is changed."""

    seed: int
    number: int
    kind: str
    file: str
    command: Command

    def rng(self) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.number, 1])

    def unchanged(self) -> Case:
        return replace(self, number=-1, file="")

    def described(self) -> str:
        return f"{self.kind} {self.file}: icalib {' '.join(self.command)}"


def case_of(seed: int, number: int, good: Path) -> Case:
    """The case of this number."""
    rng = np.random.default_rng([seed, number, 0])
    weights = np.array([kind.weight for kind in _KINDS])
    kind = _KINDS[int(rng.choice(len(_KINDS), p=weights / weights.sum()))]
    files = _files(kind, good)
    file = files[int(rng.integers(len(files)))]
    command = kind.commands[int(rng.integers(len(kind.commands)))]
    return Case(seed, number, kind.name, file, _filled(command, file))


def unchanged_cases(good: Path) -> list[Case]:
    """Every command on every good input once, without a change."""
    found: dict[Command, Case] = {}
    for kind in _KINDS:
        for command in kind.commands:
            for file in _files(kind, good):
                case = Case(0, 0, kind.name, file, _filled(command, file))
                found.setdefault(case.command, case.unchanged())
    return list(found.values())


def covering(seed: int, count: int, good: Path) -> list[Case]:
    """Of the first `count` cases without workers few that have every kind of change and of input: again and again the
    one that adds most (greedy set cover)."""
    kinds: dict[int, set[str]] = {}
    for number in range(count):
        case = case_of(seed, number, good)
        if "--workers" not in case.command:
            how, _ = mutated(good / case.file, case.rng())
            kinds[number] = {case.kind, case.command[0], *(step.kind for step in how)}
    missing, chosen = set[str]().union(*kinds.values()), list[Case]()
    while missing:
        best = max(kinds, key=lambda number: len(kinds[number] & missing))
        missing -= kinds[best]
        chosen.append(case_of(seed, best, good))
    return chosen


def _files(kind: _Kind, good: Path) -> list[str]:
    files = sorted(p for pattern in kind.files for p in good.glob(pattern) if p.is_file())
    return [str(p.relative_to(good)) for p in files]


def _filled(command: Command, file: str) -> Command:
    return tuple(word.format(file=file, top=file.split("/")[0]) for word in command)
