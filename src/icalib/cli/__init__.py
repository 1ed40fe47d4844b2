"""The command line program `icalib`."""

from icalib.cli.commands import main

__all__ = ["main"]
