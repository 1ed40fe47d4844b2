"""A LiDAR in the rig file: its fields and defaults."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

from icalib.base.yaml_nodes import YamlValue
from icalib.sensors.fields import (
    choice_or,
    groups_to_plain,
    parameter_fields,
    parameters,
    path_or,
    positive_or,
    topic_or_none,
)
from icalib.sensors.parameter import Parameter, ParameterSpec
from icalib.sensors.sensor import CLOCK_RATE, MOUNTED, Lack, MountedSensor, Sensor, TimeUnit

RANGE_OFFSET = ParameterSpec(
    name="range_offset",
    size=1,
    manifold="vector",
    unit="m",
    labels=("range_offset",),
    tolerance=5e-3,
    prior_sigma=0.03,  # range accuracy that data sheets of spinning LiDARs state, as the VLP-16's
    is_auxiliary=True,
    is_effect=True,
    largest=1.0,
    meaning="measured less true range, the same at all ranges",
    motion="show the board nearer and farther, and walls from all sides",
)
# Measured over true range, less 1. The prior is that accuracy over 30 m, to which many points are.
RANGE_SCALE = ParameterSpec(
    name="range_scale",
    size=1,
    manifold="nuisance",
    unit="",
    labels=("range_scale",),
    tolerance=1e-3,
    prior_sigma=1e-3,
    is_auxiliary=True,
    is_effect=True,
    is_considered=True,
    meaning="measured over true range, less 1",
    motion="move farther, where other sensors show how far",
)
N_RINGS = 16  # bands of elevation: each ring of a LiDAR with so many, or several rings
# True less reported. The prior is half the width of a beam of 3 mrad, by which rings are aimed.
RING_ELEVATIONS = ParameterSpec(
    name="ring_elevations",
    size=N_RINGS,
    manifold="nuisance",
    unit="rad",
    labels=tuple(str(k + 1) for k in range(N_RINGS)),
    tolerance=1e-3,
    prior_sigma=1.5e-3,
    one="ring_elevation",
    is_auxiliary=True,
    is_effect=True,
    largest=0.1,
    meaning="true less reported elevations of 16 bands of rings, the lowest first",
    motion="show walls and floor at all elevations",
)
# Measured less true range, beyond range_offset, which is that of the ring with most points.
RING_OFFSETS = replace(
    RING_ELEVATIONS,
    name="ring_offsets",
    one="ring_offset",
    unit="m",
    tolerance=RANGE_OFFSET.tolerance,
    prior_sigma=RANGE_OFFSET.prior_sigma,
    largest=RANGE_OFFSET.largest,
    meaning="range offsets of 16 bands of rings against that with most points, the lowest first",
)
# Of all rings together it is the rotation of the LiDAR about z: priors hold their mean at zero.
RING_AZIMUTHS = replace(
    RING_ELEVATIONS,
    name="ring_azimuths",
    one="ring_azimuth",
    meaning="true less reported azimuths of 16 bands of rings, the lowest first",
)
OF_RINGS = (RING_ELEVATIONS, RING_OFFSETS, RING_AZIMUTHS)
PointTime = Literal["auto", "start", "end", "azimuth", "snapshot"]
_FIELDS = (
    "path", "topic", "range_noise", "min_range", "max_range", "point_time", "point_time_field", "point_time_unit",
)  # fmt: skip


@dataclass(frozen=True)
class Lidar(MountedSensor):
    """One LiDAR. Points closer than min_range_m or farther than max_range_m are not used.

    point_time: meaning of the stamp of a scan and of the times of its points; see `read.point_times`. point_time_field,
    point_time_unit: field and unit of these times; None: detected from the data.
    """

    sensor_type: ClassVar[str] = "lidar"
    noun: ClassVar[str] = "LiDAR"
    readings: ClassVar[str] = "scans"
    gives_motion: ClassVar[bool] = True
    shows_planes: ClassVar[bool] = True
    parameters: ClassVar[tuple[ParameterSpec, ...]] = (
        *MOUNTED, CLOCK_RATE, RANGE_OFFSET, RANGE_SCALE, *OF_RINGS,
    )  # fmt: skip

    path: str
    range_noise_m: float | None = None  # sigma along the beam; None: estimated from the residuals
    min_range_m: float = 0.5
    max_range_m: float = 100.0
    point_time: PointTime = "auto"
    topic: str | None = None  # topic of the clouds; None: the topic with the LiDAR's name, or the only one
    point_time_field: str | None = None
    point_time_unit: TimeUnit | None = None
    range_offset: Parameter = Parameter("fixed")
    range_scale: Parameter = Parameter("fixed")
    ring_elevations: Parameter = Parameter("fixed")
    ring_offsets: Parameter = Parameter("fixed")
    ring_azimuths: Parameter = Parameter("fixed")

    @classmethod
    def parse(cls, name: str, value: YamlValue) -> Lidar:
        fields = value.record(("type",), (*_FIELDS, *parameter_fields(cls)))
        low = positive_or(fields, "min_range", cls.min_range_m)
        high = positive_or(fields, "max_range", cls.max_range_m)
        if low >= high:
            fields["min_range" if "min_range" in fields else "max_range"].fail(
                f"the range from {low:g} to {high:g} m is empty; min_range must be below max_range."
            )
        return cls(
            name=name,
            path=path_or(fields, f"{name}/scans.npz"),
            range_noise_m=fields["range_noise"].positive() if "range_noise" in fields else None,
            min_range_m=low,
            max_range_m=high,
            point_time=_point_time(fields),
            point_time_field=fields["point_time_field"].text() if "point_time_field" in fields else None,
            point_time_unit=choice_or(fields, "point_time_unit", TimeUnit, None),
            topic=topic_or_none(fields),
            **parameters(fields, cls.stated()),
        )

    def gives_motion_without_imu(self, has_target: bool) -> bool:
        return True

    def lacks(self, sensors: Mapping[str, Sensor], has_target: bool) -> Iterator[Lack]:
        if len(sensors) == 1:
            yield Lack(("sensors", self.name), "is the only sensor; add the sensors to calibrate it with.")

    def plain(self) -> dict[str, Any]:
        plain: dict[str, Any] = {"type": "lidar", "path": self.path, "min_range": self.min_range_m}
        plain |= {"max_range": self.max_range_m, "point_time": self.point_time}
        given = {"range_noise": self.range_noise_m, "topic": self.topic}
        given |= {name: getattr(self, name) for name in ("point_time_field", "point_time_unit")}
        return plain | {name: value for name, value in given.items() if value is not None} | groups_to_plain(self)


def _point_time(fields: dict[str, YamlValue]) -> PointTime:
    """The value of point_time. Raises RigError if a field or unit of point times is given although it uses no times."""
    chosen = choice_or(fields, "point_time", PointTime, Lidar.point_time)
    for name in ("point_time_field", "point_time_unit"):
        if name in fields and chosen in ("azimuth", "snapshot"):
            fields[name].fail(f"point_time: {chosen} uses no point times; remove {name}, or point_time.")
    return chosen
