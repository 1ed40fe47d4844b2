"""Texts and tables of the report as HTML. Only this module escapes text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from icalib.result import Calibration, joint_covariance, relative_poses
from icalib.result.quantities import NEAR_LOCK, chi2_words, dof_words, format_number, rms_words, rpy_deg, table_rows
from icalib.result.verdict import UNUSABLE, Usability, worst
from icalib.sensors import call_all_kinds

TRUST: dict[Usability, str] = {
    "usable": "good",
    "usable with care": "care",
    "partly usable": "bad",
    "not usable": "wrong",
}


class Html(str):
    """Text that is already HTML, so that `html` does not escape it."""


def element(tag: str, content: object, css: str = "") -> Html:
    """<tag class=css>content</tag>; content is escaped unless it is Html."""
    attribute = f' class="{escape(css)}"' if css else ""
    return Html(f"<{tag}{attribute}>{html(content)}</{tag}>")


def html(content: object) -> Html:
    """`content` as HTML: unchanged if it is Html, its items joined if it is a list, otherwise escaped text."""
    if isinstance(content, Html):
        return content
    if isinstance(content, list):
        return Html("".join(html(part) for part in content))
    return Html(escape(str(content)))


def table(headers: Sequence[str], body: Iterable[Sequence[object]], numeric: Sequence[str] = ()) -> Html:
    """HTML table; columns named in `numeric` are right-aligned."""
    css = ["number" if h in numeric else "" for h in headers]
    head = element("tr", [element("th", h, c) for h, c in zip(headers, css, strict=True)])
    lines = [element("tr", [element("td", x, c) for x, c in zip(row, css, strict=True)]) for row in body]
    return element("div", element("table", [element("thead", head), element("tbody", lines)]), "scroll")


def sentences(items: Sequence[str], css: str, nothing: str) -> Html:
    """HTML list of sentences, or the paragraph `nothing` if there are none. css: class of the list."""
    if not items:
        return element("p", nothing, "quiet")
    return element("ul", [element("li", item) for item in items], css)


def reasons(c: Calibration) -> Html:
    """Numbered list of why the verdict is not `usable`, the most important reason first."""
    if not c.reasons:
        return element("p", "None: every check passed.", "quiet")
    grave = {c.failure, *c.wrong, *c.unobservable}
    items = [element("li", sentence, "bad" if sentence in grave else "care") for sentence in c.reasons]
    return element("ol", items, "reasons")


def badge(verdict: str) -> Html:
    """Coloured label of a verdict; empty without one."""
    return Html("") if not verdict else element("span", verdict, f"badge {'bad' if verdict in UNUSABLE else verdict}")


def trust(c: Calibration) -> str:
    """CSS class, in page.css, of the verdict on the result."""
    return TRUST[c.verdict]


def parameters(c: Calibration) -> Html:
    """Table of all parameters except poses of the target's rigid bodies; sensors come first."""
    headers = ("sensor", "parameter", "value", "std", "unit", "formal std", "factor", "verdict")
    body = [(r.sensor, r.name, r.value, r.std, r.unit, r.formal, r.factor, badge(r.verdict)) for r in table_rows(c)]
    return table(headers, body, ("value", "std", "formal std", "factor"))


def bodies(c: Calibration) -> Html:
    """Table of the poses of the target's rigid bodies; empty for a single body."""
    if not c.bodies:
        return Html("")
    sizes = ("x [mm]", "y [mm]", "z [mm]", "roll [deg]", "pitch [deg]", "yaw [deg]", "std [mm]", "std [deg]")
    body = [(name, *_body_row(c, name)) for name in c.bodies]
    title = element("h3", f"Target: bodies in the frame of {c.bodies[0]}, standard deviations the largest of three")
    return Html(title + table(("body", *sizes, "verdict"), body, sizes))


def _body_row(c: Calibration, body: str) -> list[object]:
    turn, move = c.group(body, "rotation"), c.group(body, "translation")
    angles, angle_std = rpy_deg(turn.value, joint_covariance(c, [turn]))
    values = [f"{1e3 * x:.2f}" for x in move.value] + [f"{x:.3f}" for x in angles]
    if turn.columns is None:
        return [*values, "", "", badge("fixed")]
    std = [format_number(1e3 * float(move.std.max())), format_number(float(angle_std.max()))]
    return [*values, *std, badge(worst((*turn.verdict, *move.verdict)))]


def poses(c: Calibration) -> Html:
    """T_body_sensor of each sensor as a 4x4 matrix, as text to copy."""
    names = c.mounted if c.body == c.reference else c.on_body
    return element("div", [_matrix(f"T_{c.body}_{name}", c.T_body_sensor(name)) for name in names], "matrices")


def _matrix(name: str, T: np.ndarray) -> Html:
    lines = "\n".join("[" + ", ".join(f"{x: .9f}" for x in row) + "]" for row in T)
    return element("figure", [element("figcaption", name), element("pre", lines)])


def relative(c: Calibration) -> Html:
    """Table and matrices of the relative poses of all pairs in `relative_poses`; empty if there are none."""
    pairs = relative_poses(c)
    if not pairs:
        return Html("")
    title = element("h3", "One sensor seen from another")
    words = element(
        "p",
        "Standard deviations come from the joint covariance of both sensors, empirical factors included. All of it is "
        "in calibration.yaml. T_a_b takes coordinates in the frame of b to that of a. Position: std along the axes "
        f"of a. {NEAR_LOCK} An unobservable component has the uncertainty of its initial guess.",
    )
    headers = ("", "distance [mm]", "x [mm]", "y [mm]", "z [mm]", "roll [deg]", "pitch [deg]", "yaw [deg]")
    body = []
    for r in pairs:
        angles, angle_std = rpy_deg(r.T[:3, :3], r.covariance[:3, :3])
        values = [1e3 * r.distance, *(1e3 * r.T[:3, 3]), *angles]
        std = [1e3 * r.distance_std, *(1e3 * r.std[3:]), *angle_std]
        body.append((r.name, *(f"{x:.3f} ± {format_number(s)}" for x, s in zip(values, std, strict=True))))
    matrices = element("div", [_matrix(r.name, r.T) for r in pairs], "matrices")
    return Html(title + words + table(headers, body, headers[1:]) + matrices)


def fits(c: Calibration) -> Html:
    """Table of the goodness of fit of each kind of measurement."""
    headers = ("sensor", "kind", "residuals", "post-fit dof", "chi2 / dof", "RMS", "rejected")
    body = [(f.sensor, f.kind, f.count, dof_words(f), chi2_words(f), rms_words(f), f.rejected or "") for f in c.fits]
    return table(headers, body, headers[2:])


def facts(c: Calibration) -> Html:
    """Tables of settings, versions, wall times, sensor rates and input files."""
    names = ("setting", "value")
    parts: list[object] = []
    for title, values in (
        ("Settings", c.settings),
        ("Versions", c.versions),
        ("Wall time [s]", {k: f"{v:.2f}" for k, v in c.timings.items()}),
        ("Rates [Hz]", {k: f"{v:.4g}" for k, v in c.rates.items()}),
    ):
        parts.append(element("section", [element("h3", title), table(names, values.items())]))
    files = table(("file", "sha256"), [(name, element("code", digest)) for name, digest in c.inputs.items()])
    return Html(element("div", parts, "grid") + element("h3", "Input files") + files)


def size_words(c: Calibration) -> str:
    """One line on the amount of data used: recordings, duration, measurements of each kind, keyframes."""
    duration = float(np.ptp(c.trajectory.seconds)) if len(c.trajectory.seconds) else 0.0
    several = f"{len(c.recordings)} recordings, " if len(c.recordings) > 1 else ""
    span = sum(r.end - r.start for r in c.recordings) if several else duration
    several += f"{span:.1f} s, " if c.rates else ""  # pictures have no clock
    return several + ", ".join([*call_all_kinds("show", "amounts", c), f"{len(c.trajectory.seconds)} keyframes"])
