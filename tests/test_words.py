"""Pages and messages use the standard terms of the field, in short sentences.

`python tests/test_words.py` prints mean and longest sentence of each page, and all faults of pages and messages.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "icalib"
PAGES = (
    *(
        ROOT / name
        for name in ("README.md", "CONTRIBUTING.md", "VISION.md", "examples/euroc/README.md", "CHANGELOG.md")
    ),
    *sorted((ROOT / "docs").glob("**/*.md")),
)
MEAN_WORDS, MOST_WORDS = 18, 40  # of a sentence: on average over a page, and at most

# The only list of private terms: a pattern, and what to write in its place.
PRIVATE = {
    r"\ball that lasts\b|\blasting parameters?\b|\b(?:in|of) the border\b|\bborder's\b": "calibration parameters",
    r"(?<!import )\bnodes?\b(?!\()": "keyframe",
    r"\b(?:is|are|was|were|be|left|leaves?|stays?|what is) open\b": "unobservable",
    r"\b(?:is|are|was|were|be|stays?) held\b(?! (?:in|before|by) )|\bheld (?:at|where|directions?|values?)\b": "fixed",
    r"\bworth\b": "prior uncertainty of the guess",
    r"\bowes? to (?:the|its|a) guess\b": "consider covariance",
    r"\b(?:goes|go|moved) to the guess\b|\bastray\b": "reset to the prior mean",
    r"\bin doubt\b|\bdoubtful\b": "possibly rank deficient",
    r"\blets? go\b|\bcomes? back in the\b": "early stopping, second-order correction",
    r"\bhalves (?:of a recording |of the recording )?(?:that )?predict\b|\bheld.out\b": "two-fold cross-validation",
    r"\bset aside\b": "rejected",
    r"\bno freedom left\b": "n/a (no redundancy)",
    r"\btimes as large as (?:its|their|the) noise\b": "residuals N x larger than the stated noise predicts",
    r"\bparts of (?:the|a) recording (?:disagree|scatter)\b": "estimates from segments scatter N x more",
    r"\bin squares\b": "sigma^2 = sigma_0^2 + ...",
    r"\bwhat no spread\b": "systematic errors",
    r"\bwith places\b|\bby place\b|\bof places\b": "image regions",
    r"\bwhere .{1,25}(?:sits?|stands?) on\b": "extrinsics",
    r"\bclocks are apart\b": "time offset",
    r"\bway of the (?:IMU|robot|camera|LiDAR)\b": "trajectory",
    r"\bpoints? that (?:are |is )?(?:(?:a |the |each )?cameras? |it )?follow(?:s|ed)?\b": "tracked points",
    r"\bfollowed points?\b": "tracked points",
    r"\bcameras? (?:that |which )?follows? (?:points|tracks)\b": "feature tracks",
    r"\bown robot\b": "self-returns of the LiDAR",
    r"\bsaid beforehand\b": "known values",
    r"\bfelt size\b": "scale by the accelerometer",
    r"\bcurves? of both hands\b": "left and right turns",
    r"\b(?:sideways|upwards) slip\b|\bslip (?:sideways|upwards)\b": "lateral slip, vertical slip",
    r"\b(?:goes|go) back to zero\b": "encoder wrap-around",
    r"\bpictures? without (?:a|any) clocks?\b": "images without timestamps",
    r"\bon (?:their|its) heads?\b": "rotated by 180 deg",
    r"\b(?:goes|go) on where it (?:was )?stopped\b": "resumes",
    r"\bnoise explains\b": "predicted by the stated noise",
    r"\bdebias(?:ed|ing)?\b": "noise in the Jacobian",
}
FOUND = [(re.compile(pattern, re.IGNORECASE), better) for pattern, better in PRIVATE.items()]


def prose(page: str) -> str:
    """Text of a page without code, comments and equations; tables stay."""
    for block in (r"```.*?```", r"<!--.*?-->", r"\$\$.*?\$\$"):
        page = re.sub(block, " ", page, flags=re.DOTALL)
    page = re.sub(r"`[^`\n]*`", "x", page)
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", page)


def sentences(page: str) -> list[str]:
    """Sentences of three words or more; headings, tables and indented code are none."""
    skipped = re.compile(r"\s*(\||#|!|===|:|-{3,})|    ")
    text = "\n".join(line for line in prose(page).splitlines() if not skipped.match(line))
    found: list[str] = []
    for paragraph in re.split(r"\n\s*\n|\n\s*[-*] |\n\s*\d+\. ", text):
        found += re.split(r"(?<=[.!?])\s+(?=[A-Z*\[])", " ".join(paragraph.split()))
    return [sentence for sentence in found if len(sentence.split()) > 2]


def private_terms(text: str) -> list[str]:
    """Each as `what is written` -> `what to write`."""
    return [f"{hit.group()!r} -> {better}" for term, better in FOUND for hit in term.finditer(text)]


def faults(page: str) -> list[str]:
    """What a page says in private terms or at too great length."""
    found, said = private_terms(" ".join(prose(page).split())), sentences(page)
    lengths = [len(sentence.split()) for sentence in said]
    if lengths and sum(lengths) > MEAN_WORDS * len(lengths):
        found.append(f"{sum(lengths) / len(lengths):.1f} words a sentence, more than {MEAN_WORDS}")
    found += [f"{n} words: {s[:90]} ..." for s, n in zip(said, lengths, strict=True) if n > MOST_WORDS]
    return found + [f"no subject: {s[:60]} ..." for s in said if s.startswith("Of ")]


def strings(source: str) -> list[str]:
    """String constants of a module that may reach a user: all that hold a space and are no docstring. What a formatted
    string inserts is `x`."""
    tree = ast.parse(source)
    skipped = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    found: list[str] = []
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.JoinedStr):
            skipped |= {id(part) for part in ast.walk(node)}
            found.append("".join(str(p.value) if isinstance(p, ast.Constant) else "x" for p in node.values))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append(node.value)
    return [text for text in found if " " in text]


def wrong_strings(module: Path) -> list[str]:
    """What the strings of a module say in private terms or in sentences that are too long."""
    found: list[str] = []
    for text in strings(module.read_text(encoding="utf-8")):
        said = [sentence for sentence in sentences(text) if len(sentence.split()) > MOST_WORDS]
        found += private_terms(text) + [f"{len(sentence.split())} words: {sentence[:90]} ..." for sentence in said]
    return found


def code_prose(source: str) -> list[str]:
    """All docstrings and comments of a module."""
    found = [
        ast.get_docstring(node)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return [text for text in found if text] + [t.string for t in tokens if t.type == tokenize.COMMENT]


REVISED = (
    "base",
    "cli",
    "data",
    "detection",
    "estimate",
    "export",
    "geometry",
    "initialize",
    "model",
    "motion",
    "observability",
    "optim",
    "report",
    "result",
    "rig",
    "sensors/*/model",
    "sensors/*/spec",
    "sensors/camera",
    "sensors/fields",
    "sensors/imu",
    "sensors/lidar",
    "sensors/parameter*",
    "sensors/pose",
    "sensors/position",
    "sensors/sensor",
    "sensors/wheels",
    "tools",
    "validation",
)  # the list only grows
UNREVISED: set[str] = set()  # pages that are still to be revised; the list only shrinks


def revised_modules(name: str) -> list[Path]:
    """The files of a package or module; a `*` stands for every kind of sensor."""
    found = [*SOURCE.glob(f"{name}.py"), *(file for folder in SOURCE.glob(name) for file in folder.rglob("*.py"))]
    assert found, f"{name} is in REVISED and does not exist"
    return found


def test_pages_are_in_standard_terms_and_short_sentences():
    found = {page.relative_to(ROOT).as_posix(): faults(page.read_text(encoding="utf-8")) for page in PAGES}
    assert not {name: wrong for name, wrong in found.items() if wrong and name not in UNREVISED}
    assert {name for name in UNREVISED if not found[name]} == set(), "revised: take it from the list"


def test_messages_are_in_standard_terms_and_short_sentences():
    found = {module.relative_to(SOURCE).as_posix(): wrong_strings(module) for module in SOURCE.rglob("*.py")}
    assert not {name: wrong for name, wrong in found.items() if wrong}


def test_docstrings_and_comments_of_revised_packages_are_in_standard_terms():
    found = {}
    for module in (module for name in REVISED for module in revised_modules(name)):
        texts = code_prose(module.read_text(encoding="utf-8"))
        found[module.relative_to(SOURCE).as_posix()] = [term for text in texts for term in private_terms(text)]
    assert not {name: wrong for name, wrong in found.items() if wrong}


def test_prose_of_code_is_docstrings_and_comments():
    assert code_prose('"""A."""\nx = "b"  # c\ndef f():\n    """D."""\n') == ["A.", "D.", "# c"]


def test_faults_are_found():
    long = "This sentence " + "goes on and on " * 12 + "until it ends."
    assert len(faults(f"# Page\n\n{long}\n\nNodes are set aside.\n\nOf wheels nothing is known.\n")) == 5
    source = '"""Nodes, a docstring."""\nx = f"{y} nodes are open"\nz = "from ros import Node"\n'
    assert [len(private_terms(text)) for text in strings(source)] == [2, 0]
    assert not faults("# Page\n\nKeyframes are 50 ms apart.\n\n```text\nnodes are set aside\n```\n\n| a | `nodes` |\n")


if __name__ == "__main__":
    for each in PAGES:
        text = each.read_text(encoding="utf-8")
        lengths = [len(sentence.split()) for sentence in sentences(text)] or [0]
        print(f"{each.name}: mean {sum(lengths) / len(lengths):.1f}, longest {max(lengths)}")
        print("".join(f"    {fault}\n" for fault in faults(text)), end="")
    for each in sorted(SOURCE.rglob("*.py")):
        print("".join(f"{each.relative_to(SOURCE)}: {fault}\n" for fault in wrong_strings(each)), end="")
