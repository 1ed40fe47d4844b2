"""Where intrinsics that the rig file fixes would go if they were free: whether they are those of this camera.

The other parameters make up for much of what is wrong with a lens: with the intrinsics of the other camera of a stereo
pair, 13 px apart, corners may fit to 0.4 px. What is fixed is no parameter of the estimate; one step of the solver from
its end, with the lens free, shows where it would go, and by how many standard deviations that is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.estimation.arrowhead import solve
from icalib.estimation.border import restricted_inverse
from icalib.estimation.estimate import Estimate
from icalib.estimation.inputs import Inputs, with_clouds
from icalib.estimation.state import Layout
from icalib.rig import Camera, Parameter

LENS = ("intrinsics", "distortion")


@dataclass(frozen=True)
class LensStep:
    """Of a camera's fx, fy, cx, cy [px] from what the rig file fixes: where they would go, and its formal standard
    deviation."""

    camera: str
    step: np.ndarray
    std: np.ndarray


def lens_steps(inputs: Inputs, found: Estimate) -> tuple[LensStep, ...]:
    """Of all cameras whose intrinsics are fixed; none where the data do not say where these would go."""
    fixed = [c for c in inputs.rig.cameras if c.intrinsics.mode == "fixed"]
    if not fixed or not found.outcome.converged:
        return ()
    rig = replace(inputs.rig, cameras=tuple(_freed(c) if c in fixed else c for c in inputs.rig.cameras))
    freed = with_clouds(replace(inputs, rig=rig), inputs.clouds)
    held = _held_in(freed.layout, inputs.layout, found.problem.held)
    try:
        problem = found.judged.problem(freed, found.outcome.state, held)
        pieces = problem.pieces()
        problem.linearise(found.outcome.state, pieces, problem.residuals(), curved=True)
        solution = solve(pieces, problem.n_nodes, problem.tolerance, held=held)
    except EstimationError:
        return ()
    t = problem.tolerance
    variance = np.diag(restricted_inverse(t[:, None] * solution.information * t, held)) * t**2
    columns = [freed.layout.columns(c.name, "intrinsics") for c in fixed]
    return tuple(
        LensStep(c.name, solution.border[k], np.sqrt(variance[k])) for c, k in zip(fixed, columns, strict=True)
    )


def _freed(camera: Camera) -> Camera:
    lens = {name: getattr(camera, name) for name in LENS}
    return replace(camera, **{k: Parameter("free", p.value) if p.mode == "fixed" else p for k, p in lens.items()})


def _held_in(layout: Layout, before: Layout, held: np.ndarray) -> np.ndarray:
    """Directions of the border `before` in that of `layout`, which has more columns."""
    if not held.size:
        return held
    out = np.zeros((layout.size, held.shape[1]))
    for block in before.free:
        out[layout.block(*block.key).columns] = held[block.columns]
    return out
