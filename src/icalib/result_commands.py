"""Commands that look at results and sensors: `icalib allan`, and what others do with a calibration."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_result_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the parsers to those of the other commands."""
    _add_allan(commands)


def _add_allan(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    c = commands.add_parser("allan", help="noise densities and bias walks of an IMU, from a recording of it at rest")
    c.add_argument("recording", type=Path, help="folder of the recording, or bag: hours of an IMU that stands still")
    c.add_argument("--imu", metavar="TOPIC", help="topic or table of the IMU; by default the only one")
    c.add_argument("--output", "-o", type=Path, required=True, help="folder for plot, figures and rig file fields")
    c.add_argument("--quiet", "-q", action="store_true", help="no table")
    c.set_defaults(run=_allan)


def _allan(options: argparse.Namespace) -> None:
    from icalib.allan import study_recording, write_study
    from icalib.allan.files import check_folder
    from icalib.allan.words import print_study

    check_folder(options.output)
    study = study_recording(options.recording, options.imu)
    write_study(study, options.output)
    if not options.quiet:
        print_study(study)
        print(f"Wrote {options.output / 'allan.html'}, allan.json and noise.yaml.")
