"""YAML values with their file, line and field, so that each error message can give them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from math import inf
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import yaml

from icalib.base.files import regular
from icalib.errors import RigError

LARGEST_INTEGER = 2**63 - 1  # largest int64, the type of timestamps
_MOST = 1 << 20  # characters of a file, and values with all aliases written out; a value takes some 1000 bytes
LARGEST = 1e20  # largest absolute number; small enough that its powers in later computations are finite
_INTEGER = re.compile(r"[-+]?[0-9]{1,19}")

# Former names of fields, for the error that names the new one.
RENAMED = {
    "far": "max_range",
    "keep_corners": "cache_corners",
    "lasting": "persistent",
    "meaning": "sampling",
    "near": "min_range",
    "node_spacing_s": "keyframe_spacing_s",
    "nodes": "keyframes",
    "sideways_slip": "lateral_slip",
    "splits": "segments",
    "upwards_slip": "vertical_slip",
}


@dataclass(frozen=True)
class YamlValue:
    """One value of a YAML file. field: path of its keys, such as "sensors.cam0.model"; "" is the whole file.

    Methods that convert the value raise RigError if it has another type or is out of range.
    """

    node: yaml.Node
    file: str
    field: str

    def fail(self, sentence: str) -> NoReturn:
        """Raises RigError: file, line and field, then `sentence`, which says what is wrong and what to do."""
        place = f"{self.file}:{self.node.start_mark.line + 1}"
        raise RigError(f"{place}: {self.field}: {sentence}" if self.field else f"{place}: {sentence}")

    @property
    def is_mapping(self) -> bool:
        return isinstance(self.node, yaml.MappingNode)

    @property
    def is_list(self) -> bool:
        return isinstance(self.node, yaml.SequenceNode)

    def summary(self) -> str:
        """The value for a message: its text up to 40 characters, "a mapping", "a list" or "empty"."""
        if not isinstance(self.node, yaml.ScalarNode):
            return "a mapping" if self.is_mapping else "a list"
        if self.node.tag == "tag:yaml.org,2002:null":
            return "empty"
        text = str(self.node.value)
        return repr(text if len(text) <= 40 else text[:40] + "...")

    def entries(self) -> dict[str, YamlValue]:
        """Values of the mapping by key. Raises RigError if it is not a mapping, or has a key twice."""
        if not isinstance(self.node, yaml.MappingNode):
            self.fail(f"must be a mapping (name: value), but is {self.summary()}.")
        entries: dict[str, YamlValue] = {}
        for key, node in self.node.value:
            at = YamlValue(key, self.file, self.field)
            if not isinstance(key, yaml.ScalarNode):
                at.fail("a name must be plain text; remove the brackets or braces.")
            name = str(key.value)
            if name in entries:
                at.fail(f"{name!r} is given twice, first in line {entries[name].node.start_mark.line + 1}; remove one.")
            entries[name] = YamlValue(node, self.file, f"{self.field}.{name}" if self.field else name)
        return entries

    def record(self, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, YamlValue]:
        """Values of the mapping by key. Raises RigError for a missing `required` key, and for keys in neither list."""
        entries, valid = self.entries(), required + optional
        for name, value in entries.items():
            if name not in valid and RENAMED.get(name) in valid:
                value.fail(f"this field is now called {RENAMED[name]}; rename it{_new_values(name)}.")
            if name not in valid:
                value.fail(f"there is no such field{suggestion(name, valid)}; available are {', '.join(valid)}.")
        missing = [name for name in required if name not in entries]
        if missing:
            self.fail(f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing; add {missing[0]}.")
        return entries

    def text(self) -> str:
        if not isinstance(self.node, yaml.ScalarNode) or not str(self.node.value).strip():
            self.fail(f"must be text, but is {self.summary()}.")
        if "\0" in self.node.value:
            self.fail(f"must be text without zero bytes, but is {self.summary()}.")
        return str(self.node.value)

    def choice(self, noun: str, available: tuple[str, ...]) -> str:
        """The text, one of `available`. noun: noun for the error message."""
        text = self.text()
        if text not in available:
            self.fail(
                f"there is no {noun} {self.summary()}{suggestion(text, available)}; "
                f"available are {', '.join(available)}."
            )
        return text

    def boolean(self) -> bool:
        if not isinstance(self.node, yaml.ScalarNode) or self.node.tag != "tag:yaml.org,2002:bool":
            self.fail(f"must be true or false, but is {self.summary()}.")
        return str(self.node.value).lower() in ("true", "yes", "on")

    def number(self) -> float:
        """A finite number. Python parses it, since YAML 1.1 takes 2e-5 (no decimal point) for text."""
        plain = isinstance(self.node, yaml.ScalarNode) and self.node.style is None
        text = str(self.node.value) if plain else ""
        if text.lower().lstrip("+-") in (".nan", ".inf", "nan", "inf", "infinity"):
            self.fail(f"must be a finite number, but is {self.summary()}.")
        try:
            value = float(text)
        except ValueError:
            self.fail(f"must be a number, but is {self.summary()}.")
        if not abs(value) < LARGEST:
            self.fail(f"is too large a number ({self.summary()}).")
        return value

    def positive(self) -> float:
        value = self.number()
        if value <= 0:
            self.fail(f"must be above 0, but is {value:g}.")
        return value

    def not_negative(self) -> float:
        value = self.number()
        if value < 0:
            self.fail(f"must be 0 or above, but is {value:g}.")
        return value

    def whole(self, least: int) -> int:
        """An integer from `least` to 2^63 - 1."""
        self.number()
        text = str(self.node.value)
        if not _INTEGER.fullmatch(text) or int(text) < least:
            self.fail(f"must be a whole number of at least {least}, but is {self.summary()}.")
        if int(text) > LARGEST_INTEGER:
            self.fail(f"must be a whole number below 2^63, but is {self.summary()}.")
        return int(text)

    def items(self) -> list[YamlValue]:
        """Values of the list; the field of each ends in [i], counted from 0."""
        if not isinstance(self.node, yaml.SequenceNode):
            self.fail(f"must be a list in brackets, but is {self.summary()}.")
        return [YamlValue(node, self.file, f"{self.field}[{i}]") for i, node in enumerate(self.node.value)]

    def vector(self, size: int) -> np.ndarray:
        """(size,) float64, from a list of numbers. If size is 1, a number without a list is allowed."""
        if size == 1 and not self.is_list:
            return np.array([self.number()])
        numbers = self.items()
        if len(numbers) != size:
            self.fail(f"must be a list of {size} numbers, but has {len(numbers)}.")
        return np.array([item.number() for item in numbers])


def read_yaml(path: Path, kind: str = "rig file") -> YamlValue:
    """Root value of the YAML file at `path`, parsed without running its tags. kind: noun for the file in messages.

    Raises RigError if the file does not exist, cannot be read, is too large, is not YAML or is empty.
    """
    try:
        with regular(path).open(encoding="utf-8-sig") as file:
            text = file.read(_MOST + 1)
    except FileNotFoundError:
        raise RigError(f"{path} does not exist; check the path of the {kind}.") from None
    except OSError as error:
        raise RigError(f"{path} cannot be read ({error.strerror or error}); give the path of a {kind}.") from error
    except UnicodeDecodeError as error:
        raise RigError(f"{path} is not a text file in UTF-8 ({error.reason}); give a YAML file.") from error
    if len(text) > _MOST:
        raise RigError(f"{path} is larger than {_MOST >> 20} MiB; give the path of a {kind}.")
    return parse_yaml(text, str(path), kind)


def parse_yaml(text: str, path: str, kind: str = "rig file") -> YamlValue:
    """Root value of the YAML `text`, parsed without running its tags. path, kind: its name and a noun, for messages.

    Raises RigError if the text is not YAML or is empty, or its aliases stand for too many values.
    """
    try:
        # OpenCV writes `%YAML:1.0` in the first line, which is not a valid YAML directive.
        root = yaml.compose(re.sub(r"\A%YAML:1\.0", "#", text), Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{path}:{mark.line + 1}" if mark else str(path)
        raise RigError(
            f"{place}: this is not valid YAML ({error.problem or error.context}); correct the line."
        ) from error
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise RigError(f"{path} is not valid YAML ({_reason(error)}); correct it.") from error
    if root is None:
        raise RigError(f"{path} is empty; give a {kind}.")
    if _written_out(root, {}) > _MOST:
        raise RigError(f"{path}: its aliases (*name) stand for more than {_MOST} values; write them out.")
    return YamlValue(root, path, "")


def _written_out(value: Any, counts: dict[int, float]) -> float:
    """Number of values in `value` with its aliases written out, infinite if one contains itself. counts: by id, as far
    as known."""
    if id(value) not in counts:
        counts[id(value)] = inf
        parts = chain.from_iterable(value.value) if isinstance(value, yaml.MappingNode) else value.value
        counts[id(value)] = 1 + sum(_written_out(p, counts) for p in parts if isinstance(p, yaml.Node))
    return counts[id(value)]


def _reason(error: Exception) -> str:
    return next(iter(str(error).splitlines()), "") or type(error).__name__


def _new_values(former: str) -> str:
    """Advice on renamed values of a renamed field, for its error message; mostly empty."""
    return ", and write interval-mean for mean, instantaneous for instant" if former == "meaning" else ""


# Suggestion of a similar valid name for a misspelt one.

ALIKE = 0.6  # least similarity of two names by difflib, 0 to 1; lower values suggest less similar names


def suggestion(name: str, valid: Iterable[str]) -> str:
    """End of a message: ", did you mean 'x'", x being the most similar valid name regardless of case; empty if none."""
    by_lower = {v.lower(): v for v in valid}
    near = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=ALIKE)
    return f", did you mean {by_lower[near[0]]!r}" if near else ""
