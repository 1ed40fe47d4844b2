"""What `icalib inspect` prints fits the terminal, with whole words."""

from __future__ import annotations

import re

from icalib.cli.commands import main


def test_words_are_whole_on_a_narrow_terminal(bags, brief, tmp_path, capsys, monkeypatch):
    """Long names of topics, types and gaps leave no width for a table."""
    topics = "/robot/stereo/left/image_raw", "/robot/stereo/right/image_raw", "/robot/imu/data_raw"
    messages = bags.noise(topics[0]) + bags.noise(topics[1])[::2] + bags.imu(topics[2], brief)
    bag = bags.write(tmp_path / "run", [m for k, m in enumerate(messages) if not 20 < k < 30])
    lines = {}
    for width in ("80", "200"):
        monkeypatch.setenv("COLUMNS", width)
        assert main(["inspect", str(bag)]) == 0
        lines[width] = capsys.readouterr().out.splitlines()
    assert max(map(len, lines["80"])) <= 80
    words = {width: set(re.findall(r"[\w./-]+", " ".join(shown))) for width, shown in lines.items()}
    assert words["200"] - words["80"] <= {"topic"}  # the header of the first column
    assert any(line.strip().startswith(f"{topics[0]}: type Image") for line in lines["80"])
