"""How the fuzzer changes a file: as bytes, as text, as arrays, or by a device in its place."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_TOKEN = re.compile(rb"[^\s,:{}\[\]\"'#<>=]+")
_NUMBER = re.compile(rb"[-+]?[0-9][0-9.]*(?:[eE][-+]?[0-9]+)?")
_VALUES = (
    b"",
    *b"0 -1 1 nan .nan inf -.inf 1e308 -1e308 1e-308 1e30 2147483648 -2147483649".split(),
    *b"9223372036854775807 9223372036854775808".split(),
    *(b"1" + b"0" * 30, b"1" + b"0" * 400, b"true", b"null", b"[]", b"{}", b"''", b"[1, 2, 3]", b"{a: 1}", b"text"),
    *(b'!!int ""', b"!!python/object/apply:os.abort []", b"&a [*a]", b"../../x", b"/x", b"..", b".", b"~", b"x" * 5000),
    *(b"\xff\xfe", b"a\0b", b"0x10", b"1_000", b"2020-01-01", b"\xf0\x9f\x98\x80"),
    *(b"[" * 3000, b"[" * 3000 + b"]" * 3000, b"{a: " * 2000, b"*nowhere", b"|", b"%", b"- -", b"? "),
)
_LAUGHS = b"a: &a [x,x,x,x,x,x,x,x,x]\n" + b"".join(
    b"%c: &%c [*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c]\n" % ((98 + i, 98 + i) + (97 + i,) * 9) for i in range(12)
)
_BOMB = b"%s\nz: [%s]\n" % (_LAUGHS, b",".join([b"*m"] * 9))
_DEVICES = ("/dev/zero", "/dev/null", "pipe")
_WORDS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)


@dataclass(frozen=True)
class Step:
    """One change of a file: in what form it was taken (bytes, text, arrays or device), and what was done."""

    form: str
    how: str

    @property
    def kind(self) -> str:
        return f"{self.form} {self.how.split()[0]}"


def mutated_bytes(content: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """What was done, and the content after it."""
    data, n = bytearray(content), max(len(content), 1)
    at = int(rng.integers(n))
    kind = str(rng.choice(["flip", "truncate", "zero", "word", "double", "insert", "cut", "empty", "random", "count"]))
    length = int(rng.integers(1, 1 + min(n, 4096)))
    if kind == "flip":
        for k in rng.integers(n, size=int(rng.integers(1, 20))):
            data[k : k + 1] = bytes([int(rng.integers(256))])
    elif kind == "truncate":
        del data[at:]
    elif kind == "zero":
        data[at : at + length] = bytes(min(length, len(data) - at))
    elif kind == "word":
        size = int(rng.choice([1, 2, 4, 8]))
        data[at : at + size] = (int(rng.choice(np.array(_WORDS, object))) % 256**size).to_bytes(size, "little")
    elif kind == "double":
        data[at:at] = data[at : at + length]
    elif kind == "insert":
        data[at:at] = rng.bytes(length)
    elif kind == "cut":
        del data[at : at + length]
    elif kind == "empty":
        data.clear()
    elif kind == "count":
        at = _change_count(data, rng)
    else:
        data[:] = rng.bytes(length)
    return f"{kind} at {at}", bytes(data)


def _change_count(data: bytearray, rng: np.random.Generator) -> int:
    """Replaces four bytes that may be a size, an offset or a count by a number that fits badly; returns their place."""
    for at in rng.integers(max(len(data) - 4, 1), size=100).tolist():
        value = int.from_bytes(data[at : at + 4], "little")
        if 0 < value <= len(data):
            others = (value - 1, value + 1, 2 * value, len(data), 2**31 - 1, 2**31, 2**32 - 1, 2**32 - value)
            data[at : at + 4] = int(rng.choice(np.array(others, object))).to_bytes(4, "little")
            return at
    return 0


def mutated_text(content: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """As `mutated_bytes`, for text: tokens, numbers and lines."""
    kind = str(
        rng.choice(
            ["token", "token", "number", "number", "line", "lines", "bytes", "indent", "laughs", "whole", "alias"]
        )
    )
    lines = content.split(b"\n")
    row = int(rng.integers(len(lines)))
    if kind in ("token", "number"):
        found = list((_TOKEN if kind == "token" else _NUMBER).finditer(content))
        if not found:
            return mutated_bytes(content, rng)
        match = found[int(rng.integers(len(found)))]
        value = _VALUES[int(rng.integers(len(_VALUES)))] if kind == "token" else _number(match[0], rng)
        return f"{kind} {match[0][:30]!r} -> {value[:30]!r}", content[: match.start()] + value + content[match.end() :]
    if kind == "line":
        lines[row : row + 1] = [[], [lines[row]] * 2, [lines[row]] * 300][int(rng.integers(3))]
    elif kind == "lines":
        other = int(rng.integers(len(lines)))
        lines[row], lines[other] = lines[other], lines[row]
    elif kind == "indent":
        lines[row] = (b"  " + lines[row], lines[row].lstrip(), b"\t" + lines[row])[int(rng.integers(3))]
    elif kind == "laughs":
        return kind, _LAUGHS + content if rng.random() < 0.5 else content + b"\n" + _LAUGHS
    elif kind == "alias":
        found = list(_TOKEN.finditer(content))
        match = found[int(rng.integers(len(found)))] if found else re.match(b"", content)
        assert match is not None
        return kind, _BOMB + content[: match.start()] + b"*m" + content[match.end() :]
    elif kind == "whole":
        value = _VALUES[int(rng.integers(len(_VALUES)))]
        return f"whole {value[:30]!r}", value
    else:
        return mutated_bytes(content, rng)
    return f"{kind} {row + 1}", b"\n".join(lines)


def _number(text: bytes, rng: np.random.Generator) -> bytes:
    """Another number: scaled, shifted, of the other sign."""
    scale = float(rng.choice([-1.0, 0.0, 1e3, 1e-3, 1e9, 1e15, 1e150, 1e300, 1.5, 1.0 + 1e-9]))
    value = float(text) * scale + float(rng.choice([0.0, 0.0, 1.0, 1e6]))
    whole = b"." not in text and b"e" not in text and abs(value) < 1e18
    return str(int(value)).encode() if whole else repr(value).encode()


def mutated_arrays(content: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """As `mutated_bytes`, for an npz: one array dropped, of another shape or kind, or with other values."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    name = str(rng.choice(sorted(arrays)))
    array = arrays.pop(name)
    kind = str(rng.choice(["drop", "flat", "short", "long", "axis", "float", "int", "text", "value", "values", "rows"]))
    bad = float(rng.choice([np.nan, np.inf, 1e308, -1e308, 1e30, -1.0, 0.0, 2.0**31, 2.0**63]))
    with np.errstate(all="ignore"):
        if kind == "flat":
            array = array.ravel()
        elif kind == "short":
            array = array[: len(array) // 2] if array.ndim else array
        elif kind == "long":
            array = np.concatenate([array, array]) if array.ndim else array
        elif kind == "axis":
            array = array[..., None]
        elif kind in ("float", "int", "text") and array.dtype.kind != "U":
            array = array.astype({"float": np.float64, "int": np.int64, "text": np.str_}[kind])
        elif kind in ("value", "values", "rows") and array.size and array.dtype.kind in "iuf":
            array = array.copy()
            flat = array.reshape(-1)
            at = slice(None) if kind == "values" else int(rng.integers(flat.size))
            flat[at] = np.array(bad).astype(array.dtype)
    if kind != "drop":
        arrays[name] = array
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return f"{kind} {name}", buffer.getvalue()


def mutated(path: Path, rng: np.random.Generator) -> tuple[list[Step], bytes]:
    """How the content of the file is changed, once or a few times, and the content after it."""
    content, steps = path.read_bytes(), list[Step]()
    if rng.random() < 0.02:
        return [Step("device", str(rng.choice(_DEVICES)))], b""
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        if path.suffix == ".npz" and rng.random() < 0.8 and not steps:
            form, (how, content) = "arrays", mutated_arrays(content, rng)
        elif path.suffix in (".yaml", ".csv", ".json", ".urdf", ".txt") and rng.random() < 0.85:
            form, (how, content) = "text", mutated_text(content, rng)
        else:
            form, (how, content) = "bytes", mutated_bytes(content, rng)
        steps.append(Step(form, how))
    return steps, content


def mutate(path: Path, rng: np.random.Generator) -> str:
    """Changes the file, and says how. Arrays of a result keep the hash that is beside them."""
    steps, content = mutated(path, rng)
    if steps[0].form == "device":
        path.unlink()
        if steps[0].how == "pipe":
            os.mkfifo(path)
        else:
            path.symlink_to(steps[0].how)
        return steps[0].how
    path.write_bytes(content)
    if path.name == "result.npz":
        plain = path.with_name("result.json")
        text = plain.read_text(encoding="utf-8")
        old = json.loads(text)["npz_sha256"]
        plain.write_text(text.replace(old, hashlib.sha256(content).hexdigest()), encoding="utf-8")
    return "; ".join(step.how for step in steps)
