"""What a test knows of a value, told to the type checker; a test that is wrong about it fails."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from typing import Any as StandIn
else:

    class StandIn:
        """Has only what a test needs of another class, and may be passed for it."""


T = TypeVar("T")


def not_none(value: T | None) -> T:
    """`value`, which is not None."""
    assert value is not None
    return value


def instance(value: object, kind: type[T]) -> T:
    """`value`, which is a `kind`."""
    assert isinstance(value, kind), type(value)
    return value


def random_rotations(count: int | None, seed: int) -> Rotation:
    """`count` rotations, or a single one, the same ones with every version of scipy."""
    return Rotation.random(count, random_state=seed)  # pyright: ignore[reportCallIssue]: `rng` since scipy 1.15
