"""What the golden record keeps of a calibration, and how two records differ."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import re
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from golden_cases import Case, Inputs, case_folder

from icalib.cli.console import print_result
from icalib.data.measurements import Measurements
from icalib.errors import CalibrationError
from icalib.export.formats import FORMATS, export, output_files
from icalib.pipeline import calibrate_measurements, measure
from icalib.result import Calibration
from icalib.rig import Rig
from icalib.rig.file import load_rig

EQUAL = 1e-9
SCREEN = {"COLUMNS": "120", "LINES": "50"}  # of the console


@dataclass(frozen=True)
class Record:
    """One calibration, or the sentence that refuses it.

    values, std, verdict: by "sensor.parameter". chi2: of all residuals. visits: states at which the solver looked for a
    step. cpu_s: processor time from the files to the result. overall: the verdict on the result. reason_names,
    note_names: identifier of each sentence. files: sha256 of each file of result and exports, and of the console's text
    ("console"), by name; date, versions and times are left out.
    """

    values: dict[str, list[float]] = field(default_factory=dict)
    std: dict[str, list[float]] = field(default_factory=dict)
    verdict: dict[str, list[str]] = field(default_factory=dict)
    converged: bool = False
    chi2: float = 0.0
    visits: int = 0
    cpu_s: float = 0.0
    overall: str = ""
    reasons: list[str] = field(default_factory=list)
    reason_names: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    note_names: list[str] = field(default_factory=list)
    refusal: str = ""
    files: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Change:
    """Between two records. moved: the largest change of a value over its standard deviation; scaled: the largest change
    of a standard deviation, relative; relative: the largest of a value, a standard deviation or chi2, relative to it
    or, of a value, to its standard deviation if that is larger. words: what else differs. sentences: those that came or
    went, whatever their numbers; texts: those whose numbers differ, and files that differ."""

    moved: float
    scaled: float
    relative: float
    words: tuple[str, ...]
    sentences: tuple[str, ...]
    texts: tuple[str, ...]


def record_case(case: Case, data: Path, rounds: int = 1) -> Record:
    """The last of some runs of a case. data: folder of the real recordings."""
    with case_folder(data), patch.dict(os.environ, SCREEN):
        inputs = case()
        for k in range(rounds - 1):
            _run(inputs, k)
        found, visits, spent = _run(inputs, rounds - 1)
        if isinstance(found, CalibrationError):
            notes = getattr(found, "__notes__", ())
            return Record(cpu_s=spent, refusal=str(found), notes=[*notes], note_names=[note.name for note in notes])
        return replace(record_of(found), visits=visits, cpu_s=spent)


def _run(inputs: Inputs, number: int) -> tuple[Calibration | CalibrationError, int, float]:
    """Result or refusal, visits, and processor time [s]. Each run detects corners anew."""
    visits: list[object] = []
    begun = time.process_time()
    with patch.dict(os.environ, {"ICALIB_CACHE": f"corners-{number}"}):
        try:
            rig, measurements = _measured(inputs)
            found = calibrate_measurements(rig, measurements, on_visit=visits.append)
        except CalibrationError as error:
            found = error
    return found, len(visits), time.process_time() - begun


def _measured(inputs: Inputs) -> tuple[Rig, list[Measurements]]:
    rig = inputs.rig if isinstance(inputs.rig, Rig) else load_rig(inputs.rig)
    given = [x for x in inputs.recordings if isinstance(x, Measurements)]
    paths = [x for x in inputs.recordings if isinstance(x, Path)]
    return rig, given or measure(rig, paths, end_s=inputs.end_s)


def record_of(result: Calibration) -> Record:
    """Without visits and processor time, which the result does not hold."""
    groups = {f"{g.sensor}.{g.name}": g for g in result.groups}
    return Record(
        {key: np.ravel(g.value).tolist() for key, g in groups.items()},
        {key: np.ravel(g.std).tolist() for key, g in groups.items()},
        {key: list(g.verdict) for key, g in groups.items()},
        result.converged,
        float(sum(f.chi2 for f in result.fits)),
        overall=result.verdict,
        reasons=list(result.reasons),
        reason_names=[remark.name for remark in result.reasons],
        notes=list(result.notes),
        note_names=[remark.name for remark in result.notes],
        files=_digests(result),
    )


def _digests(result: Calibration) -> dict[str, str]:
    """Of each file that the result is written and exported to, and of the console's text."""
    versions, timings = dict.fromkeys(result.versions, "1.0"), dict.fromkeys(result.timings, 1.0)
    result = replace(result, made="2000-01-01T00:00:00+00:00", versions=versions, timings=timings)
    contents = output_files(result) | {"console": _console_text(result).encode()}
    for name in FORMATS:
        contents |= {f"{name}/{file}": text.encode() for file, text in _exported(result, name).items()}
    return {name: hashlib.sha256(content).hexdigest() for name, content in sorted(contents.items())}


def _exported(result: Calibration, name: str) -> dict[str, str]:
    """Files of one format and the sentences on what they cannot hold, or the sentence that refuses it."""
    try:
        exported = export(result, name)
    except CalibrationError as error:
        return {"refusal": str(error)}
    return dict(exported.files) | {"sentences": "\n".join(exported.sentences)}


def _console_text(result: Calibration) -> str:
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        print_result(result, Path("result"), verbose=True)
    return text.getvalue()


def changed(old: Record, new: Record) -> Change:
    """What differs between two records of the same case."""
    words = [f"{key} is only in one of both" for key in sorted(old.values.keys() ^ new.values.keys())]
    words += ["convergence differs"] if old.converged != new.converged else []
    words += [f"{old.overall} became {new.overall}"] if old.overall != new.overall else []
    for kind in ("reason_names", "note_names"):
        a, b = Counter(getattr(old, kind)), Counter(getattr(new, kind))
        words += [f"{kind}: {verb}: {name}" for verb, some in (("went", a - b), ("came", b - a)) for name in some]
    moved, scaled, relative = [0.0], [0.0], [abs(new.chi2 - old.chi2) / max(old.chi2, 1e-300)]
    for key in sorted(old.values.keys() & new.values.keys()):
        if old.verdict[key] != new.verdict[key]:
            words.append(f"{key}: {' '.join(old.verdict[key])} became {' '.join(new.verdict[key])}")
        a, b, s, t = (np.array(x[key]) for x in (old.values, new.values, old.std, new.std))
        if a.shape != b.shape or s.shape != t.shape:
            words.append(f"{key} has another size")
            continue
        spread = np.resize(s, a.shape) if s.size == a.size else np.full(a.shape, s.max(initial=0.0))
        apart, size = np.abs(b - a), np.maximum(np.abs(a), spread)
        relative.append(float((apart / np.maximum(size, 1e-300)).max(initial=0.0)))
        moved.append(float((apart[spread > 0.0] / spread[spread > 0.0]).max(initial=0.0)))
        scaled.append(float((np.abs(t - s)[s > 0.0] / s[s > 0.0]).max(initial=0.0)))
        words += [f"{key} is fixed in only one of both"] if ((s > 0.0) != (t > 0.0)).any() else []
    sentences, texts = _sentences(old, new)
    texts += [f"{name} differs" for name in sorted(old.files.keys() | new.files.keys()) if _differs(name, old, new)]
    return Change(max(moved), max(scaled), max(*relative, *scaled), tuple(words), tuple(sentences), tuple(texts))


def _sentences(old: Record, new: Record) -> tuple[list[str], list[str]]:
    """Sentences that came or went, and those that differ in numbers or order alone."""
    lines: dict[bool, list[str]] = {True: [], False: []}
    for kind in ("reasons", "notes", "refusal"):
        a, b = ([x] if isinstance(x := getattr(record, kind), str) else x for record in (old, new))
        for verb, some, others in (("went", a, b), ("came", b, a)):
            alike = {_without_numbers(sentence) for sentence in others}
            for sentence in some:
                if sentence and sentence not in others:
                    lines[_without_numbers(sentence) in alike].append(f"{kind}: {verb}: {sentence}")
        if sorted(a) == sorted(b) and a != b:
            lines[True].append(f"{kind}: in another order")
    return lines[False], lines[True]


def _without_numbers(sentence: str) -> str:
    return re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?", "#", sentence)


def _differs(file: str, old: Record, new: Record) -> bool:
    return old.files.get(file) != new.files.get(file)


def is_equal(change: Change, sigma: float | None) -> bool:
    """Whether nothing differs, numbers by no more than EQUAL; or with `sigma`, whether numbers differ by no more than
    this share of standard deviations, and sentences in their numbers alone."""
    if change.words or change.sentences:
        return False
    if sigma is None:
        return not change.texts and change.relative <= EQUAL
    return max(change.moved, change.scaled) <= sigma
