"""The magnitude of gravity in the rig file: exact, with a prior, or from a place."""

import pytest
from tests.cases import each

from icalib.base.yaml_nodes import parse_yaml
from icalib.errors import RigError
from icalib.rig.rig import Gravity, gravity_at, gravity_to_plain, parse_gravity


def parsed(text):
    return parse_gravity(parse_yaml(f"gravity: {text}", "rig.yaml").entries()["gravity"])


def test_a_number_is_exact():
    assert parsed("9.81") == Gravity(9.81, 0.0)
    assert gravity_to_plain(Gravity(9.81, 0.0)) == 9.81


def test_a_prior_comes_back():
    assert parsed(gravity_to_plain(Gravity(9.8, 0.01))) == Gravity(9.8, 0.01)


# Gravity at sea level: WGS84's own at equator and poles; gravimeters in Zurich (408 m) and Quito (2850 m).
@each(
    ("latitude", "height", "expected", "within"),
    [
        (0.0, 0.0, 9.7803253, 1e-7),
        (90.0, 0.0, 9.8321849, 1e-7),
        (47.4, 408.0, 9.8066, 1e-3),
        (-0.2, 2850.0, 9.7725, 2e-3),
    ],
)
def test_latitude_and_height_give_gravity(latitude, height, expected, within):
    assert gravity_at(latitude, height).value == pytest.approx(expected, abs=within)
    assert parsed(f"{{latitude: {latitude}, height: {height}}}") == gravity_at(latitude, height)


@each(
    ("text", "words"),
    [
        ("-9.81", "gravity"),
        ("{prior: 9.8}", "sigma"),
        ("{latitude: 100, height: 0}", "between -90 and 90 degrees"),
        ("{latitude: 47}", "height"),
    ],
)
def test_what_cannot_be_gravity_is_named(text, words):
    with pytest.raises(RigError, match=words):
        parsed(text)
