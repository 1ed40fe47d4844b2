"""What is said of the size of the target, which the rig file gives and the accelerometer feels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.estimate import Estimate
from icalib.estimate.evidence.target_size import TargetSize, target_size
from icalib.estimate.problem.inputs import Inputs

WRONG = 0.02  # of the size: more than a ruler or a good accelerometer is off by
BEYOND = 0.05  # accelerometers are off by 3 % at most
CLEARLY = 5.0  # standard deviations


def felt_size(found: Estimate, factor: float) -> TargetSize | None:
    """Of the target, its standard deviation `factor` times the formal one; None where nothing shows it, or the solver
    did not converge."""
    if not found.outcome.converged:
        return None
    try:
        size = target_size(found.problem, found.outcome.state)
    except EstimationError:  # the way to another size leads off the map
        return None
    return None if size is None else TargetSize(size.ratio, factor * size.std)


def is_certain(size: TargetSize | None) -> bool:
    """Whether no accelerometer could be as wrong as the size that it shows."""
    return size is not None and abs(size.ratio - 1.0) > max(BEYOND, CLEARLY * size.std)


def size_words(inputs: Inputs, size: TargetSize | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What to warn of, and what to note."""
    if size is None:
        return (), ()
    rig, digits = inputs.rig, max(2, 1 - int(np.floor(np.log10(size.std))))
    ratio = f"{size.ratio:.{digits}f} +- {size.std:.{digits}f}"
    others = rig.lidars or rig.wheels or rig.poses or any(c.translation.mode != "free" for c in rig.cameras)
    by = "the accelerometer" + (" and what else shows it" if others else "")
    words = f"by {by} the target is {ratio} times the size that the rig file says"
    if abs(size.ratio - 1.0) <= max(WRONG, CLEARLY * size.std):
        return (), (f"{words}; accelerometers may be off by 1 to 3 % themselves.",)
    warning = (
        f"{words}, and so are the distances that cameras show; measure the printed target and correct its size in "
        "the rig file, or if that is right calibrate the accelerometer, whose scale is off."
    )
    return (warning,), ()


def scale_notes(inputs: Inputs, size: TargetSize | None) -> Iterator[str]:
    """What all lengths rest on, where that is one thing only."""
    rig, source = inputs.rig, None
    seeing = [c.name for c in rig.cameras]
    if rig.has_target and seeing and size is None and not (rig.lidars or rig.wheels or rig.poses):
        source = "the size of the target in the rig file"
    elif not rig.has_target and rig.assumes_motion and not rig.lidars and (rig.poses or rig.wheels):
        source = f"the positions of {rig.poses[0].name}" if rig.poses else f"the wheel sizes of {rig.wheels[0].name}"
    if source is not None:
        yield f"every length comes from {source} alone: 1 % error there is 1 % in every translation here."
