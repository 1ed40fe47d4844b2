"""Tables of positions: metric x, y, z, or latitude, longitude and height; with standard deviations where a header names
them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from icalib.data.images.image_checks import Note, ignore
from icalib.data.tables.columns import STAMP, TableKind, places_by_name
from icalib.data.tables.table import named, read_table
from icalib.sensors.position.read.readings import NO_COVARIANCE, PositionReadings
from icalib.sensors.position.spec import PositionSensor

FIX_RATES_HZ = (1e-2, 1000.0)  # lowest and highest: other rates show another unit of the stamps
_SIGMA = r"(s|sd|std|stddev|sigma|std_dev)"
METRIC = TableKind(
    ("t [ns]",),
    ("x [m]", "y [m]", "z [m]"),
    (
        STAMP,
        (r"(p|pos|position|point|p_rs_r)_?x|x|east(ing)?|e",),
        (r"(p|pos|position|point|p_rs_r)_?y|y|north(ing)?|n",),
        (r"(p|pos|position|point|p_rs_r)_?z|z|up|u|height|h|altitude|alt",),
    ),
    FIX_RATES_HZ,
)
GEODETIC = TableKind(
    ("t [ns]",),
    ("latitude [deg]", "longitude [deg]", "height [m]"),
    (
        STAMP,
        (r"lat(itude)?(_deg)?",),
        (r"lon(g|gitude)?(_deg)?",),
        (r"(ellipsoid(al)?_)?h(eight)?(_m)?|alt(itude)?(_m)?|hgt|hae",),
    ),
    FIX_RATES_HZ,
)
_DEVIATIONS = (
    (rf"{_SIGMA}_?(x|e|east)",),
    (rf"{_SIGMA}_?(y|n|north)",),
    (rf"{_SIGMA}_?(z|u|up|h)",),
)


def read_position_table(sensor: PositionSensor, path: Path, note: Note = ignore) -> tuple[PositionReadings, bool]:
    """The positions in a table, and whether they are latitude, longitude and height: as the rig file says, or as the
    names of the columns do. Standard deviations are those of east, north and up, or of x, y and z. Raises
    RecordingError naming file and line."""
    layout, geodetic = sensor.layout, sensor.coordinates == "geodetic"
    if sensor.coordinates is None:
        geodetic = named(path, GEODETIC) if not layout.columns else places_by_name(GEODETIC, layout.columns) is not None
    kind = GEODETIC if geodetic else METRIC
    stated = _with_deviations(kind)
    kind = stated if len(layout.columns) == len(stated.names) or (not layout.columns and named(path, stated)) else kind
    table = read_table(path, kind, layout, note)
    values = table.decimals
    covariance = NO_COVARIANCE
    if values.shape[1] == 6 and (values[:, 3:] > 0.0).all():
        covariance = values[:, 3:, None] ** 2 * np.eye(3)
    readings = PositionReadings(
        sensor.name, table.integers[:, 0].copy(), values[:, :3].copy(), covariance, np.zeros(0, np.int64)
    )
    return readings, geodetic


def _with_deviations(kind: TableKind) -> TableKind:
    return replace(kind, decimals=(*kind.decimals, "sx [m]", "sy [m]", "sz [m]"), known=(*kind.known, *_DEVIATIONS))
