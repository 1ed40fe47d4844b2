"""The report: well formed, whole, escaped, without network, small; and drawn by a browser where there is one."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console
from scipy.spatial.transform import Rotation
from tests.pages import figures_of
from tests.remarks import remark
from tests.report.test_pictures import with_images

from icalib.export.formats import check_folder, write_outputs
from icalib.report import report_html
from icalib.report.console import legend, lens_words, relative_words, shown_rows, table
from icalib.report.figures import numbers, thin
from icalib.report.page import extrinsics, sensor_cards
from icalib.result import (
    Calibration,
    ProjectionMap,
    SensorFit,
    by_key,
    joint_covariance,
    projection_uncertainty,
    working_distance,
)
from icalib.result.quantities import TURNS, chi2_words, dof_words, excess, format_number, largest_dof, rows, rpy_deg
from icalib.result.saving import calibration_yaml
from icalib.sensors.camera import show

VOID = {"meta", "link", "br", "img", "hr"}
FIGURES = {"rig", "histogram", "imu-residuals", "trajectory", "motion", "convergence", "correlation", "held-out"} | {
    f"{kind}-{i}" for kind in ("plane", "image", "time", "projection-0", "projection-1") for i in (0, 1)
}
NASTY = '</script><script>alert("1 & 2")</script>'


class Page(HTMLParser):
    """Collects ids, attributes and text; fails where tags do not close in order."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.sections: list[str] = []
        self.scripts: list[str] = []
        self.words = ""
        self.source = text
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.ids += [v for k, v in attrs if k == "id" and v]
        self.sections += [v for k, v in attrs if tag == "section" and k == "id" and v]
        self.links += [v for k, v in attrs if k in ("src", "href") and v]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += data
        elif self.open and self.open[-1] != "style":
            self.words += data


@pytest.fixture(scope="module")
def text(calibration: Calibration) -> str:
    return report_html(calibration)


def test_every_figure_has_its_place_and_data(text: str):
    page = Page(text)
    figures = figures_of(page.source)
    assert set(figures) == FIGURES
    assert set(page.ids) >= FIGURES
    assert len(page.ids) == len(set(page.ids))
    assert all(f["data"] and f["layout"] for f in figures.values())


def test_small_and_offline(text: str):
    assert len(text.encode()) < 3e6
    page = Page(text)
    contents = [link for link in page.links if link != "data:,"]
    assert {link[1:] for link in contents} == set(page.sections) and {link[0] for link in contents} == {"#"}
    assert "http" not in text


def test_trust_comes_first(text: str):
    page = Page(text)
    assert page.ids[0] == "trust"
    top = text.split('<section id="geometry">')[0]
    for words in ("Partly usable", "turn the rig about a second axis", "Reasons", "roll", "rotation x", "deg"):
        assert words in top
    rows = dict(re.findall(r'<td>(translation .)</td>.*?badge \w+">([\w ]+)<', text))
    assert rows == {"translation x": "determined", "translation y": "unobservable", "translation z": "weak"}


def test_a_long_recording_stays_small(calibration: Calibration):
    r = calibration.corner_residuals[0]
    n = 40
    start = np.concatenate([[0], np.cumsum(np.tile(np.diff(r.start), n))])
    long = {
        name: np.concatenate([getattr(r, name)] * n)
        for name in ("seconds", "point", "uv", "residual", "sigma", "rejected")
    }
    figure = show.residuals_over_time(dataclasses.replace(r, start=start, **long))
    assert all(len(trace["x"]) <= show.MOST_DOTS for trace in figure["data"])
    assert len(json.dumps(figure)) < 300_000


def test_all_text_is_escaped(calibration: Calibration):
    nasty = dataclasses.replace(
        calibration,
        status=NASTY,
        unobservable=(remark(NASTY),),
        warnings=(remark(f"{NASTY} again"),),
        notes=(remark(NASTY),),
        inputs={NASTY: NASTY},
        settings={NASTY: NASTY},
        covariance_names=(NASTY, *calibration.covariance_names[1:]),
    )
    page = Page(report_html(nasty))
    assert len(page.scripts) == 3
    assert page.words.count(NASTY) == 8
    assert NASTY in figures_of(page.source)["correlation"]["data"][0]["x"]


def test_figures_show_the_numbers(calibration: Calibration, text: str):
    figures = figures_of(text)
    used = ~calibration.corner_residuals[0].rejected
    heat = figures["plane-0"]["data"][0]["z"]
    assert 0.99 * used.sum() < sum(v or 0 for row in heat for v in row) <= used.sum()
    rejected = figures["image-0"]["data"][-1]
    assert (rejected["name"], len(rejected["x"])) == ("rejected", (~used).sum())
    diagonal = np.diag(figures["correlation"]["data"][0]["z"])
    np.testing.assert_allclose(diagonal, 1.0)
    rate = figures["motion"]["data"][0]["y"]
    assert np.rad2deg(0.5 * 2.1) * 0.9 < max(rate) < np.rad2deg(0.5 * 2.1 + 0.6 * 1.3)


def test_ellipsoids_are_three_sigma_of_a_position(calibration: Calibration, text: str):
    traces = {t["name"]: t for t in figures_of(text)["rig"]["data"]}
    factor = float(re.search(r"position, ([\d.e+-]+) times as large", Page(text).words).group(1))  # pyright: ignore
    for name in calibration.mounted:
        group = calibration.group(name, "translation")
        drawn = next(t for n, t in traces.items() if n.startswith(f"{name}: "))
        points = np.array([drawn[axis] for axis in "xyz"], dtype=float).T
        away = (points[~np.isnan(points[:, 0])] - group.value) / factor
        information = np.linalg.inv(joint_covariance(calibration, [group]))
        size = np.sqrt(np.einsum("ni,ij,nj->n", away, information, away))
        np.testing.assert_allclose(size, 3.0, rtol=1e-2)  # coordinates are written with few digits


def test_maps_of_projection_say_what_they_show(calibration: Calibration, text: str):
    """Camera 1 at the target's distance: its numbers, its corners, and a scale that edges without data do not take."""
    page, distance = Page(text), working_distance(calibration, "cam1")
    drawn = figures_of(page.source)["projection-1-1"]["data"]
    assert distance is not None
    m = projection_uncertainty(calibration, "cam1", distance)
    assert m is not None
    np.testing.assert_allclose(drawn[0]["z"], m.sigma, rtol=1e-4)
    assert drawn[0]["zmax"] <= 6.0 * m.median_seen and drawn[0]["contours"]["size"] <= drawn[0]["zmax"] / 9
    assert drawn[1]["name"] == "corners" and 500 < len(drawn[1]["x"]) <= show.MOST_RESIDUAL_DOTS
    size, u, v = m.worst
    assert (
        f"Known to {format_number(m.median_seen)} px where it saw points (median), to {format_number(size)} px"
        in page.words
    )
    assert f"at pixel ({u:.0f}, {v:.0f})" in page.words
    assert f"cam1: points {format_number(distance)} m away" in page.words


def test_a_fixed_lens_has_no_map_but_a_sentence(calibration: Calibration):
    fixed: dict[str, Any] = {"columns": None, "factor": None}
    groups = tuple(
        dataclasses.replace(g, **fixed) if (g.sensor, g.name) == ("cam0", "intrinsics") else g
        for g in calibration.groups
    )
    page = Page(report_html(dataclasses.replace(calibration, groups=groups)))
    assert set(figures_of(page.source)) == FIGURES - {"projection-0-0", "projection-0-1"}
    assert "cam0: intrinsics and distortion are fixed by the rig file" in page.words


@pytest.mark.parametrize(("seen", "sentence"), [(True, "Let it see points there, too"), (False, "px over the image")])
def test_what_is_said_of_an_edge_without_data(seen: bool, sentence: str):
    sigma, cells = np.array([[0.1, 0.1, 0.9]]), np.array([[seen, seen, False]])
    m = ProjectionMap("cam0", np.inf, np.array([0.0, 10.0, 20.0]), np.zeros(1), sigma, cells)
    found = show.map_words(m)
    assert sentence in found and "0.10 px" in found and "0.90 px at the worst, at pixel (20, 0)" in found
    assert ("Let it see" in found) == seen


def test_what_halves_say_of_each_other(calibration: Calibration, text: str):
    held, page = calibration.cross_validation, Page(text)
    assert held is not None
    assert "the formal standard deviations are too small by a factor of about 3.0." in page.words
    assert "chi^2 is 900 higher" in page.words and "would make that 100 ± 25" in page.words
    assert "the printed standard deviations of sensors are 2.7 times the formal ones" in page.words
    for cell in ("0.9874", "0.9975", "0.2 px", "0.202 px", "+400.0", "+15.5"):
        assert f'<td class="number">{cell}</td>' in text
    factor, allowed, moved = figures_of(page.source)["held-out"]["data"]
    assert (factor["x"][:2], allowed["x"][:2]) == ([-2.7, 2.7], [-1.0, 1.0])
    np.testing.assert_allclose(np.reshape(moved["x"], (8, -1)), held.shift / held.shift_sigma, rtol=1e-4)
    rows = figures_of(page.source)["held-out"]["layout"]["yaxis"]["ticktext"]
    assert rows[6:8] == ["cam0 time offset", "cam0 intrinsics fx"] and len(rows) == held.directions
    assert moved["text"][len(rows) + 7] == "cam0 intrinsics fx, without part 2"


@pytest.mark.parametrize(
    ("excess", "sentence"),
    [(170.0, "That is chance"), (176.0, "too small by a factor of about 1.3"), (20.0, "if anything, too large")],
)
def test_the_verdict_of_halves_leaves_room_for_chance(calibration: Calibration, excess: float, sentence: str):
    held = dataclasses.replace(calibration.cross_validation, excess=excess)  # pyright: ignore
    assert sentence in Page(report_html(dataclasses.replace(calibration, cross_validation=held))).words


def test_where_nothing_was_held_out_it_says_so(calibration: Calibration):
    page = Page(report_html(dataclasses.replace(calibration, cross_validation=None)))
    assert "No cross-validation: the recording is too short for segments" in page.words
    assert set(figures_of(page.source)) == FIGURES - {"held-out"}


def test_nothing_seen_and_nothing_iterated(calibration: Calibration):
    r = calibration.corner_residuals[0]
    none = dataclasses.replace(
        calibration,
        residuals=calibration.residuals | by_key([dataclasses.replace(r, rejected=np.ones_like(r.rejected))]),
        iterations=(),
        unobservable=(),
        warnings=(),
        groups=tuple(dataclasses.replace(g, verdict=("determined",) * len(g.verdict)) for g in calibration.groups),
    )
    assert "None: every check passed." in Page(report_html(none)).words


def test_reasons_stand_in_their_order_and_once(calibration: Calibration):
    groups = tuple(dataclasses.replace(g, verdict=("determined",) * len(g.verdict)) for g in calibration.groups)
    mind, large = remark("mind."), remark("it is too large.")
    words = {"warnings": (mind, large), "wrong": (large,)}
    mistaken = dataclasses.replace(calibration, unobservable=(), groups=groups, **words)
    page = report_html(mistaken)
    assert page.index('<li class="bad">it is too large.') < page.index('<li class="care">mind.')
    assert page.count("it is too large.") == 1 and "Not usable. Act on the first reason" in page


@pytest.mark.parametrize(("count", "folded"), [(3, 0), (4, 0), (5, 2), (9, 6)])
def test_of_many_reasons_the_first_three_are_on_the_first_screen(calibration: Calibration, count: int, folded: int):
    known = calibration.reasons
    more = tuple(remark(f"reason {k}.") for k in range(count - len(known)))
    c = dataclasses.replace(calibration, warnings=(*calibration.warnings, *more))
    assert len(c.reasons) == count
    page = report_html(c)
    assert (f"<summary>{folded} more reasons</summary>" in page) == bool(folded)
    assert page.count('start="4"') == bool(folded) and all(f">reason {k}.<" in page for k in range(len(more)))


def test_a_poor_fit_colours_the_card(calibration: Calibration):
    """Residuals twice and five times as large as stated, of a camera whose parameters are determined."""
    groups = tuple(dataclasses.replace(g, verdict=("determined",) * len(g.verdict)) for g in calibration.groups)

    def page(chi2_per_dof: float) -> str:
        fits = (dataclasses.replace(calibration.fits[0], chi2=chi2_per_dof * calibration.fits[0].dof),)
        return report_html(dataclasses.replace(calibration, groups=groups, fits=(*fits, *calibration.fits[1:])))

    assert page(1.0).count('<article class="card determined">') == 2  # the IMU's is that of fixed values
    for size, css in ((2.0, "weak"), (5.0, "bad")):
        assert f'<article class="card {css}"><h3>cam0' in page(size**2)
        assert f"residuals {size:.2g}x the stated noise" in page(size**2)


def test_only_what_is_not_estimated_is_called_fixed(calibration: Calibration):
    """Parameters with a prior have no verdict that counts, and were estimated."""

    def cam0(fixed: bool) -> list[object]:
        mode, names = "fixed" if fixed else "prior", lambda g: ("fixed",) * len(g.verdict) if fixed else g.verdict
        groups = tuple(
            dataclasses.replace(g, mode=mode, columns=None if fixed else g.columns, verdict=names(g))
            for g in calibration.groups
        )
        c = dataclasses.replace(calibration, groups=groups)
        return [next(x.verdict for x in sensor_cards(c) if x.sensor == "cam0"), *(r[1] for r in extrinsics(c)[:1])]

    assert cam0(fixed=False) == ["determined", ""]  # the card is that of the lens, too
    assert cam0(fixed=True) == ["fixed", "fixed"]


def test_one_name_and_a_word_for_each_parameter(calibration: Calibration):
    low_pass = {"value": [2e-6], "std": [1e-6], "labels": ["low_pass"], "unit": "s^2"}
    size = {"value": [0.0, -0.004], "std": [1.0, 0.001], "labels": ["yx", "yy"], "unit": "m"}
    c = dataclasses.replace(calibration, effects={"imu0.low_pass": low_pass, "imu0.size_effect": size})
    text = report_html(c)
    assert "In the frame of imu0. Red" in text and "In the frame of imu. " not in text
    assert "<li>low_pass: low-pass filter of the IMU, as half the variance of its response.</li>" in text
    assert "<td>yy -4 ± 1 mm</td>" in text and "<th>setting</th>" not in text
    assert "<code>icalib view RESULT RECORDING</code>" in report_html(with_images(calibration))


def test_rows_are_in_units_that_people_read(calibration: Calibration):
    found = {(r.sensor, r.name): r for r in rows(calibration)}
    yaw, z = found["cam0", "yaw"], found["cam0", "rotation z"]
    assert (yaw.value, yaw.unit, yaw.factor, yaw.verdict) == ("89.150", "deg", "", "")
    assert (z.value, z.std, z.unit, z.factor, z.verdict) == ("", "0.022", "deg", "2.7", "determined")
    y = found["cam1", "translation y"]
    assert (y.value, y.std, y.formal, y.unit, y.verdict) == ("45.4", "1.2", "0.44", "mm", "unobservable")
    offset = found["cam0", "time offset"]
    assert (offset.value, offset.std, offset.unit) == ("-0.135", "0.030", "ms")
    assert found["cam0", "k1"].std == ""
    assert not any(sensor == "imu0" for sensor, _ in found)


def turned(c: Calibration, pitch_deg: float) -> Calibration:
    """`c` with cam0 turned to roll 20 deg, `pitch_deg` and yaw 30 deg."""
    R = Rotation.from_euler("xyz", [20.0, pitch_deg, 30.0], degrees=True).as_matrix()
    return dataclasses.replace(
        c, groups=tuple(dataclasses.replace(g, value=R) if g is c.group("cam0", "rotation") else g for g in c.groups)
    )


def sampled_rpy(R: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(3,) standard deviations of roll, pitch and yaw over draws of R Exp(d)."""
    draws = Rotation.from_rotvec(np.random.default_rng(6).multivariate_normal(np.zeros(3), covariance, 20_000))
    return (Rotation.from_matrix(R) * draws).as_euler("xyz").std(axis=0)


def test_roll_pitch_and_yaw_have_their_own_standard_deviations(calibration: Calibration):
    """In the table, the YAML and seen from another sensor they are those of samples, also beside gimbal lock; too near
    to it they are unknown."""
    c = turned(calibration, 87.0)
    g = c.group("cam0", "rotation")
    expected = sampled_rpy(g.value, joint_covariance(c, [g]))
    assert expected[2] > 10.0 * g.std.max()
    found = {r.name: r for r in rows(c) if r.sensor == "cam0"}
    assert [float(found[name].value) for name in TURNS] == pytest.approx([20.0, 87.0, 30.0], abs=0.05)
    assert [float(found[name].std) for name in TURNS] == pytest.approx(np.rad2deg(expected).tolist(), rel=0.05)
    entry = yaml.safe_load(calibration_yaml(c))["sensors"]["cam0"]
    np.testing.assert_allclose(entry["roll_pitch_yaw"], np.deg2rad([20.0, 87.0, 30.0]), atol=1e-9)
    np.testing.assert_allclose(entry["std"]["roll_pitch_yaw"], expected, rtol=0.03)
    assert entry["std"]["rotation"] == g.std.tolist()
    pair = c.T("cam0", "cam1")
    angles, std = rpy_deg(pair.T[:3, :3], pair.covariance[:3, :3])
    np.testing.assert_allclose(std, np.rad2deg(sampled_rpy(pair.T[:3, :3], pair.covariance[:3, :3])), rtol=0.03)
    words = ", ".join(f"{x:.3f} +- {format_number(s)}" for x, s in zip(angles, std, strict=True))
    assert f"roll, pitch, yaw {words} deg" in " ".join(relative_words(c))
    locked = turned(calibration, 89.95)
    assert [r.std for r in rows(locked) if r.sensor == "cam0" and r.name in TURNS] == ["unknown"] * 3
    entry = yaml.safe_load(calibration_yaml(locked))["sensors"]["cam0"]
    assert entry["std"]["roll_pitch_yaw"] == [None] * 3 and entry["std"]["rotation"] == g.std.tolist()
    assert "unknown" in report_html(locked)


@pytest.mark.parametrize(
    ("value", "words"),
    [(0.0123456, "0.012"), (123.4, "123"), (0.0, "0"), (2e-7, "2.0e-07"), (np.inf, "infinite"), (np.nan, "unknown")],
)
def test_shown(value: float, words: str):
    assert format_number(value) == words


@pytest.mark.parametrize(
    ("count", "dof", "chi2", "words"),
    [
        (20000, 19800.5, 19800.5, ("1.00", "19800")),
        (1188, -5.7, 2021.9, ("at least 20", "at most 103")),
        (1794, 0.6, 0.1, ("at least 0.00078", "at most 128")),
        (3, 1.0, 6.0, ("at least 2.0", "at most 3")),
    ],
)
def test_few_degrees_of_freedom_are_bounded(count: int, dof: float, chi2: float, words: tuple[str, str]):
    """Below the sampling error of the degrees of freedom, chi^2 has a lower bound; a warning has the same one."""
    fit = SensorFit("imu0", "bias walk", count, dof, chi2)
    assert (chi2_words(fit), dof_words(fit)) == words
    assert excess(fit) == pytest.approx(1.0 if chi2 <= 2.0 * largest_dof(fit) else np.sqrt(chi2 / largest_dof(fit)))


def test_numbers_and_thinning():
    assert numbers(np.array([[1.23456789, np.nan], [np.inf, -2.0]])) == [[1.2346, None], [None, -2.0]]
    kept = thin(1000, 10)
    assert (len(kept), kept[0], kept[-1]) == (10, 0, 999)
    np.testing.assert_array_equal(thin(3, 10), [0, 1, 2])


def test_console_table(calibration: Calibration):
    console = Console(width=120, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        console.print(table(shown_rows(calibration, verbose=True)))
        text = console.export_text()
    line = next(line for line in text.splitlines() if "translation y" in line and "45.4" in line)
    assert "unobservable" in line and "mm" in line
    assert len([line for line in text.splitlines() if line.startswith("│")]) == len(rows(calibration))


def test_the_console_begins_with_extrinsics_and_time_offsets(calibration: Calibration):
    """Lenses, IMU intrinsics and auxiliary parameters are behind `-v`, and the legend counts them."""
    c = dataclasses.replace(calibration, warnings=(), unobservable=())
    entries, everything = shown_rows(c, verbose=False), shown_rows(c, verbose=True)
    mounted = {"rotation", "translation", "time_offset"}
    assert {row.group for row in entries if row.sensor in ("cam0", "cam1")} == mounted
    assert [row.group in mounted for row in everything] == sorted(row.group in mounted for row in everything)[::-1]
    assert everything[: len(entries)] == entries
    more = f"-v adds {len(everything) - len(entries)} rows: intrinsics, distortion,"
    assert more in legend(c, entries) and "-v" not in legend(c, everything)
    assert "bloom: dark edges" in legend(c, everything) and "bloom: dark edges" not in legend(c, entries)


@pytest.mark.parametrize(
    ("reason", "rows_named"),
    [
        ("the fixed value of distortion k1 of cam0, -0.28, contradicts the data", [("cam0", "k1")]),
        ("the intrinsics of cam1 do not fit", [("cam1", name) for name in ("fx", "fy", "cx", "cy")]),
        ("imu0 gyroscope with cam1 bloom: not determined by this motion", [("cam1", "bloom")]),
        ("the prior of shape bow_xx of board0 contradicts the data", [("board0", "shape bow xx")]),
    ],
)
def test_the_console_shows_what_a_reason_names(calibration: Calibration, reason: str, rows_named: list):
    brief = shown_rows(dataclasses.replace(calibration, warnings=(), unobservable=()), verbose=False)
    shown = shown_rows(dataclasses.replace(calibration, warnings=(remark(reason),), unobservable=()), verbose=False)
    assert [(row.sensor, row.name) for row in shown if row not in brief] == rows_named


def test_the_console_shows_intrinsics_of_an_imu_whose_verdict_counts(calibration: Calibration):
    """Also where the reason names others first, and not those of a lens, whose verdict is on its line."""
    groups = tuple(
        dataclasses.replace(
            g, mode="free", columns=g.columns or tuple(range(len(g.labels))), verdict=("weak",) * len(g.labels)
        )
        for g in calibration.groups
    )
    c = dataclasses.replace(calibration, groups=groups, warnings=(), unobservable=())
    assert not any("imu0 intrinsics" in reason for reason in c.reasons)
    weak = {(row.sensor, row.group) for row in shown_rows(c, verbose=False)}
    assert ("imu0", "intrinsics") in weak and ("cam0", "intrinsics") not in weak and ("board0", "shape") not in weak


def test_a_lens_is_one_line_of_the_console(calibration: Calibration):
    """With its projection uncertainty; model and distortion only where they fit. A fixed lens has no uncertainty."""
    sigma = calibration.lens_projections_px["cam0"]
    assert sigma is not None
    short, longer, longest = (lens_words(calibration, width)[0] for width in (40, 100, 200))
    assert short.startswith("cam0 lens: fx 458.65") and short.endswith(f" px, projection +- {format_number(sigma)} px")
    assert longer == f"{short}, pinhole-radtan" and longest.startswith(f"{longer} k1 -0.28")
    strict = dataclasses.replace(calibration, settings=calibration.settings | {"pixel_tolerance": 0.5 * sigma})
    weak = tuple(
        dataclasses.replace(g, verdict=("weak",) * len(g.verdict)) if g.name == "intrinsics" else g
        for g in calibration.groups
    )
    assert lens_words(dataclasses.replace(strict, groups=weak), 40)[0] == f"{short}, weak"
    fixed = tuple(
        dataclasses.replace(g, columns=None, verdict=("fixed",) * len(g.verdict))
        if g.name in ("intrinsics", "distortion")
        else g
        for g in calibration.groups
    )
    assert lens_words(dataclasses.replace(calibration, groups=fixed), 40)[0].endswith(" px, fixed")


def test_outputs_are_one_set(calibration: Calibration, tmp_path: Path):
    check_folder(tmp_path / "out")
    write_outputs(calibration, tmp_path / "out")
    names = {"calibration.yaml", "camchain-imucam.yaml", "imu.yaml", "report.html", "result.json", "result.npz"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == names


def test_a_browser_draws_it(calibration: Calibration, assert_drawn: Callable[[str, set[str]], str]):
    assert_drawn(report_html(with_images(calibration)), FIGURES)


def test_a_narrow_window_prints_figures_of_a_pair_side_by_side(
    text: str, assert_drawn: Callable[[str, set[str], int], str]
):
    printed = assert_drawn(text, set(), 500)
    widths = re.findall(
        r'<div class="plot[^"]*" id="([\w-]+)".{,999}?<svg class="main-svg"[^>]* width="([\d.]+)"', printed, re.DOTALL
    )
    of = {name: float(width) for name, width in widths}
    assert 600.0 < of["histogram"] < 688.0  # 182 mm
    assert of["plane-0"] < 344.0 and of["image-0"] < 344.0
