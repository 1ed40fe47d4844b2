"""`fleet.html`: the result of a fleet in one file that needs no network, failures and changes first."""

from __future__ import annotations

from string import Template

from icalib.report.page import document, plot_place, resource
from icalib.report.plot import Figure
from icalib.report.tables import Html, element, html, sentences, table
from icalib.tools.fleet import words
from icalib.tools.fleet.figures import over_time, sensors
from icalib.tools.fleet.result import Fleet, JobResult, by_robot
from icalib.tools.fleet.store import JOBS

_BADGES = {"done": "determined", "failed": "bad"}  # green, red


def fleet_html(fleet: Fleet, title: str) -> str:
    """The page as one HTML document; title: name of the file of jobs."""
    figures, folds = _over_time(fleet)
    texts = {
        "title": title,
        "answer": words.answer(fleet),
        "chance": words.chance_words(fleet) if any(d.n_tested for d in fleet.drifts) else "",
        "limit": f"{fleet.limit:g}",
        "trust": "bad" if fleet.failed else ("care" if fleet.drifted else "good"),
    }
    parts = {
        "failures": _titled("Failed", words.failures(fleet), "bad"),
        "changes": _titled("Changed", words.changes(fleet), "care"),
        "aside": _aside(len(words.unsure(fleet))),
        "robots": _robots(fleet),
        "figures": folds,
        "jobs": _jobs(fleet),
        "unsure": sentences(words.unsure(fleet), "", "None."),
        "notes": sentences(words.notes(fleet), "", "None."),
    }
    escaped = {name: html(text) for name, text in texts.items()}
    body = Template(resource("icalib.tools.fleet", "page.html")).substitute(escaped | parts)
    return document(f"Fleet of {title}", body, figures)


def _titled(title: str, lines: list[str], css: str) -> Html:
    return Html(element("h3", title) + sentences(lines, css, "")) if lines else Html("")


def _aside(count: int) -> Html:
    """Paragraph with a link to the `count` differences that cannot be tested; empty if there are none."""
    if not count:
        return Html("")
    return element("p", [Html('<a href="#facts">Cannot be judged</a>'), f": {count} more, not determined or typed."])


def _robots(fleet: Fleet) -> Html:
    body = [(robot, jobs, failed or "", *rest) for robot, jobs, failed, *rest in words.robot_rows(fleet)]
    return Html(element("h3", "Robots") + table(words.ROBOT_HEADERS, body, words.ROBOT_HEADERS[1:3]))


def _over_time(fleet: Fleet) -> tuple[dict[str, Figure], Html]:
    """Figures by the id of their placeholder, and a collapsible section for each robot with several calibrations."""
    robots, figures, folds = by_robot(fleet.results), dict[str, Figure](), list[Html]()
    for i, drift in enumerate(fleet.drifts):
        results = robots[drift.robot]
        if len(results) < 2:
            continue
        parts = [element("summary", drift.robot)]
        for k, sensor in enumerate(sensors(results)):
            figures[f"time-{i}-{k}"] = over_time(results, sensor)
            parts += [element("h3", sensor), plot_place(f"time-{i}-{k}")]
        opening = "<details open>" if drift.changes else "<details>"
        folds.append(Html(f"{opening}{html(list(parts))}</details>"))
    return figures, html(list(folds)) if folds else element("p", "No robot has two calibrations.", "quiet")


def _jobs(fleet: Fleet) -> Html:
    body = [
        (
            _link(r),
            r.job.robot,
            words.time_words(r.time),
            _status(r),
            words.care_words(r),
            f"{r.record.seconds:.1f}",
            r.record.failure or fleet.again.get(r.job.name, ""),
        )
        for r in fleet.results
    ]
    return table(("job", "robot", "time", "status", "to know", "took [s]", "why"), body, ("took [s]",))


def _link(one: JobResult) -> Html:
    """Link to the job's report; only the name if it has none. Job names are valid folder names, so that the URL needs
    no quoting."""
    name = html(one.job.name)
    return Html(f'<a href="{JOBS}/{name}/report.html">{name}</a>') if one.record.blocks else name


def _status(one: JobResult) -> Html:
    return element("span", one.status, f"badge {_BADGES[one.status]}")
