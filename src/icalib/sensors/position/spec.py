"""A position sensor (GNSS antenna, total station, UWB, tracked prism), and its fields in the rig file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from icalib.base.yaml_nodes import YamlValue
from icalib.sensors.fields import (
    TABLE,
    choice_or,
    groups_to_plain,
    layout_to_plain,
    parameter_fields,
    parameters,
    path_or,
    table_layout,
    topic_or_none,
)
from icalib.sensors.parameter import Parameter, ParameterSpec
from icalib.sensors.sensor import (
    CLOCK_RATE,
    PLAIN_TABLE,
    TIME_OFFSET,
    TRANSLATION,
    ClockedSensor,
    Lack,
    Sensor,
    TableLayout,
    has_imu,
)

LEVELLED, TILTED = "levelled", "tilted"
Coordinates = Literal["metric", "geodetic"]
Status = Literal["single", "differential", "float", "fixed"]  # quality of a GNSS fix, worst first
STATUSES: tuple[Status, ...] = ("single", "differential", "float", "fixed")
MESSAGES: Literal["messages"] = "messages"
_ADDITIONS = "an IMU, a camera that sees a target, a LiDAR or a pose sensor"
_FIELDS = ("path", "topic", "coordinates", "frame", "position_noise", "position_random_walk", "least_status")


@dataclass(frozen=True)
class PositionSensor(ClockedSensor):
    """A sensor that measures its position in a static frame, and no orientation. Its axes are those of the body.

    coordinates: of a table, metric or geodetic (latitude, longitude, height); None: the header of the table shows it.
    frame: "levelled", z points up, yaw and origin in the world are estimated (GNSS, total station); "tilted", rotation
    and origin are estimated (UWB anchors); else the name of a sensor, or "target", whose frame this sensor shares.
    position_noise [m]: standard deviation of each axis; "messages": the covariances of the recording, unchanged; None:
    estimated from the residuals, with the covariances of the recording as relative weights.
    position_random_walk [m/sqrt(s)]: density of a slow offset of the fixes on each axis; 0: none. least_status: fixes
    of a worse status are left out.
    """

    sensor_type: ClassVar[str] = "position"
    noun: ClassVar[str] = "position sensor"
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (TRANSLATION, TIME_OFFSET, CLOCK_RATE)
    readings: ClassVar[str] = "positions"
    gives_motion: ClassVar[bool] = True
    may_change: ClassVar[tuple[tuple[str, ...], ...]] = ((TIME_OFFSET.name,), (TRANSLATION.name,))

    path: str
    coordinates: Coordinates | None = None
    frame: str = LEVELLED
    position_noise: float | Literal["messages"] | None = None
    position_random_walk: float = 0.0
    least_status: Status = "single"
    translation: Parameter = Parameter()  # (3,) lever arm: the antenna in the body's frame [m]
    topic: str | None = None  # of its messages; None: the one with the sensor's name, or the only one
    layout: TableLayout = PLAIN_TABLE

    @property
    def has_frame(self) -> bool:
        return self.frame in (LEVELLED, TILTED)

    @property
    def shared_frame(self) -> str:
        return "" if self.has_frame else self.frame

    def lacks(self, sensors: Mapping[str, Sensor], has_target: bool) -> Iterator[Lack]:
        yield from super().lacks(sensors, has_target)
        if has_imu(sensors) or any(s.gives_motion_without_imu(has_target) for s in sensors.values()):
            return
        where = ("sensors", self.name)
        wheels = [s for s in sensors.values() if s.drives]
        if not wheels or any(s.tracks_points for s in sensors.values()):
            yield Lack(where, f"positions do not determine rotations; add {_ADDITIONS}.")
        elif not any(s.stays_level for s in wheels):
            yield Lack(
                where,
                f"positions and {wheels[0].name} do not determine roll and pitch; if the floor is flat, write `ground: "
                f"{{plane: level, tilt_noise: 0.01}}` in {wheels[0].name}, else add {_ADDITIONS}.",
            )

    @classmethod
    def parse(cls, name: str, value: YamlValue) -> PositionSensor:
        fields = value.record(("type",), (*_FIELDS, *TABLE, *parameter_fields(cls)))
        return cls(
            name=name,
            path=path_or(fields, f"{name}/positions.csv"),
            coordinates=choice_or(fields, "coordinates", Coordinates, None),
            frame=fields["frame"].text() if "frame" in fields else cls.frame,
            position_noise=_noise(fields["position_noise"]) if "position_noise" in fields else None,
            position_random_walk=fields["position_random_walk"].positive() if "position_random_walk" in fields else 0.0,
            least_status=choice_or(fields, "least_status", Status, cls.least_status),
            topic=topic_or_none(fields),
            layout=table_layout(fields),
            **parameters(fields, cls.stated()),
        )

    def plain(self) -> dict[str, Any]:
        plain: dict[str, Any] = {"type": "position", "path": self.path, "frame": self.frame}
        plain |= layout_to_plain(self.layout) | {"least_status": self.least_status}
        given = {name: getattr(self, name) for name in ("coordinates", "position_noise", "topic")}
        given["position_random_walk"] = self.position_random_walk or None
        return plain | {name: value for name, value in given.items() if value is not None} | groups_to_plain(self)


def _noise(value: YamlValue) -> float | Literal["messages"]:
    is_text = not (value.is_list or value.is_mapping) and value.text() == MESSAGES
    return MESSAGES if is_text else value.positive()
