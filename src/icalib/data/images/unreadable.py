"""Detection of files without readable data: pointers of Git LFS and git-annex, and videos in place of bags."""

from __future__ import annotations

from pathlib import Path

VIDEO_FILE = "video file"  # `TopicInfo.type` of a video
HEAD_BYTES = 64  # length of `head` for `not_data`
VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".h264", ".h265", ".mjpeg", ".insv", ".360")
_POINTERS = {b"version https://git-lfs.github.com/spec": "git lfs pull", b"/annex/objects/": "git annex get"}
_CONTAINERS = ((4, b"ftyp"), (0, b"\x1aE\xdf\xa3"), (8, b"AVI "))  # MP4 and MOV, Matroska and WebM, AVI


def not_data(path: Path, head: bytes) -> str | None:
    """Error message if a file that begins with `head` is a pointer of Git LFS or git-annex, or a video; else None."""
    for magic, command in _POINTERS.items():
        if head.startswith(magic):
            return f"{path} is a pointer to a file that was not downloaded; run `{command}` where it comes from."
    if any(head[at : at + len(magic)] == magic for at, magic in _CONTAINERS):
        return f"{path} is a video; give the folder that it lies in as the recording."
    return None


def is_video(path: Path) -> bool:
    """True if the suffix is that of a video file."""
    return path.suffix.lower() in VIDEO_SUFFIXES
