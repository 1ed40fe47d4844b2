"""Identifiers of remarks, and the sentence of each, as sentences.yaml pins it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import yaml

from icalib.base.remark import Remark

FILE = Path(__file__).with_name("sentences.yaml")
ANY = r"(?s:.*?)"


def remark(sentence: str) -> Remark:
    """A remark with any sentence, as in a result of an earlier version."""
    return Remark("unknown", sentence)


def names(remarks: Iterable[Remark]) -> list[str]:
    """Identifiers of the remarks, in their order."""
    return [remark.name for remark in remarks]


def named(name: str, remarks: Iterable[Remark]) -> Remark:
    """The only remark with this identifier."""
    (found,) = (r for r in remarks if r.name == name)
    return found


@cache
def sentences() -> dict[str, tuple[str, ...]]:
    """Templates of the sentence of each identifier."""
    read = yaml.safe_load(FILE.read_text(encoding="utf-8"))
    return {name: (given,) if isinstance(given, str) else tuple(given) for name, given in read.items()}


@cache
def pattern(name: str) -> re.Pattern[str]:
    """Of the sentences of an identifier, also behind the name of a file or of a recording."""
    return re.compile(f"(?s:.*: )?(?:{'|'.join(map(_regex, sentences()[name]))})")


def _regex(template: str) -> str:
    """Of a template: `{}` is any text, `{a|b}` one of some texts, in which `...` is any text."""
    parts = re.split(r"\{((?:[^{}]*\|[^{}]*)?)\}", template)
    choices = ["|".join(map(_choice, part.split("|"))) if part else ANY for part in parts[1::2]]
    return "".join(f"{re.escape(text)}(?:{choice})" for text, choice in zip(parts[::2], [*choices, ""], strict=True))


def _choice(text: str) -> str:
    return ANY.join(map(re.escape, text.split("...")))


def is_pinned(name: str, sentence: str) -> bool:
    """Whether the sentence is one of those that sentences.yaml has for the identifier; any is for "unknown"."""
    return name == "unknown" or name in sentences() and pattern(name).fullmatch(sentence) is not None
