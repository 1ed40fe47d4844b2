"""A new kind of sensor is a folder: no other module names a kind, so that none has to change for a new one."""

from __future__ import annotations

import ast
from pathlib import Path

import icalib

SOURCE = Path(icalib.__file__).parent
KINDS = ("lidar", "wheels", "pose")
SHORT = {"lidars", "wheels"}  # shorthand of rigs, measurements, results and scenarios for all sensors of a kind
POSES = {"rig", "measurements", "m", "scenario", "asked", "shown", "one"}  # what is called so and has `poses`, too
# Exporters write the files of programs for certain sensors.
FREE = ("sensors/", "export/")


def kind_classes() -> set[str]:
    """Names of the public classes that folders of `KINDS` define."""
    files = (file for kind in KINDS for file in SOURCE.joinpath("sensors", kind).rglob("*.py"))
    trees = (ast.parse(file.read_text(encoding="utf-8")) for file in files)
    return {n.name for tree in trees for n in tree.body if isinstance(n, ast.ClassDef) and not n.name.startswith("_")}


CLASSES = kind_classes()


def named_kinds(source: str) -> set[str]:
    """What a module names of a kind: its folder in an import, a class of it, or the shorthand for its sensors."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            modules = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
            found |= {m for m in modules for kind in KINDS if f"{m}.".startswith(f"icalib.sensors.{kind}.")}
            found |= {alias.name for alias in node.names} & CLASSES
        elif isinstance(node, ast.Attribute):
            base = node.value
            owner = base.id if isinstance(base, ast.Name) else base.attr if isinstance(base, ast.Attribute) else ""
            if node.attr in SHORT or (node.attr == "poses" and owner in POSES):
                found.add(f"{owner}.{node.attr}")
        elif isinstance(node, ast.Name) and node.id in CLASSES:
            found.add(node.id)
    return found


def naming() -> dict[str, set[str]]:
    """What each module outside of `FREE` names."""
    files = {file.relative_to(SOURCE).as_posix(): file for file in sorted(SOURCE.rglob("*.py"))}
    own = {name: file for name, file in files.items() if not name.startswith(FREE)}
    found = {name: named_kinds(file.read_text(encoding="utf-8")) for name, file in own.items()}
    return {name: kinds for name, kinds in found.items() if kinds}


if __name__ == "__main__":
    for name, kinds in naming().items():
        print(name, *sorted(kinds))
