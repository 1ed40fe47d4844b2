"""Topics of sensors in formats that icalib does not read."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.data.topics import type_not_read
from icalib.tools.inspection.facts import Finding, Inspection


def unread(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on topics with messages that icalib does not read, such as raw LiDAR packets and videos."""
    for stream in inspection.streams:
        if stream.topic.count and (content := type_not_read(stream.topic.type)):
            yield Finding("warning", f"{stream.topic.name} holds {content[1]}.")
