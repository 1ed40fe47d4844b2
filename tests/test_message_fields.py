"""Fields that messages tell the user to write can be pasted into a rig file: the parser accepts field and value."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.cases import each
from tests.typed import instance

import icalib
from icalib.base.yaml_nodes import YamlValue, parse_yaml
from icalib.errors import RigError
from icalib.geometry.cameras import camera_model
from icalib.rig.file import target_of
from icalib.rig.rig import SENSOR_TYPES
from icalib.sensors.camera.assess.lenses import _named_model, _Trial
from icalib.sensors.camera.spec import Camera

SOURCE = Path(icalib.__file__).parent
OTHER_FILES = ("tools/simulation", "export", "report", "cli")  # these write or read other files, or are help texts
CAMERA = {"model": "pinhole-radtan", "resolution": [640, 480]}
ENTRIES: dict[str, list[dict[str, Any]]] = {
    **{kind: [{}] for kind in SENSOR_TYPES},
    "camera": [CAMERA],
    "wheels": [
        {},
        {"measures": "ticks", "counts_per_turn": 100},
        *({"measures": m} for m in ("angles", "twist", "poses")),
        *({"drive": d} for d in ("skid-steer", "ackermann")),
        {"ground": {"plane": "level", "tilt_noise": 0.01}},
    ],
}
TARGETS: list[dict[str, Any]] = [
    {"type": "aprilgrid", "rows": 6, "cols": 6, "tag_size": 0.1, "tag_spacing": 0.3},
    {"type": "charuco", "squares_x": 5, "squares_y": 7, "square_size": 0.04, "marker_size": 0.03,
     "dictionary": "5x5_100"},
    {"type": "checkerboard", "rows": 6, "cols": 7, "square_size": 0.04},
    {"type": "circles", "rows": 6, "cols": 7, "spacing": 0.04, "diameter": 0.02},
    {"type": "markers", "family": "tag36h11", "size": 0.1},
]  # fmt: skip
# What the expressions in f-strings stand for. An expression of a new message joins the list.
EXAMPLES = {
    "axes": "[-x, y, z]",
    "how": "xyz, degrees",
    "order": "wxyz",
    "length_unit": "mm",
    "'false' if sensor.inverted else 'true'": "true",
    "', '.join(axes)": "x, -z, y",
    "best.model.name": "eucm",
    "turned[0]": "7",
    "turned[1]": "6",
    "tags.ids.min()": "4",
    "_smallest(tags)": "tag25h9",
    "likely[0]": "time",
    "fitting[0]": "us",
    "high + 0.1": "0.9",
    "facts.unit": "us",
    "chosen": "snapshot",
    "unit": "rpm",
    "np.hypot(known, density)": "0.02",
    "fields": "gyro: 0.001, gyro_walk: 1e-05, accel: 0.01, accel_walk: 0.0001",
    "other": "angles",
    "advice": "rates",
    "sensor.accel_unit": "g",
    "target": "{type: circles, rows: 6, cols: 7, spacing: 0.04, diameter: 0.02}",
    "excess(f) * getattr(wheels, field)": "0.1",
    "', '.join((side.upper() for side in sides))": "LEFT, RIGHT",
    "json.dumps(facts.field)": "time",
    "json.dumps(topic)": "/odom",
    "json.dumps(frames)": "[map, base_link]",
    "kind": "absolute",
    "class_of_noise(noise)": "tactical",
    "DEFAULT_CLASS": "consumer",
    "rows": "6",
    "cols": "7",
    "spacing": "0.04",
    "resolution[0]": "640",
    "resolution[1]": "480",
    "lens.model": "eucm",
    "name_text(camera.tracks.name)": "images",
    "numbers(lens.intrinsics)": "[400, 400, 320, 240]",
    "numbers(lens.distortion)": "[0, 0, 0, 0]",
    "values": "gyro: 0.001, gyro_walk: 1e-05, accel: 0.01, accel_walk: 0.0001",
    "source": "kalibr",
    "wider": "1000",
    "e.prior_sigma": "50",
    "s.rolling": "rows",
    "'relative' if _drifts(topic) and (not leads) else 'absolute'": "relative",
}
# Words that the user replaces by names, numbers or a list.
FILLED_IN = {
    "[...]": "[1, 2]",
    "[fx, fy, cx, cy]": "[400, 400, 320, 240]",
    "{type: markers, ...}": "{type: markers, family: tag36h11, size: 0.1}",
}
VALUE = r"(?:\[(?:«[^»]*»|[^\]«])*\]|\{(?:«[^»]*»|[^{}«])*\}|«[^»]*»|[\w/^-]+(?:\.\w+)?)"
WRITTEN = re.compile(rf"\b([a-z_]+): ({VALUE})")
SET = re.compile(
    rf"\b[Ss]et (?:its |the )?`?([a-z_]+)`?(?: of (?:«[^»]*»|{{}}|\w+))? to ({VALUE}(?: or (?:to )?\[[^\]]*\])?)"
)
PROSE = {"they", "set", "write", "errors", "t_", "east"}  # words after a colon that are no value


def texts(path: Path) -> Iterator[str]:
    """Texts of a module with at least two words, without docstrings; expressions stand in «»."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    inner: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr):
            inner.add(id(node.value))
        if isinstance(node, ast.JoinedStr):
            inner |= {id(part) for part in ast.walk(node) if part is not node}
    for node in ast.walk(tree):
        if id(node) in inner:
            continue
        if isinstance(node, ast.JoinedStr):
            yield "".join(_part(value) for value in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.value


def _part(value: ast.expr) -> str:
    if isinstance(value, ast.FormattedValue):
        return f"«{ast.unparse(value.value)}»"
    return str(instance(value, ast.Constant).value)


def fields_of(kind: str) -> set[str]:
    """All fields that the parser knows of a kind of sensor, those of its inner mappings included."""
    names: set[str] = set()
    with pytest.MonkeyPatch.context() as patch:
        known = YamlValue.record

        def record(self: YamlValue, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, YamlValue]:
            names.update(required + optional)
            return known(self, required, optional)

        patch.setattr(YamlValue, "record", record)
        for entry in ENTRIES[kind]:
            assert _sensor(kind, entry) == "", entry
    return names


def _sensor(kind: str, entry: dict[str, Any]) -> str:
    """What the parser says against this entry; empty if it accepts it."""
    text = yaml.safe_dump({"type": kind, **entry}, sort_keys=False)
    try:
        SENSOR_TYPES[kind].parse("s0", parse_yaml(text, "rig.yaml"))
    except RigError as error:
        return str(error)
    return ""


def _target(entry: dict[str, Any]) -> str:
    try:
        target_of(parse_yaml(yaml.safe_dump(entry), "rig.yaml"))
    except RigError as error:
        return str(error)
    return ""


def complaints(kinds: list[str], field: str, value: Any) -> list[str]:
    """What each kind, or each target, says against `field` with `value`; empty if one of them accepts it."""
    entries = [(kind, entry) for kind in kinds for entry in ENTRIES[kind]]
    said = [_sensor(kind, _inside(entry, field, value)) for kind, entry in entries]
    said += [_target({**entry, field: value}) for entry in TARGETS if field in TARGET_FIELDS]
    return [] if "" in said else said


def _inside(entry: dict[str, Any], field: str, value: Any) -> dict[str, Any]:
    if field in ("plane", "tilt_noise"):
        return {**entry, "ground": {"plane": "level", "tilt_noise": 0.01, field: value}}
    return {**entry, field: value}


FIELDS = {kind: fields_of(kind) | ({"plane", "tilt_noise"} if kind == "wheels" else set()) for kind in SENSOR_TYPES}
TARGET_FIELDS = {name for entry in TARGETS for name in entry} - {"type"} | {"inverted", "legacy", "first_id"}
PARTS_OF_VALUES = {"gyro", "accel", "source", "guess", "sigma", "type", "prior", "fixed"}  # no fields of their own


def advice() -> list[tuple[str, str, str]]:
    """(module, field, value) of each field with a value that a message or a draft names."""
    found = []
    for path in sorted(SOURCE.rglob("*.py")):
        module = path.relative_to(SOURCE).as_posix()
        if module.startswith(OTHER_FILES):
            continue
        for text in texts(path):
            for field, value in [*WRITTEN.findall(text), *SET.findall(text)]:
                if field in TARGET_FIELDS.union(*FIELDS.values()) - PARTS_OF_VALUES and value not in PROSE:
                    found += [(module, field, one) for one in re.split(r" or (?:to )?", value)]
    return found


def _read(value: str) -> Any:
    for words, example in FILLED_IN.items():
        value = value.replace(words, example)
    return yaml.safe_load(re.sub(r"«([^»]*)»", lambda m: EXAMPLES[m[1]], value))


@each(("module", "field", "value"), advice())
def test_a_field_that_a_message_names_is_accepted(module: str, field: str, value: str):
    kinds = [kind for kind in SENSOR_TYPES if field in FIELDS[kind]]
    own = [kind for kind in kinds if module.startswith(f"sensors/{kind}/")]
    assert not complaints(own or kinds, field, _read(value)), f"{module}: {field}: {value}"


def test_signs_for_each_drive_are_named():
    """A skid-steer drive has four signs, where others have two."""
    entries = [{"drive": drive} for drive in ("differential", "skid-steer", "ackermann")]
    module = "sensors/wheels/initialize/drive_guess.py"
    source = " ".join(texts(SOURCE / module))
    signs = {one for one in re.findall(r"\[[-1, ]+\]", source)}
    for entry in entries:
        assert any(not _sensor("wheels", {**entry, "signs": yaml.safe_load(one)}) for one in signs), entry


@pytest.mark.parametrize(("given", "rest"), [(False, "."), (True, ", and remove intrinsics, of pinhole-radtan.")])
def test_another_camera_model_does_not_keep_the_numbers_of_the_old_one(
    given: bool, rest: str, monkeypatch: pytest.MonkeyPatch
):
    fields = {**CAMERA, **({"intrinsics": {"guess": [400, 400, 320, 240]}} if given else {})}
    camera = Camera.parse("cam0", parse_yaml(yaml.safe_dump({"type": "camera", **fields}), "rig.yaml"))
    monkeypatch.setattr(_Trial, "rms", 0.2)
    no_fit: Any = None
    old, new = (_Trial(camera_model(name), no_fit, no_fit) for name in ("pinhole-radtan", "eucm"))
    assert _named_model("", old, new, camera).endswith(f"write `model: eucm`{rest}")
