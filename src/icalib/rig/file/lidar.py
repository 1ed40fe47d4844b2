"""The fields of a LiDAR in a rig file."""

from __future__ import annotations

from typing import Any

from icalib.base.yaml_nodes import YamlValue
from icalib.rig import Lidar, PointTime, TimeUnit
from icalib.rig.file.fields import (
    choice_or,
    groups_to_plain,
    parameter_fields,
    parameters,
    path_or,
    positive_or,
    topic_or_none,
)

_FIELDS = (
    "path", "topic", "range_noise", "min_range", "max_range", "point_time", "point_time_field", "point_time_unit",
    *parameter_fields(Lidar),
)  # fmt: skip


def read_lidar(name: str, value: YamlValue) -> Lidar:
    """Raises RigError naming the field."""
    found = value.record(("type",), _FIELDS)
    low = positive_or(found, "min_range", Lidar.min_range_m)
    high = positive_or(found, "max_range", Lidar.max_range_m)
    if low >= high:
        found["min_range" if "min_range" in found else "max_range"].fail(
            f"the range from {low:g} to {high:g} m is empty; min_range must be below max_range."
        )
    return Lidar(
        name=name,
        path=path_or(found, f"{name}/scans.npz"),
        range_noise_m=found["range_noise"].positive() if "range_noise" in found else None,
        min_range_m=low,
        max_range_m=high,
        point_time=_point_time(found),
        point_time_field=found["point_time_field"].text() if "point_time_field" in found else None,
        point_time_unit=choice_or(found, "point_time_unit", TimeUnit, None),
        topic=topic_or_none(found),
        **parameters(found, Lidar.stated()),
    )


def _point_time(found: dict[str, YamlValue]) -> PointTime:
    """Fails where points would have a time of their own and none."""
    chosen = choice_or(found, "point_time", PointTime, Lidar.point_time)
    for name in ("point_time_field", "point_time_unit"):
        if name in found and chosen in ("azimuth", "snapshot"):
            found[name].fail(f"point_time: {chosen} uses no point times; remove {name}, or point_time.")
    return chosen


def lidar_to_plain(lidar: Lidar) -> dict[str, Any]:
    """Plain data that `read_lidar` reads back."""
    plain: dict[str, Any] = {"type": "lidar", "path": lidar.path, "min_range": lidar.min_range_m}
    plain |= {"max_range": lidar.max_range_m, "point_time": lidar.point_time}
    given = {"range_noise": lidar.range_noise_m, "topic": lidar.topic}
    given |= {name: getattr(lidar, name) for name in ("point_time_field", "point_time_unit")}
    return plain | {name: value for name, value in given.items() if value is not None} | groups_to_plain(lidar)
