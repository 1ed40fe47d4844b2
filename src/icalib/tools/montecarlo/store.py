"""The folder of a study: one file per run, written atomically, and study.json with the inputs of all runs."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from icalib.base.files import writing
from icalib.errors import CalibrationError
from icalib.result.provenance import versions
from icalib.tools.batch import check_worker, program, write_atomically
from icalib.tools.montecarlo.one_run import GuessKind, PlanesKind
from icalib.tools.montecarlo.record import RunRecord, from_json, to_json

STUDY, RUNS = "study.json", "runs"


@dataclass(frozen=True)
class Identity:
    """Inputs that all runs of a folder share. scenario: its name; scenario_sha256: of the scenario file and the
    trajectory file that it names; guess, planes: see `RunTask`; program, versions: of icalib, Python and libraries."""

    scenario: str
    scenario_sha256: str
    guess: GuessKind
    planes: PlanesKind
    program: str
    versions: dict[str, str]

    @classmethod
    def of(cls, scenario: str, scenario_sha256: str, guess: GuessKind, planes: PlanesKind) -> Identity:
        """The identity with the program and the versions of this process."""
        return cls(scenario, scenario_sha256, guess, planes, program(), versions())


_CHANGED = {
    "scenario_sha256": "the scenario changed",
    "guess": "their initial guess differs",
    "planes": "planes are known in one study and found in the other",
    "program": "icalib changed",
    "versions": "Python or a library changed",
}


class RunStore:
    """Records of runs by seed in a folder. Raises CalibrationError if the folder has runs of another study, or cannot
    be written."""

    def __init__(self, folder: Path, identity: Identity) -> None:
        self.folder, self.identity = folder, identity
        with writing(folder):
            (folder / RUNS).mkdir(parents=True, exist_ok=True)
            if (folder / STUDY).exists():
                self._check()
            else:
                write_atomically(folder / STUDY, json.dumps(asdict(identity), indent=1).encode())

    def __contains__(self, seed: int) -> bool:
        return self._file(seed).exists()

    def add(self, record: RunRecord) -> None:
        """Stores a record. Raises CalibrationError if the worker ran another icalib, or the file cannot be written."""
        check_worker(record.program, self.identity.program)
        write_atomically(self._file(record.seed), to_json(record))

    def read(self, seed: int) -> RunRecord:
        """The stored record of a seed. Raises CalibrationError if its file is damaged or missing."""
        path = self._file(seed)
        try:
            return from_json(path.read_bytes())
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CalibrationError(f"{path} is damaged; delete it to make the run again.") from error

    def _file(self, seed: int) -> Path:
        return self.folder / RUNS / f"{seed:06d}.json"

    def _check(self) -> None:
        path = self.folder / STUDY
        try:
            identity = json.loads(path.read_bytes())
            changed = [words for name, words in _CHANGED.items() if identity[name] != getattr(self.identity, name)]
        except (ValueError, KeyError, TypeError) as error:
            raise CalibrationError(f"{path} is damaged; choose another folder.") from error
        if changed:
            why = ", ".join(changed)
            raise CalibrationError(
                f"{self.folder} holds runs of another study ({why}); choose another folder, or delete it."
            )
