"""Results of studies are reused only if the code that made them is the same, the estimator's too."""

import hashlib
from pathlib import Path

import icalib
from icalib.tools.batch import program


def test_the_digest_is_of_all_of_the_source():
    root, digest = Path(icalib.__file__).parent, hashlib.sha256()
    files = sorted(root.rglob("*.py"))
    assert root / "optim" / "front.py" in files
    for file in files:
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    assert program() == digest.hexdigest()[:16]
