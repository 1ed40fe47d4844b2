"""Output folder of a calibration: all files that derive from one result, written as one set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from icalib.base.files import check_writable, printable, refuse_foreign_set, sealed, write_files
from icalib.export.kalibr import kalibr_texts
from icalib.report import report_html
from icalib.result import Calibration, calibration_files


def write_outputs(calibration: Calibration, folder: str | Path) -> None:
    """Write `output_files` into `folder`: all or none.

    Raises CalibrationError if `folder` cannot be written, or contains files of the same names that icalib did not
    write.
    """
    refuse_foreign_set(Path(folder))
    write_files(Path(folder), output_files(calibration))


def output_files(calibration: Calibration) -> dict[str, bytes]:
    """Contents of the result files, Kalibr's files (`kalibr_texts`) and the report, by name."""
    texts = {"report.html": report_html(calibration)}
    texts |= {name: text(calibration) for name, text in kalibr_texts(calibration).items()}
    return calibration_files(calibration) | {name: sealed(printable(text).encode()) for name, text in texts.items()}


def check_folder(folder: str | Path, inputs: Sequence[Path] = ()) -> None:
    """Create `folder` and check that it can be written, before the calibration starts.

    Raises CalibrationError if it cannot, or if a file that icalib did not write, or one of `inputs`, would be
    overwritten.
    """
    check_writable(Path(folder))
    refuse_foreign_set(Path(folder), inputs)
