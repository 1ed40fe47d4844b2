"""The command line."""

from icalib.cli.commands import main

__all__ = ["main"]
