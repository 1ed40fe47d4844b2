"""Sentences of a result that have an identifier."""

from __future__ import annotations


class Remark(str):
    """A sentence for users of a result: a reason, cause, note or warning. It is a `str` with an identifier.

    name: the identifier, such as "clock_drifts", by which programs and tests know it; docs/reasons.md lists them all.
    """

    __slots__ = ("name",)
    name: str

    def __new__(cls, name: str, sentence: str) -> Remark:
        remark = super().__new__(cls, sentence)
        remark.name = name
        return remark

    def __getnewargs__(self) -> tuple[str, str]:  # type: ignore[override]
        return self.name, str(self)

    def with_sentence(self, sentence: str) -> Remark:
        """The remark with another sentence, as concatenation gives a plain `str`."""
        return Remark(self.name, sentence)
