"""What is in a recording, whether it can be calibrated, and a first draft of its rig file."""

from icalib.inspection.draft import draft_rig, write_draft
from icalib.inspection.facts import Finding, GivenTarget, Inspection
from icalib.inspection.inspect import inspect_recording
from icalib.inspection.targets import read_target

__all__ = ["Finding", "GivenTarget", "Inspection", "draft_rig", "inspect_recording", "read_target", "write_draft"]
