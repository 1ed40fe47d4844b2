"""What all kinds of sensors share: the parameters of those that are mounted on the body, and how tables are written."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Literal, TypeVar

from icalib.rig.parameter import check_sizes
from icalib.rig.parameter_spec import AXES, ParameterSpec

T = TypeVar("T")
TimeUnit = Literal["s", "ms", "us", "ns"]
Axes = tuple[str, str, str]  # the columns that become x, y, z, each with its sign: ("x", "-y", "-z")

ROTATION = ParameterSpec(
    name="rotation",
    size=3,
    manifold="rotation",
    unit="rad",
    labels=AXES,
    tolerance="rotation_tolerance_deg",
    prior_sigma=0.1,
    motion="turn the rig about {axes}",
    motion_on_wheels="drive over ramps: a flat floor does not show tilts; or give it as a prior",
)
TRANSLATION = ParameterSpec(
    name="translation",
    size=3,
    manifold="vector",
    unit="m",
    labels=AXES,
    tolerance="translation_tolerance_m",
    prior_sigma=0.1,
    motion="turn the rig briskly about {axes}: a lever arm shows only in rotation",
    motion_on_wheels="turn, and drive over ramps: a flat floor does not show heights; or give it as a prior",
)
TIME_OFFSET = ParameterSpec(
    name="time_offset",
    size=1,
    manifold="vector",
    unit="s",
    labels=("time_offset",),
    tolerance="time_tolerance_s",
    prior_sigma=0.02,
    motion="turn or shake the rig faster, so that a time shift shows",
    motion_on_wheels="speed up, brake and turn more",
)
MOUNTED = (ROTATION, TRANSLATION, TIME_OFFSET)  # of every sensor on the body
MOUNTED_NAMES = tuple(spec.name for spec in MOUNTED)


def mounted(rotation: T, translation: T, time_offset: T) -> dict[str, T]:
    """Values of `MOUNTED` by name."""
    return dict(zip(MOUNTED_NAMES, (rotation, translation, time_offset), strict=True))


@dataclass(frozen=True)
class TableLayout:
    """How a sensor's table is written. columns: names in its header, or numbers from 1 on, in icalib's order; empty:
    told by the header, or in that order. time_unit: of its stamps; None: told by their rate."""

    columns: tuple[str, ...] = ()
    time_unit: TimeUnit | None = None


PLAIN_TABLE = TableLayout()


@dataclass(frozen=True)
class Sensor:
    """A sensor of the rig. parameters: all that sensors of its type may have; `sensor_type`: its `type` in the
    rig file."""

    sensor_type: ClassVar[str]
    parameters: ClassVar[tuple[ParameterSpec, ...]] = MOUNTED
    name: str

    def __post_init__(self) -> None:
        check_sizes(self, self.specs())

    def specs(self) -> tuple[ParameterSpec, ...]:
        """The parameters that this sensor has, in the order of the layout."""
        return self.parameters

    def is_estimated(self, spec: ParameterSpec) -> bool:
        """Whether the group is estimated, as far as the sensor alone says."""
        return getattr(self, spec.name).mode != "fixed"

    @classmethod
    def stated(cls) -> tuple[ParameterSpec, ...]:
        """Those of `parameters` that are fields of the rig file."""
        names = {f.name for f in fields(cls)}
        return tuple(spec for spec in cls.parameters if spec.name in names)
