"""Help has examples that parse; wrong names are answered with the nearest right ones; logs get lines of progress."""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.cases import each

from icalib.cli import main
from icalib.cli.commands import _parser
from icalib.cli.console import LINE_EVERY_S, console_progress, progress_lines


def commands(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """The parser and those of its commands."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in action.choices.values():
                yield from commands(one)


COMMANDS = {p.prog: p for p in commands(_parser())}


@each("prog", COMMANDS)
def test_each_command_has_examples_that_parse_and_says_what_each_option_does(prog: str):
    parser = COMMANDS[prog]
    assert all(action.help for action in parser._actions if not isinstance(action, argparse._SubParsersAction))
    head, *lines = (parser.epilog or "").splitlines()
    assert head == "examples:" and lines and all(line.startswith("  icalib ") for line in lines)
    assert all(line in parser.format_help() for line in lines)
    for line in lines:
        words = shlex.split(line)[1:]
        if words[-1] != "--help":
            assert callable(_parser().parse_args(words).run)


@each("prog", COMMANDS)
def test_options_with_a_default_name_it(prog: str):
    for action in COMMANDS[prog]._actions:
        plain = not action.option_strings or action.required or action.const is True or action.default in (None, [])
        if not plain and action.default is not argparse.SUPPRESS:
            assert "default" in (action.help or ""), action.option_strings


@each(
    ("words", "answer"),
    [
        ("calibrat rig.yaml run", "there is no 'calibrat', did you mean 'calibrate'; available are calibrate, inspect"),
        ("calibrate rig.yaml run --outptu out", "there is no option --outptu, did you mean '--output'"),
        ("calibrate rig.yaml run -o out --segment=2 --frm 5", "there is no option --frm, did you mean '--from'"),
        (
            "calibrate rig.yaml run -o out --loss hubr",
            "--loss: there is no 'hubr', did you mean 'huber'; available are",
        ),
        ("target aprilgird --rows 6", "there is no 'aprilgird', did you mean 'aprilgrid'"),
        ("export result --to kalbr -o out", "argument --to: there is no 'kalbr', did you mean 'kalibr'; available are"),
        ("fleet jobs.yaml", "the following arguments are required: --output/-o"),
        ("simulate scenario.yaml -o out --seed x", "argument --seed: must be a whole number, but is 'x'"),
    ],
)
def test_wrong_names_are_answered_with_the_nearest(words: str, answer: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as left:
        main(words.split())
    assert left.value.code == 2 and answer in capsys.readouterr().err


def test_long_work_prints_a_line_every_30_s(capsys: pytest.CaptureFixture[str]):
    now = 100.0
    show = progress_lines(lambda: now)
    for now in (101.0, 129.9, 130.0, 145.0, 160.5, 161.0):  # noqa: B007, read by the clock
        show("solving (final pass)", 0.25)
    lines = capsys.readouterr().err.splitlines()
    words = "icalib: solving (final pass), 25% after"
    assert LINE_EVERY_S == 30.0 and lines == [f"{words} 30 s", f"{words} 60 s"]


def test_no_lines_where_it_is_quiet(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("icalib.cli.console.LINE_EVERY_S", 0.0)
    for quiet in (False, True):
        with console_progress(quiet) as show:
            show("reading", 0.5)
        assert ("icalib: reading, 50% after" in capsys.readouterr().err) != quiet


@pytest.mark.parametrize(
    ("line", "completions"),
    [
        ("icalib comp", {"compare"}),
        ("icalib calibrate rig.yaml run --lo", {"--loss"}),
        ("icalib calibrate rig.yaml run --loss ", {"none", "huber", "cauchy"}),
        ("icalib calibrate ri", {"rig.yaml"}),
    ],
)
def test_a_shell_completes_commands_options_choices_and_paths(tmp_path: Path, line: str, completions: set[str]):
    pytest.importorskip("argcomplete")
    (tmp_path / "rig.yaml").touch()
    answer = tmp_path / "answer"
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": " ", "_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
    asked |= {"_ARGCOMPLETE_SHELL": "bash", "COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9"}
    program = [sys.executable, "-c", "from icalib.cli import main; main()"]
    subprocess.run(program, cwd=tmp_path, env=os.environ | asked, check=True, timeout=60)
    assert {*answer.read_text().split()} == completions
