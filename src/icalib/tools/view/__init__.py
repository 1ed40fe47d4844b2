"""A 3D view of a result and its recording in Rerun.

Shows a stored result and its recording in Rerun.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from icalib.base.extras import load_rerun
from icalib.data.recordings import open_recording
from icalib.report.ellipsoids import SIGMAS, magnification
from icalib.result import Calibration, load_calibration
from icalib.result.quantities import rows
from icalib.rig.file import rig_from_dict
from icalib.tools.view.recorded import Recorded, log_residuals, log_states, span_of
from icalib.tools.view.scene import blueprint, log_motion, log_planes, log_rig, log_target, log_uncertainty
from icalib.tools.view.stream import RerunStream, opened

__all__ = ["view"]


def view(
    result: str | Path,
    recording: str | Path | None = None,
    save: str | Path | None = None,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> list[str]:
    """Shows the result of a calibration, and its recording, in Rerun's viewer. With `save`, a file for the viewer is
    written instead. Returns sentences on data that are not shown.

    result: the folder of a result, or the result.json in it. Raises CalibrationError if there is no result, the
    recording is not that of the result, the file cannot be written, or Rerun is not installed.
    """
    rr, folder = load_rerun(), Path(result)
    folder = folder.parent if folder.name == "result.json" else folder
    c = load_calibration(folder)
    recorded = None if recording is None else _recorded(c, folder, Path(recording))
    layout = blueprint(rr, c, recorded is not None)
    with opened(rr, layout, None if save is None else Path(save)) as stream:
        _log_result(stream, c)
        notes = [] if recorded is None else recorded.log(stream, progress)
        stream.still("summary", rr.TextDocument(summary(c, notes), media_type=rr.MediaType.MARKDOWN))
    return notes


def _recorded(c: Calibration, folder: Path, recording: Path) -> Recorded:
    opened_recording = open_recording(recording)
    rig = rig_from_dict(c.rig, str(folder / "result.json"))
    opened_recording.use_layouts(tuple(rig.sensors.values()))
    recorded = Recorded(c, rig, opened_recording, span_of(c, recording), recording)
    recorded.check()
    return recorded


def _log_result(stream: RerunStream, c: Calibration) -> None:
    for log in (log_rig, log_uncertainty, log_motion, log_target, log_planes, log_residuals, log_states):
        log(stream, c)


def summary(c: Calibration, notes: list[str]) -> str:
    """Status, warnings and parameters of the result, in Markdown."""
    sentences = [("Unobservable", c.unobservable), ("Warning", c.warnings), ("Shown", notes)]
    if c.mounted:
        sentences.append(("Ellipsoids", [f"{SIGMAS:g} sigma of each position, {magnification(c):g} times as large."]))
    listed = [f"- {title}: {sentence}" for title, of in sentences for sentence in of]
    table = ["| sensor | parameter | value | std | unit | verdict |", "|---|---|---|---|---|---|"]
    table += [f"| {r.sensor} | {r.name} | {r.value} | {r.std} | {r.unit} | {r.verdict} |" for r in rows(c)]
    return "\n".join([f"**{c.status}**", "", *listed, "", *table])
