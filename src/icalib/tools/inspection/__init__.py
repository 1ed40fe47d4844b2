"""Inspection of a recording: its sensors, whether it can be calibrated, and a first draft of its rig file."""

from icalib.tools.inspection.draft import draft_rig, write_draft
from icalib.tools.inspection.facts import Finding, GivenTarget, Inspection
from icalib.tools.inspection.inspect import inspect_recording
from icalib.tools.inspection.targets import read_target

__all__ = ["Finding", "GivenTarget", "Inspection", "draft_rig", "inspect_recording", "read_target", "write_draft"]
