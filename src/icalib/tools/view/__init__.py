"""A 3D view of a result, and of the recording that it is of, in Rerun."""

from icalib.tools.view.show import view

__all__ = ["view"]
