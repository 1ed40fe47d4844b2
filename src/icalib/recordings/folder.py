"""Recordings that are folders of tables: `imu0/data.csv`, `cam0/corners.csv`, gzip or not, EuRoC's `mav0/` included."""

from __future__ import annotations

from pathlib import Path

from icalib.errors import RecordingError
from icalib.geometry.targets import Target
from icalib.measurements import CornerStream, ImuStream
from icalib.recordings.base import Recording
from icalib.recordings.corners import group_corners
from icalib.recordings.table import read_table

_IMU_DECIMALS = ("wx [rad/s]", "wy [rad/s]", "wz [rad/s]", "ax [m/s^2]", "ay [m/s^2]", "az [m/s^2]")
_MAX_LISTED = 12


class FolderRecording:
    """A folder of tables.

    IMU: t [ns], wx, wy, wz [rad/s], ax, ay, az [m/s^2], which is also EuRoC's `imu0/data.csv`. Corners: t [ns], tag id,
    corner (as the target names its points), u, v [px].
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._read: list[Path] = []

    def imu(self, path_hint: str, name: str) -> ImuStream:
        table = read_table(self._locate(path_hint), ("t [ns]",), _IMU_DECIMALS)
        self._remember(table.path)
        return ImuStream(name, table.integers[:, 0].copy(), table.decimals[:, :3].copy(), table.decimals[:, 3:].copy())

    def corners(self, path_hint: str, name: str, target: Target) -> CornerStream:
        table = read_table(self._locate(path_hint), ("t [ns]", "tag id", "corner"), ("u [px]", "v [px]"))
        self._remember(table.path)
        stamps, tag, corner = (table.integers[:, k].copy() for k in range(3))
        return group_corners(name, str(table.path), stamps, tag, corner, table.decimals, target)

    def where(self, path_hint: str) -> str:
        return str(self._locate(path_hint))

    def files(self) -> list[Path]:
        return list(self._read)

    def _remember(self, path: Path) -> None:
        if path not in self._read:
            self._read.append(path)

    def _locate(self, path_hint: str) -> Path:
        plain = path_hint.removesuffix(".gz")
        for folder in (self.root, self.root / "mav0"):
            for name in (path_hint, plain, plain + ".gz"):
                if (folder / name).is_file():
                    return folder / name
        raise RecordingError(
            f"{self.root} has no {plain} (nor {plain}.gz); {self._listing()}; set `path` of the sensor in the rig file."
        )

    def _listing(self) -> str:
        found = sorted(str(p.relative_to(self.root)) for p in self.root.rglob("*") if p.is_file())
        if not found:
            return "the folder holds no files"
        more = f" and {len(found) - _MAX_LISTED} more" if len(found) > _MAX_LISTED else ""
        return f"it holds {', '.join(found[:_MAX_LISTED])}{more}"


def open_recording(path: str | Path) -> Recording:
    """Open the recording at `path`, a folder of tables. Raises RecordingError where it is missing or not a folder."""
    root = Path(path)
    if root.is_dir():
        return FolderRecording(root)
    if root.exists():
        raise RecordingError(
            f"{root} is a file, but a recording is a folder of tables; give the folder of imu0/data.csv."
        )
    parent = root.parent
    beside = sorted(p.name for p in parent.iterdir())[:_MAX_LISTED] if parent.is_dir() else []
    listing = f"{parent} holds {', '.join(beside)}" if beside else f"{parent} is empty or missing"
    raise RecordingError(f"{root} does not exist; {listing}; check the path of the recording.")
