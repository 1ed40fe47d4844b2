"""Topics and tables of a recording that can be position sensors: NavSatFix, PointStamped, RTKLIB files, tables."""

from __future__ import annotations

from typing import ClassVar

from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.kinds import KindInspector


class PositionInspector(KindInspector):
    """See `KindInspector`. Drafts comment these sensors out: a point may be anything, such as a goal that somebody
    clicked on."""

    sensor: ClassVar[type[Sensor]] = PositionSensor
    topic_kinds: ClassVar[tuple[str, ...]] = ("navsat", "point", "position")
    prefix: ClassVar[str] = "gnss"
    plain_names: ClassVar[str] = r"positions\.csv|[^/]*\.pos|fix|navsat(fix)?|point|position"
    moves_with_wheels: ClassVar[bool] = True
    doubt: ClassVar[tuple[str, ...]] = (
        "Positions of something on the robot: an antenna, a prism, a tag? Then remove the #;",
        "the lever arm and the clock are calibrated (docs/rig-file.md#position-sensor).",
    )


INSPECTOR = PositionInspector()
