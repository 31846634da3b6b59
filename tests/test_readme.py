"""The README's tables and commands are those of the code."""

import re
from pathlib import Path

import pytest

from uav_dc_ros import resources, scenarios
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.nodes.table import NODES
from uav_dc_ros.topics import TOPICS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")


def test_the_topic_table_is_the_code_s() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (\w+/msg/\w+) \| ([^|]+) \| ([^|]+) \| ", README, re.MULTILINE)
    assert [(name, type) for name, type, _, _ in rows] == [(t.name, t.type) for t in TOPICS.values()]
    for name, _, publisher, qos in rows:
        durability = "transient local" if TOPICS[name].latched else "volatile"
        assert qos == f"{'reliable' if TOPICS[name].reliable else 'best effort'}, {durability}"
        publishers = [row.name for row in NODES.values() if name in row.publishes]
        several = "every node" if len(publishers) == len(NODES) else "other nodes"
        assert publisher == (" or ".join(publishers) if len(publishers) <= 2 else several)


def test_every_key_in_the_symbol_table_is_a_scenario_s() -> None:
    scenario: Scenario = scenarios.load("five_clusters")
    keys = re.findall(r"`((?:grid|users|mission|radio|reward)\.\w+)`", README)
    assert len(keys) >= 15
    for key in keys:
        section, name = key.split(".")
        assert hasattr(getattr(scenario, section), name), key


def test_ci_runs_the_readme_s_test_command() -> None:
    pattern = re.search(r"grep -E '(.+)' README.md", (ROOT / ".ci" / "run").read_text("utf-8"))
    assert pattern is not None
    assert len(re.findall(pattern[1], README, re.MULTILINE)) == 1


@pytest.mark.parametrize("command", re.findall(r"python3? -m (uav_dc_ros[\w.]*)", README))
def test_every_command_exists(command: str) -> None:
    assert (ROOT / Path(*command.split("."))).with_suffix(".py").is_file()


def test_every_picture_and_folder_exists() -> None:
    for path in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README):
        assert (ROOT / path).is_file(), path
    for path in re.findall(r"^((?:uav_dc_ros|msgs_json|policies)[\w/.]*)  ", README, re.MULTILINE):
        assert (ROOT / path).exists(), path


def test_every_shipped_policy_is_told_of() -> None:
    shipped = {path.parent.name for path in resources.folder("policies").glob("*/config.json")}
    assert shipped == set(re.findall(r"^\| `(\w+)` \| `\w+` \| ", README, re.MULTILINE))
