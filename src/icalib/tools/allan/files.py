"""Result files of `icalib allan`."""

from __future__ import annotations

from pathlib import Path

from icalib.base.own_files import refuse_foreign, sealed_texts
from icalib.base.result_files import check_writable
from icalib.base.text_files import printable, write_texts
from icalib.tools.allan.analysis import ImuNoiseStudy
from icalib.tools.allan.page import allan_html
from icalib.tools.allan.words import rig_snippet, study_json

FILES = ("allan.html", "noise.yaml", "allan.json")


def check_folder(folder: Path) -> None:
    """Makes `folder` and checks that it is writable, before the work starts.

    Raises CalibrationError if it is not, or if it has files of the names `FILES` that icalib did not write.
    """
    check_writable(folder)
    refuse_foreign(folder / name for name in FILES)


def write_study(study: ImuNoiseStudy, folder: Path) -> None:
    """Writes allan.html, noise.yaml (fields of a rig file) and allan.json to `folder`. Raises CalibrationError if that
    fails, or a file of the same name is not from icalib."""
    texts = map(printable, (allan_html(study), rig_snippet(study, warned=True), study_json(study)))
    refuse_foreign(folder / name for name in FILES)
    write_texts(folder, sealed_texts(dict(zip(FILES, texts, strict=True))))
