"""Parses targets of a rig file: the field `target`, or several by name in the field `targets`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from icalib.base.files import NAME, NAME_WORDS
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
    fields = root.entries()
    if "target" not in fields and "targets" not in fields:
        root.fail("target is missing; add target, or targets for several by name.")
    if "targets" not in fields:
        return target_of(fields["target"])
    if "target" in fields:
        fields["targets"].fail("conflicts with target; put all targets under targets.")
    named = fields["targets"].entries()
    for name, value in named.items():
        if not NAME.fullmatch(name):
            value.fail(f"a target's name is {NAME_WORDS}, as in wall; rename it.")
    if not named:
        fields["targets"].fail("there is no target; add one, as in wall: {type: markers, ...}.")
    targets = tuple(target_of(value) for value in named.values())
    return targets[0] if len(targets) == 1 else _checked_target(fields["targets"], lambda: Scene(tuple(named), targets))


def target_of(value: YamlValue) -> Target:
    """One target from the mapping of its fields. Raises RigError as `target_or_targets`."""
    entries = value.entries()
    if "type" not in entries:
        value.fail(f"type is missing; add type: {', type: '.join(_FIELDS)}.")
    kind = entries["type"].choice("target type", tuple(_FIELDS))
    required, optional = _FIELDS[kind]
    fields = value.record(("type", *required), (*optional, "size_sigma"))
    target = _of_kind(kind, value, fields)
    return replace(target, size_sigma=_size_sigma(fields["size_sigma"])) if "size_sigma" in fields else target


def _size_sigma(value: YamlValue) -> float:
    if not 0.0 <= (sigma := value.number()) < _LARGEST_SIGMA:
        value.fail(
            f"is a share of the size between 0 (exact) and {_LARGEST_SIGMA}, but is {sigma:g}; write 0.002 for 0.2 %."
        )
    return sigma


def _of_kind(kind: str, value: YamlValue, fields: dict[str, YamlValue]) -> Target:
    if kind == "aprilgrid":
        return _aprilgrid(value, fields)
    if kind == "markers":
        return _markers(value, fields)
    if kind == "circles":
        counts, spacing = _counts(value, fields, "rows", "cols", "circles"), _edge(fields["spacing"], "spacing")
        diameter = _edge(fields["diameter"], "circle")
        return _checked_target(value, lambda: Circles(*counts, spacing, diameter, _yes(fields, "asymmetric")))
    size = _edge(fields["square_size"], "square")
    if kind == "checkerboard":
        rows, cols = _counts(value, fields, "rows", "cols", "corners")
        return _checked_target(
            value, lambda: Checkerboard(rows, cols, size, _yes(fields, "inverted"), _yes(fields, "upright"))
        )
    squares = _counts(value, fields, "squares_x", "squares_y", "squares")
    marker, dictionary = _edge(fields["marker_size"], "tag"), _family(fields["dictionary"])
    how = _yes(fields, "legacy"), _yes(fields, "inverted")
    return _checked_target(value, lambda: Charuco(*squares, size, marker, dictionary, *how))


def _aprilgrid(value: YamlValue, fields: dict[str, YamlValue]) -> Target:
    size = _edge(fields["tag_size"], "tag")
    rows, cols = _counts(value, fields, "rows", "cols", "tags")
    squares = fields["squares"].boolean() if "squares" in fields else True
    spacing, border = fields["tag_spacing"].positive(), _border(fields, AprilGrid.border_bits)
    first = fields["first_id"].whole(0) if "first_id" in fields else AprilGrid.first_id
    family = _family(fields["family"]) if "family" in fields else AprilGrid.family
    return _checked_target(value, lambda: AprilGrid(rows, cols, size, spacing, border, squares, first, family))


def _markers(value: YamlValue, fields: dict[str, YamlValue]) -> Target:
    family, size = _family(fields["family"]), _edge(fields["size"], "tag")
    ids = tuple(entry.whole(0) for entry in fields["ids"].items()) if "ids" in fields else ()
    if "ids" in fields and not ids:
        fields["ids"].fail("the list of ids is empty; list them, or remove ids to use all tags that are seen.")
    return _checked_target(value, lambda: Markers(family, size, ids, _border(fields, Markers.border_bits)))


def _family(value: YamlValue) -> str:
    try:
        return family_name(value.text())
    except RigError as error:
        value.fail(str(error))


def _yes(fields: dict[str, YamlValue], name: str) -> bool:
    return fields[name].boolean() if name in fields else False


def _border(fields: dict[str, YamlValue], default: int) -> int:
    return int(fields["border_bits"].choice("width of border", ("1", "2"))) if "border_bits" in fields else default


def _edge(value: YamlValue, noun: str) -> float:
    if (size := value.positive()) > _LARGEST_TAG_M:
        value.fail(f"is in metres, and {size:g} m is too large for a {noun}; write 0.088 for 88 mm.")
    return size


def _counts(value: YamlValue, fields: dict[str, YamlValue], first: str, second: str, noun: str) -> tuple[int, int]:
    a, b = fields[first].whole(1), fields[second].whole(1)
    if a * b > _MOST_TAGS:
        value.fail(f"{a} x {b} {noun} exceed the limit of {_MOST_TAGS}; correct {first} and {second}.")
    return a, b


def _checked_target(value: YamlValue, make: Callable[[], Target]) -> Target:
    try:
        return make()
    except RigError as error:
        value.fail(str(error))
