"""The README is short, and CI runs its own test command."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")


def test_it_has_at_most_a_thousand_words() -> None:
    assert len(README.split()) <= 1000


def test_ci_runs_its_test_command() -> None:
    pattern = re.search(r"grep -E '(.+)' README.md", (ROOT / ".ci" / "run").read_text("utf-8"))
    assert pattern is not None
    assert len(re.findall(pattern[1], README, re.MULTILINE)) == 1


def test_one_line_installs_and_flies() -> None:
    install = "python3 -m venv .venv && .venv/bin/pip install -q -e '.[ros]'"
    line = f"{install} && .venv/bin/python -m uav_dc_ros.run_all"
    assert line in README.splitlines()


def test_every_picture_is_small() -> None:
    pictures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", README)
    assert len(pictures) >= 2
    assert all((ROOT / path).stat().st_size < 1_000_000 for path in pictures)
