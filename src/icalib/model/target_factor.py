"""Interface of factors with points on the target, for any sensor."""

from __future__ import annotations

from typing import Protocol, Self, runtime_checkable

from icalib.model.bodies import Bodies
from icalib.motion.factor import Factor


@runtime_checkable
class TargetFactor(Factor, Protocol):
    """A factor with points on `bodies` of the target. sees_target: whether it has any such point."""

    @property
    def bodies(self) -> Bodies: ...

    @property
    def sees_target(self) -> bool: ...

    def with_target_size(self, size: float) -> Self:
        """The same measurements, for a target with `size` times the stated lengths."""
        ...
