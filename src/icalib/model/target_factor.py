"""What a factor of points on the target has in common with others, whichever sensor sees them."""

from __future__ import annotations

from typing import Protocol, Self, runtime_checkable

from icalib.model.bodies import Bodies
from icalib.motion.factor import Factor


@runtime_checkable
class TargetFactor(Factor, Protocol):
    """A factor of points on `bodies` of the target. sees_target: whether it has any such point."""

    @property
    def bodies(self) -> Bodies: ...

    @property
    def sees_target(self) -> bool: ...

    def with_target_size(self, size: float) -> Self:
        """The same measurements, of a target with `size` times the stated lengths."""
        ...
