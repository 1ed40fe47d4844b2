"""A possible cause of a wrong result, as found by tests of any sensor."""

from __future__ import annotations

from dataclasses import dataclass

from icalib.optim.state import Key


@dataclass(frozen=True)
class Cause:
    """A possible cause. sentence: the fault, and what to do about it; gain: the decrease of chi^2 if it is modelled;
    grave: whether the result must not be used; explains: parameter groups whose stated values contradict the data for
    this cause, so that the contradiction needs no other sentence."""

    sentence: str
    gain: float
    grave: bool = False
    explains: tuple[Key, ...] = ()
