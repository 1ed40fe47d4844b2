"""The magnitude of gravity, and how well it is known."""

from __future__ import annotations

from math import radians, sin, sqrt
from typing import Any, NamedTuple

from icalib.base.yaml_nodes import YamlValue


class Gravity(NamedTuple):
    """Magnitude and its standard deviation [m/s^2]; sigma 0: exact."""

    value: float
    sigma: float


# On the ground of the earth it is 9.780 (equator) to 9.832 (poles), WGS84.
ANYWHERE = Gravity(9.806, 0.02)
ANOMALY_SIGMA = 5e-4  # m/s^2: gravity anomalies on land are 50 mGal and less (Pavlis et al., EGM2008, JGR 2012)


def gravity_at(latitude_deg: float, height_m: float) -> Gravity:
    """Normal gravity of WGS84 by Somigliana's formula, with the free-air gradient (NIMA TR8350.2, chapter 4)."""
    square = sin(radians(latitude_deg)) ** 2
    at_sea_level = 9.7803253359 * (1.0 + 0.00193185265241 * square) / sqrt(1.0 - 0.00669437999013 * square)
    return Gravity(at_sea_level - 3.086e-6 * height_m, ANOMALY_SIGMA)


def parse_gravity(value: YamlValue) -> Gravity:
    """Gravity from a number, which is exact, from {prior: VALUE, sigma: SIGMA}, or from {latitude: DEGREES, height:
    METRES}. Raises RigError naming line and field."""
    if not value.is_mapping:
        return Gravity(value.positive(), 0.0)
    names = ("latitude", "height") if "latitude" in value.entries() else ("prior", "sigma")
    fields = value.record(names)
    if names == ("prior", "sigma"):
        return Gravity(fields["prior"].positive(), fields["sigma"].positive())
    latitude = fields["latitude"].number()
    if abs(latitude) > 90.0:
        fields["latitude"].fail(f"is between -90 and 90 degrees, but is {latitude:g}; correct it.")
    return gravity_at(latitude, fields["height"].number())


def gravity_to_plain(gravity: Gravity) -> Any:
    """`gravity` as in a rig file."""
    return {"prior": gravity.value, "sigma": gravity.sigma} if gravity.sigma else gravity.value
