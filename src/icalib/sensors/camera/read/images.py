"""The images of a camera in a recording."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.data.recordings import Payload, Recording
from icalib.errors import RecordingError
from icalib.sensors.camera.spec import Camera


def image_topic(recording: Recording, camera: Camera) -> str:
    """Name of the topic with the images of the camera. Raises RecordingError as `Recording.topic`."""
    return recording.image_topic(camera.name, camera.topic)


def camera_images(recording: Recording, camera: Camera, files: dict[int, str]) -> Iterator[Payload]:
    """The undecoded images of the camera. Fills `files` with the file name of each by its stamp, "" for those that come
    from no file.

    Raises RecordingError as `Recording.payloads`, and at the first image whose resolution is not the camera's.
    """
    where = recording.where(camera)
    for p in recording.payloads(image_topic(recording, camera)):
        if p.width and (p.width, p.height) != camera.resolution:
            raise RecordingError(
                f"{where}: images have {p.width} x {p.height} px, but {camera.name} {camera.resolution[0]} x "
                f"{camera.resolution[1]}; correct its resolution in the rig file."
            )
        files[p.stamp_ns] = p.name
        yield p
