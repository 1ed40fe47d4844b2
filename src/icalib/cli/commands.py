"""Commands of `icalib`: parse arguments, call a public function, turn errors into one line and an exit code."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import sys
import traceback
import warnings
from math import inf
from pathlib import Path

from icalib.cli.command_parser import (
    CommandParser,
    add_command,
    add_part,
    address,
    count,
    examples,
    file_path,
    nonnegative_int,
)
from icalib.cli.result_commands import add_result_commands, add_target_command
from icalib.errors import CalibrationError


def main(arguments: list[str] | None = None) -> int:
    """Entry point of the program `icalib`. arguments: default sys.argv. Returns the exit code.

    0: success, 1: error, 2: wrong usage, 130: interrupted. `compare`: 1: different, 2: error. `check`: 1: calibration
    changed, 2: error, 3: undecided. `calibrate --strict`: 3 to 5, by verdict.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # file names may contain bytes that cannot be encoded
            stream.reconfigure(errors="backslashreplace")
    parser = _parser()
    if "_ARGCOMPLETE" in os.environ:  # a shell asks what completes its line
        importlib.import_module("argcomplete").autocomplete(parser)
    options = parser.parse_args(arguments)
    if arguments is None and not sys.warnoptions:
        warnings.simplefilter("ignore")  # those of Python and numpy do not help a user
        os.environ["PYTHONWARNINGS"] = "ignore"  # nor do those of worker processes
    try:
        code = options.run(options)
    except CalibrationError as error:
        for note in () if getattr(options, "quiet", False) else getattr(error, "__notes__", ()):
            print(f"Note: {note}")
        print(f"icalib: {_one_line(str(error))}", file=sys.stderr)
        return getattr(options, "error_code", 1)
    except (OSError, MemoryError) as error:  # failures of the system, such as a full disk, without specific handling
        print(f"icalib: {_outside(error)}", file=sys.stderr)
        return getattr(options, "error_code", 1)
    except Exception as error:  # a bug: one line with its place, instead of a traceback
        print(f"icalib: {_fault(error)}", file=sys.stderr)
        return getattr(options, "error_code", 1)
    except KeyboardInterrupt as stop:
        print(f"icalib: interrupted; {str(stop) or 'nothing was written.'}", file=sys.stderr)
        return 130
    return code or 0


def _one_line(text: str) -> str:
    """`text` in one line, in which names from files may have put control characters."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _outside(error: OSError | MemoryError) -> str:
    if isinstance(error, MemoryError):
        return "the memory of this machine is not enough; use a part with --from and --to, or a larger machine."
    place = f"{error.filename} cannot be used: " if error.filename else ""
    return f"{place}{error.strerror or error}; check files, permissions and disks."


def _fault(error: Exception) -> str:
    frame = traceback.extract_tb(error.__traceback__)[-1]
    what = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return (
        f"failed in {Path(frame.filename).name}, line {frame.lineno} ({what}), which is a fault of icalib; please "
        "report it with the command."
    )


def _parser() -> argparse.ArgumentParser:
    from icalib import __version__

    parser = CommandParser(
        prog="icalib",
        description="Calibrates cameras, LiDARs, wheels, pose sensors and an IMU jointly, from recordings.",
        epilog=examples(
            "icalib inspect run.bag --target aprilgrid.yaml --rig rig.yaml",
            "icalib calibrate rig.yaml run.bag --output result",
            "icalib COMMAND --help",
        ),
    )
    parser.add_argument("--version", action="version", version=f"icalib {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_calibrate(commands)
    _add_inspect(commands)
    add_target_command(commands)
    _add_simulate(commands)
    _add_montecarlo(commands)
    _add_fleet(commands)
    add_result_commands(commands)
    return parser


def _add_calibrate(commands: argparse._SubParsersAction[CommandParser]) -> None:
    about = "calibrate the sensors of a rig from one recording or several"
    c = add_command(
        commands,
        "calibrate",
        about,
        "icalib calibrate rig.yaml run.bag --output result",
        "icalib calibrate rig.yaml monday.bag friday.bag -o result --from 5 --to 65 --strict",
    )
    c.add_argument("rig", type=file_path, help="rig file (rig.yaml)")
    several = "bag or folder of the recording; several of one rig are solved jointly"
    c.add_argument("recording", type=file_path, nargs="+", help=several)
    c.add_argument("--output", "-o", type=file_path, required=True, help="folder for the results; created if absent")
    add_part(c)
    c.add_argument(
        "--scheme",
        choices=("inertial", "pose", "kinematic"),
        help="interpolation of poses between keyframes; default: that of the rig file, or inertial",
    )
    c.add_argument(
        "--loss",
        choices=("none", "huber", "cauchy"),
        help="robust loss on corners; default: that of the rig file, or huber",
    )
    c.add_argument(
        "--segments",
        type=int,
        metavar="N",
        help="segments for the empirical factor, 0: none; default: those of the rig file, or 8",
    )
    strict = "exit code 3: usable with care, 4: partly usable, 5: not usable; default: 0 for every written result"
    c.add_argument("--strict", action="store_true", help=strict)
    c.add_argument("--no-images", action="store_true", help="leave recorded images out of the report")
    c.add_argument("--quiet", "-q", action="store_true", help="print no progress and no table; warnings go to stderr")
    c.add_argument("--verbose", "-v", action="store_true", help="print single numbers of lenses, IMU and board, too")
    c.set_defaults(run=_calibrate)


def _add_inspect(commands: argparse._SubParsersAction[CommandParser]) -> None:
    about = "show what is in a recording, whether it can be calibrated, and draft its rig file"
    c = add_command(
        commands,
        "inspect",
        about,
        "icalib inspect run.bag",
        "icalib inspect run.bag --target aprilgrid.yaml --rig rig.yaml",
        "icalib inspect run.mcap --target rig.yaml --follow --serve",
    )
    c.add_argument("recording", type=file_path, help="bag or folder of the recording")
    c.add_argument(
        "--rig", type=file_path, metavar="FILE", help="write a draft of the rig file; never overwrites a file"
    )
    target = "YAML of the target, or a rig file: search the images for this target; default: not searched"
    c.add_argument("--target", type=file_path, metavar="FILE", help=target)
    c.add_argument("--json", type=file_path, metavar="FILE", help="write the results of the inspection as JSON")
    c.add_argument("--html", type=file_path, metavar="FILE", help="write them as a page with plots and images")
    live = "follow the recording while it is written, until Ctrl-C; give --target for predictions"
    c.add_argument("--follow", action="store_true", help=live)
    page = "with --follow: show it on a local page, too; default: 127.0.0.1:8765"
    c.add_argument("--serve", type=address, nargs="?", const=("127.0.0.1", 8765), metavar="[HOST:]PORT", help=page)
    add_part(c)
    c.add_argument("--quiet", "-q", action="store_true", help="print no progress and no table")
    c.set_defaults(run=_inspect)


def _add_simulate(commands: argparse._SubParsersAction[CommandParser]) -> None:
    about = "simulate a recording with known truth"
    c = add_command(
        commands,
        "simulate",
        about,
        "icalib simulate scenario.yaml --output run",
        "icalib simulate scenario.yaml -o run.bag --level sensor --seed 7",
    )
    c.add_argument("scenario", type=file_path, help="scenario file (scenario.yaml)")
    c.add_argument("--output", "-o", type=file_path, required=True, help="path of the recording; must not exist yet")
    c.add_argument(
        "--seed", type=nonnegative_int, metavar="N", help="seed of motion and noise; default: that of the scenario"
    )
    levels = "data (default): tables; sensor: a bag of messages as drivers send them (.bag: ROS 1, else ROS 2)"
    c.add_argument("--level", choices=("data", "sensor"), default="data", help=levels)
    c.add_argument("--quiet", "-q", action="store_true", help="print no progress and no summary")
    c.set_defaults(run=_simulate)


def _add_montecarlo(commands: argparse._SubParsersAction[CommandParser]) -> None:
    about = "calibrate many simulated recordings, and compare their errors with the standard deviations"
    c = add_command(commands, "montecarlo", about, "icalib montecarlo scenario.yaml --runs 100 --output study")
    c.add_argument("scenario", type=file_path, help="scenario file (scenario.yaml)")
    runs = "number of runs in total, including those that the folder already has"
    c.add_argument("--runs", type=count, required=True, metavar="N", help=runs)
    folder = "folder for runs and results; the same command resumes an interrupted study"
    c.add_argument("--output", "-o", type=file_path, required=True, help=folder)
    c.add_argument(
        "--seed", type=nonnegative_int, metavar="N", help="seed of the first run; default: that of the scenario"
    )
    guess = "initial guess: none (default), or drawn about the truth"
    c.add_argument("--guess", choices=("none", "drawn"), default="none", help=guess)
    planes = "planes of the LiDARs: known (default) from the simulation, or found in the clouds"
    c.add_argument("--planes", choices=("known", "found"), default="known", help=planes)
    _add_workers(c)
    c.set_defaults(run=_montecarlo)
    about = "reproduce the simulation of the paper: errors over iterations, and a table"
    r = add_command(commands, "reproduce", about, "icalib reproduce --output paper")
    runs = "number of runs of each motion, of which figures show the first six; default: 6"
    r.add_argument("--runs", type=count, default=6, metavar="N", help=runs)
    r.add_argument("--output", "-o", type=file_path, required=True, help="folder for runs, figures and table")
    _add_workers(r)
    r.set_defaults(run=_reproduce)


def _add_fleet(commands: argparse._SubParsersAction[CommandParser]) -> None:
    about = "calibrate many recordings of many robots, and show what changed over time"
    c = add_command(
        commands,
        "fleet",
        about,
        "icalib fleet jobs.yaml --output fleet",
        "icalib fleet jobs.yaml -o fleet --workers 4 --sigma 4",
    )
    c.add_argument("jobs", type=file_path, help="YAML file of jobs")
    folder = "folder for the results; finished jobs run again only if their inputs changed"
    c.add_argument("--output", "-o", type=file_path, required=True, help=folder)
    sigma = "report changes beyond N sigma; default: 3"
    c.add_argument("--sigma", type=float, default=3.0, metavar="N", help=sigma)
    _add_workers(c)
    c.set_defaults(run=_fleet)


def _add_workers(parser: argparse.ArgumentParser) -> None:
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--workers", type=count, metavar="N", help="processes on this machine; default: one per core")
    who.add_argument("--scheduler", metavar="ADDRESS", help="scheduler of a Dask cluster; default: this machine")
    parser.add_argument("--quiet", "-q", action="store_true", help="print no progress and no table")


def _calibrate(options: argparse.Namespace) -> int:
    import dataclasses

    from icalib.cli.console import console_progress, print_result, print_warnings
    from icalib.export.formats import check_folder, write_outputs
    from icalib.pipeline import calibrate
    from icalib.result.verdict import EXIT_CODES
    from icalib.rig.file import load_rig

    rig = load_rig(options.rig)
    chosen = {k: getattr(options, k) for k in ("scheme", "loss", "segments") if getattr(options, k) is not None}
    if chosen.get("segments", 0) < 0 or chosen.get("segments") == 1:
        raise CalibrationError("--segments must be 0 (none) or at least 2 segments.")
    if options.no_images:
        chosen["images_in_report"] = False
    rig = dataclasses.replace(rig, settings=dataclasses.replace(rig.settings, **chosen))
    check_folder(options.output, [options.rig, *options.recording])
    with console_progress(options.quiet) as progress:
        result = calibrate(rig, options.recording, progress, start_s=options.start_s, end_s=options.end_s)
        progress("writing", 0.97)
        write_outputs(result, options.output)
    if options.quiet:
        print_warnings(result)
    else:
        print_result(result, options.output, options.verbose)
    return EXIT_CODES[result.verdict] if options.strict else 0


def _simulate(options: argparse.Namespace) -> None:
    from icalib.cli.console import console_progress
    from icalib.tools.simulation import load_scenario, simulate, write_sensors, write_tables
    from icalib.tools.simulation.stops import load_stops, write_stops
    from icalib.tools.simulation.writing import check_absent

    if (stops := load_stops(options.scenario)) is not None:
        seed = stops.seed if options.seed is None else options.seed
        write_stops(stops, seed, options.output, as_bag=options.level == "sensor")
        return
    scenario = load_scenario(options.scenario)
    seed = scenario.seed if options.seed is None else options.seed
    check_absent(options.output)
    with console_progress(options.quiet) as progress:
        simulation = simulate(scenario, seed, lambda stage, done: progress(stage, 0.6 * done))
        write = write_tables if options.level == "data" else write_sensors
        notes = write(simulation, seed, options.output, lambda done: progress("writing", 0.6 + 0.4 * done))
    if not options.quiet:
        for sentence in notes:
            print(f"Note: {sentence}")
        print(f"Wrote {options.output}, seed {seed}.")


def _montecarlo(options: argparse.Namespace) -> None:
    from icalib.cli.console import console_progress
    from icalib.tools.montecarlo import StudyPlan, run_file
    from icalib.tools.montecarlo.study import print_study

    plan = StudyPlan(options.runs, options.seed, options.guess, options.planes, options.workers, options.scheduler)
    with console_progress(options.quiet) as progress:
        study = run_file(options.scenario, options.output, plan, progress)
    if not options.quiet:
        print_study(study, options.output)


def _reproduce(options: argparse.Namespace) -> None:
    from icalib.cli.console import console_progress
    from icalib.tools.montecarlo import StudyPlan
    from icalib.tools.montecarlo.reproduce import reproduce
    from icalib.tools.montecarlo.study import print_study

    plan = StudyPlan(options.runs, guess="drawn", workers=options.workers, scheduler=options.scheduler)
    with console_progress(options.quiet) as progress:
        studies = reproduce(options.output, plan, progress)
    if not options.quiet:
        for motion, study in studies.items():
            print_study(study, options.output / motion)
        print(f"Wrote {options.output / 'reproduce.html'}, and a PNG of each motion.")


def _fleet(options: argparse.Namespace) -> int:
    from icalib.cli.console import console_progress
    from icalib.tools.fleet import Crew, run_fleet
    from icalib.tools.fleet.run import print_fleet

    crew = Crew(options.workers, options.scheduler)
    say = (lambda sentence: None) if options.quiet else print
    with console_progress(options.quiet) as progress:
        fleet = run_fleet(options.jobs, options.output, crew, options.sigma, progress, say)
    if not options.quiet:
        print_fleet(fleet, options.output)
    return 1 if fleet.failed else 0


def _inspect(options: argparse.Namespace) -> None:
    if options.follow or options.serve:
        return _follow(options)
    from icalib.base.files import printable, refuse_existing, refuse_unwritable, write_new, write_sealed
    from icalib.cli.console import console_progress
    from icalib.tools.inspection import draft_rig, inspect_recording, read_target
    from icalib.tools.inspection.console import figures_json, inspection_html, print_inspection

    if options.rig:
        advice = "give another name for the draft, or give it as --target to use the target in it"
        refuse_existing(options.rig, advice)
    refuse_unwritable((options.json, options.html), (options.recording, options.target))
    target = read_target(options.target) if options.target else None
    with console_progress(options.quiet) as progress:
        inspection = inspect_recording(
            options.recording, target, progress, start_s=options.start_s, end_s=options.end_s
        )
    if not options.quiet:
        print_inspection(inspection)
    if options.json:
        write_sealed(options.json, figures_json(inspection))
    if options.html:
        write_sealed(options.html, printable(inspection_html(inspection)))
    if options.rig:
        write_new(options.rig, draft_rig(inspection))
        if not options.quiet:
            print(f"Wrote {options.rig}, a draft: check it, and fill in what is missing.")


def _follow(options: argparse.Namespace) -> None:
    if not options.follow:
        raise CalibrationError("--serve shows a recording that is being written; give --follow as well.")
    if options.rig or options.json or options.html or (options.start_s, options.end_s) != (0.0, inf):
        raise CalibrationError(
            "--follow takes --target, --serve, --quiet only; inspect the recording once it is complete."
        )
    if options.quiet and not options.serve:
        raise CalibrationError("--follow with --quiet shows nothing; leave --quiet out, or give --serve, too.")
    from icalib.tools.inspection import read_target
    from icalib.tools.inspection.follow import follow

    given = read_target(options.target) if options.target else None
    follow(options.recording, given, options.serve, options.quiet)
