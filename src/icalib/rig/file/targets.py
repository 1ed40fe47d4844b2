"""Parses targets of a rig file: the field `target`, or several by name in the field `targets`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from icalib.base.file_names import NAME, NAME_WORDS
from icalib.base.yaml_nodes import YamlValue
from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Circles, Markers, Scene, Target
from icalib.geometry.targets.families import family_name

# type -> required fields, optional fields
_FIELDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "aprilgrid": (("rows", "cols", "tag_size", "tag_spacing"), ("border_bits", "squares", "first_id", "family")),
    "charuco": (("squares_x", "squares_y", "square_size", "marker_size", "dictionary"), ("legacy", "inverted")),
    "checkerboard": (("rows", "cols", "square_size"), ("inverted", "upright")),
    "circles": (("rows", "cols", "spacing", "diameter"), ("asymmetric",)),
    "markers": (("family", "size"), ("ids", "border_bits")),
}
_LARGEST_TAG_M = 2.0  # a larger value is probably in millimetres
_MOST_TAGS = 10_000
_LARGEST_SIGMA = 0.2  # relative; a larger value is probably in percent


def target_or_targets(root: YamlValue) -> Target:
    """The target in the field `target` or `targets` of the file; several targets are combined into a `Scene`.

    Raises RigError with file, line and field, what is wrong and what to do.
    """
    found = root.entries()
    if "target" not in found and "targets" not in found:
        root.fail("target is missing; add target, or targets for several by name.")
    if "targets" not in found:
        return target_of(found["target"])
    if "target" in found:
        found["targets"].fail("conflicts with target; put all targets under targets.")
    named = found["targets"].entries()
    for name, value in named.items():
        if not NAME.fullmatch(name):
            value.fail(f"a target's name is {NAME_WORDS}, as in wall; rename it.")
    if not named:
        found["targets"].fail("there is no target; add one, as in wall: {type: markers, ...}.")
    targets = tuple(target_of(value) for value in named.values())
    return targets[0] if len(targets) == 1 else _made(found["targets"], lambda: Scene(tuple(named), targets))


def target_of(value: YamlValue) -> Target:
    """One target from the mapping of its fields. Raises RigError as `target_or_targets`."""
    given = value.entries()
    if "type" not in given:
        value.fail(f"type is missing; add type: {', type: '.join(_FIELDS)}.")
    kind = given["type"].choice("target type", tuple(_FIELDS))
    required, optional = _FIELDS[kind]
    found = value.record(("type", *required), (*optional, "size_sigma"))
    target = _of_kind(kind, value, found)
    return replace(target, size_sigma=_size_sigma(found["size_sigma"])) if "size_sigma" in found else target


def _size_sigma(value: YamlValue) -> float:
    if not 0.0 <= (sigma := value.number()) < _LARGEST_SIGMA:
        value.fail(
            f"is a share of the size between 0 (exact) and {_LARGEST_SIGMA}, but is {sigma:g}; write 0.002 for 0.2 %."
        )
    return sigma


def _of_kind(kind: str, value: YamlValue, found: dict[str, YamlValue]) -> Target:
    if kind == "aprilgrid":
        return _aprilgrid(value, found)
    if kind == "markers":
        return _markers(value, found)
    if kind == "circles":
        counts, spacing = _counts(value, found, "rows", "cols", "circles"), _edge(found["spacing"], "spacing")
        diameter = _edge(found["diameter"], "circle")
        return _made(value, lambda: Circles(*counts, spacing, diameter, _yes(found, "asymmetric")))
    size = _edge(found["square_size"], "square")
    if kind == "checkerboard":
        rows, cols = _counts(value, found, "rows", "cols", "corners")
        return _made(value, lambda: Checkerboard(rows, cols, size, _yes(found, "inverted"), _yes(found, "upright")))
    squares = _counts(value, found, "squares_x", "squares_y", "squares")
    marker, dictionary = _edge(found["marker_size"], "tag"), _family(found["dictionary"])
    how = _yes(found, "legacy"), _yes(found, "inverted")
    return _made(value, lambda: Charuco(*squares, size, marker, dictionary, *how))


def _aprilgrid(value: YamlValue, found: dict[str, YamlValue]) -> Target:
    size = _edge(found["tag_size"], "tag")
    rows, cols = _counts(value, found, "rows", "cols", "tags")
    squares = found["squares"].boolean() if "squares" in found else True
    spacing, border = found["tag_spacing"].positive(), _border(found, AprilGrid.border_bits)
    first = found["first_id"].whole(0) if "first_id" in found else AprilGrid.first_id
    family = _family(found["family"]) if "family" in found else AprilGrid.family
    return _made(value, lambda: AprilGrid(rows, cols, size, spacing, border, squares, first, family))


def _markers(value: YamlValue, found: dict[str, YamlValue]) -> Target:
    family, size = _family(found["family"]), _edge(found["size"], "tag")
    ids = tuple(entry.whole(0) for entry in found["ids"].items()) if "ids" in found else ()
    if "ids" in found and not ids:
        found["ids"].fail("the list of ids is empty; list them, or remove ids to use all tags that are seen.")
    return _made(value, lambda: Markers(family, size, ids, _border(found, Markers.border_bits)))


def _family(value: YamlValue) -> str:
    try:
        return family_name(value.text())
    except RigError as error:
        value.fail(str(error))


def _yes(found: dict[str, YamlValue], name: str) -> bool:
    return found[name].boolean() if name in found else False


def _border(found: dict[str, YamlValue], default: int) -> int:
    return int(found["border_bits"].choice("width of border", ("1", "2"))) if "border_bits" in found else default


def _edge(value: YamlValue, what: str) -> float:
    if (size := value.positive()) > _LARGEST_TAG_M:
        value.fail(f"is in metres, and {size:g} m is too large for a {what}; write 0.088 for 88 mm.")
    return size


def _counts(value: YamlValue, found: dict[str, YamlValue], first: str, second: str, what: str) -> tuple[int, int]:
    a, b = found[first].whole(1), found[second].whole(1)
    if a * b > _MOST_TAGS:
        value.fail(f"{a} x {b} {what} exceed the limit of {_MOST_TAGS}; correct {first} and {second}.")
    return a, b


def _made(value: YamlValue, make: Callable[[], Target]) -> Target:
    try:
        return make()
    except RigError as error:
        value.fail(str(error))
