"""Measures icalib: `python benchmarks/run.py --json FILE [--only GROUP ...] [--data DIR]`.

Each group runs in a process of its own, one after the other, so that its peak memory is its own. Needs the recording
`euroc_imu_april` in DIR, $ICALIB_DATA or ../shared/data, and Linux or macOS (for the peak memory).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RECORDING = "euroc_imu_april"
GROUPS = ("plain", "honest", "from-nothing", "sums", "command", "duration", "gtsam")
# Most that a figure may be.
TARGETS = {
    "plain.all": 1.0,
    "plain.peak_memory": 400.0,
    "honest.all": 3.0,
    "from-nothing.all": 3.0,
    "command.cold": 45.0,
    "command.warm": 5.0,
}


def main() -> int:
    options = _options()
    recording = options.data / RECORDING
    if not recording.is_dir():
        print(
            f"run.py: there is no recording {recording}; give its parent folder with --data or ICALIB_DATA.",
            file=sys.stderr,
        )
        return 1
    if options.child:
        from figures import measure

        print(json.dumps([f.as_dict() for f in measure(options.child, recording)]))
        return 0
    figures = [
        {"name": "machine.cores", "value": os.cpu_count() or 0, "unit": "1"},
        {"name": "machine.load_before", "value": os.getloadavg()[0], "unit": "1"},  # of others: it slows all wall times
    ]
    _print(figures)
    for group in options.only or GROUPS:
        found = _in_subprocess(group, options.data)
        _print(found)
        figures += found
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    return 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure as {name, value, unit}")
    parser.add_argument("--only", nargs="+", choices=GROUPS, metavar="GROUP", help=f"some of: {', '.join(GROUPS)}")
    data = Path(os.environ.get("ICALIB_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, metavar="DIR", help="folder of the recordings")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    return parser.parse_args()


def _in_subprocess(group: str, data: Path) -> list[dict]:
    if group == "duration":
        repetitions = ("1", "4", "8", "17")  # 72 s each: 1.2, 5, 10 and 20 minutes
        return [f for n in repetitions for f in _in_subprocess(f"duration:{n}", data)]
    command = [sys.executable, __file__, "--child", group, "--data", str(data)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def _print(figures: list[dict]) -> None:
    for f in figures:
        target = TARGETS.get(f["name"])
        note = "" if target is None else f"target {target:g}{'' if f['value'] <= target else '  MISSED'}"
        print(f"{f['name']:<44} {f['value']:>12.4g} {f['unit']:<12} {note}".rstrip(), flush=True)


if __name__ == "__main__":
    sys.exit(main())
