"""A mount, a lens or a clock changes at an instant: it is named, with its size, and no other sensor."""

from __future__ import annotations

import re
from dataclasses import replace

from tests.cases import each


@each(
    ("rig", "effect", "size", "expected"),
    [
        ("tracks + IMU", "cam0 bumped", 0.006, r"cam0 .*: it moves on its mount by 0\.3\d deg"),
        ("tracks + IMU", "focal length changes", 0.01, r"cam0 .*: its lens by up to (4|5)\S* px"),
        ("tracks + IMU", "clock of cam0 jumps", 0.005, r"offset of cam0 changes by about -(4|5)\S* ms"),
        ("LiDAR + poses + IMU", "lidar0 bumped", 0.005, r"lidar0 .*: it moves on its mount by 0\.(2|3)\d deg"),
        ("LiDAR + poses + IMU", "mocap0 bumped", 0.005, r"mocap0 .*: it moves on its mount by 0\.(2|3)\d deg"),
        ("positions + IMU", "prism0 bumped", 0.3, r"prism0 .*: it moves on its mount by (2|3)\d mm, or its positions"),
    ],
)
def test_what_changes_is_named(benchmark_program, rig: str, effect: str, size: float, expected: str) -> None:
    """The instant is inside of a segment of the recording, and in the middle of tracks."""
    program = benchmark_program("effects")
    kind = replace(program.KINDS[rig], instant_s=5.37)
    base = kind.scenario()
    changed = next(e for e in program.outside(base, kind) if e.name == effect)
    named = program.cell(kind, base, changed, size, 2).named
    assert re.search(rf"^\w+: .*{expected}", named) and re.search(r"near 5\.\d+ s", named), named
