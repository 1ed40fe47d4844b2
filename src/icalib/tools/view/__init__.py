"""A 3D view of a result and its recording in Rerun."""

from icalib.tools.view.show import view

__all__ = ["view"]
