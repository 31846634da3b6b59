"""Every problem of a scenario file at once, each with its line."""

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uav_dc_ros import scenarios
from uav_dc_ros.core.keys import leaves, path_of
from uav_dc_ros.core.scenario import parse, read_values
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.scenarios import problems
from uav_dc_ros.scenarios.lines import Lines

TEXT = scenarios.find("five_clusters_hover").read_text("utf-8")
KEYS = [key for key, _ in leaves(read_values(TEXT, "")) if not key.startswith("the number of ")]
TABLES = ("grid", "users", "mission", "radio", "reward")
ENERGY = TEXT + "\n[energy]\nbattery_j = 90e3\n"


def lines_of(text: str) -> list[tuple[int | None, str]]:
    """Line and key of each problem."""
    scenario, found = problems.find(text, Path())
    assert scenario is None
    return [(problem.line, problem.text.partition(" = ")[0].partition(":")[0]) for problem in found]


def line_with(text: str, start: str) -> int:
    """The only line that starts so, counted from 1."""
    (line,) = [i for i, one in enumerate(text.split("\n"), 1) if one.lstrip().startswith(start)]
    return line


@pytest.mark.parametrize("key", KEYS)
def test_each_key_has_its_line(key: str) -> None:
    path = path_of(key)
    line = Lines(TEXT).of(path)
    if path[:2] == ("users", "cluster_centres_m"):
        centres_m = scenarios.load("five_clusters_hover").users.cluster_centres_m
        x_m, y_m = centres_m[path[2]]  # type: ignore[index]
        assert line == line_with(TEXT, f"[{x_m}, {y_m}]")
    else:
        (name,) = [part for part in path[-2:] if isinstance(part, str) and part not in ("grid", "mission")][
            -1:
        ]
        assert line == line_with(TEXT, f"{name} = ")


def test_lines_in_every_form_that_toml_has() -> None:
    text = (
        '# a comment\nname = """\nname = 1\n[grid]\n"""\n"a b".c = 1\ngrid = { n_x = 1, n_y = [\n1,\n2] }\n'
        "[[zones]] # the first\nheight_m = 3\n[[zones]]\n\nheight_m = [\n  [1,\n   2], # [\n  [3]\n]\n"
        "[x.y]\nz = 1"
    )
    places = {
        ("name",): 2,
        ("a b", "c"): 6,
        ("grid", "n_x"): 7,
        ("zones", 0): 10,
        ("zones", 1, "height_m"): 14,
        ("zones", 1, "height_m", 0, 1): 16,
        ("zones", 1, "height_m", 1): 17,
        ("x", "y", "z"): 20,
        ("zones", 1, "base_m"): 12,  # of what is missing: the table
        ("zones", 2): 10,
        ("nothing",): None,
    }
    for newline in ("\n", "\r\n"):
        lines = Lines("\ufeff" + text.replace("\n", newline))
        assert {path: lines.of(path) for path in places} == places


def test_every_value_at_once_each_with_its_line() -> None:
    """Each value but the name is replaced by a text that is no choice."""
    table, bad, expected = "", [], []
    for line in re.sub(r"\[\n.*?\n\]", "[]", TEXT, flags=re.DOTALL).split("\n"):
        table = line.strip("[]") if line.startswith("[") else table
        key = line.partition(" = ")[0]
        if table and key.isidentifier():
            line = f"{key} = '?'"
            expected.append((len(bad) + 1, f"{table}.{key}"))
        bad.append(line)
    assert len(expected) > 25
    assert lines_of("\n".join(bad)) == expected


@pytest.mark.parametrize(
    ("old", "new", "keys"),
    [
        # Combined values, one of each kind; all of a file are reported.
        ("start_m = [0.0", "start_m = [50.0", ["mission.start_m"]),
        ("dock_m = [1000.0", "dock_m = [1100.0", ["mission.dock_m"]),
        ("max_steps = 60", "max_steps = 19", ["mission.max_steps"]),
        ("step_s = 15.0", "step_s = 1e9", ["mission.step_s"]),
        ("d_cons_m = 250.0", "d_cons_m = 99.0", ["mission.d_cons_m"]),
        ("[500.0, 500.0]", "[500.0, 5000.0]", ["users.cluster_centres_m[2]"]),
        ("battery_j = 90e3", "battery_j = 9e3\nends = 'both'", ["energy.battery_j"]),
        ("battery_j = 90e3", "battery_j = 9e3\ncruise_mps = 1.0", ["energy.cruise_mps"]),
        ("battery_j = 90e3", "battery_j = 9e3\ndescent_mps = 99", ["energy.descent_mps"]),
        ("battery_j = 90e3", "battery_j = 90e8\nends = 'battery'", ["mission.max_steps"]),
        # Missing, unknown and misspelt.
        ("beta = 1.0", "", ["missing key reward.beta"]),
        ("beta = 1.0", "qqqq = 1.0", ["unknown key reward.qqqq", "missing key reward.beta"]),
        ("beta = 1.0", "betta = 1.0", ["unknown key reward.betta"]),
        ("beta = 1.0", "betta = -1.0", ["unknown key reward.betta", "reward.beta"]),
        ("battery_j = 90e3", "ends = 'x'", ["missing key energy.battery_j", "energy.ends"]),
        ("battery_j = 90e3", "battery_j = nan", ["energy.battery_j"]),
        # A wrong model reports nothing of the keys that follow from it.
        ("bandwidth_hz", "model = 'x'\ncarrier_hz = 1\nbandwidth_hz", ["radio.model"]),
    ],
)
def test_a_problem_of_each_kind(old: str, new: str, keys: list[str]) -> None:
    text = ENERGY.replace(old, new, 1)
    found = lines_of(text)
    assert sorted(key for _, key in found) == sorted(keys)
    for line, key in found:
        name = key.removeprefix("missing key ").removeprefix("unknown key ").rpartition(".")[2]
        start = {"missing": f"[{key.split()[-1].partition('.')[0]}]", "users.c": "[500.0, 5000.0]"}
        if key == "reward.beta":
            name = "betta"
        assert line == line_with(text, start.get(key[:7], f"{name} = "))


def test_problems_that_do_not_depend_on_one_another_come_together() -> None:
    text = TEXT.replace("dock_m = [1000.0", "dock_m = [1050.0").replace(
        "[0.0, 0.0, 200.0]", "[0.0, 0.0, 1.0]"
    )
    text = text.replace("beta = 1.0", "beta = -1.0").replace("[800.0, 200.0]", "[8000.0, 200.0]")
    assert [key for _, key in lines_of(text)] == [
        *("users.cluster_centres_m[3]", "mission.start_m", "mission.dock_m", "reward.beta")
    ]


def test_problems_of_obstacles_have_the_lines_of_theirs() -> None:
    first = "[[obstacles]]\nheight_m = 50.0\npolygon_m = [[300.0, 300.0], [400.0, 300.0], [400.0, 400.0]]\n"
    second = "[[obstacles]]\nkind = 'tree'\nheight_m = -1\nbase = 3\npolygon_m = [[1.0, 2.0]]\n"
    start = TEXT.count("\n") + 1
    assert lines_of(TEXT + first + second) == [
        (start + 4, "obstacles[1].kind"),
        (start + 5, "obstacles[1].height_m"),
        (start + 6, "unknown key obstacles[1].base"),
        (start + 7, "obstacles[1].polygon_m"),
    ]
    crossing = first.replace("[400.0, 400.0]]", "[400.0, 400.0], [300.0, 280.0], [390.0, 420.0]]")
    misplaced = TEXT.replace("dock_m = [1000.0", "dock_m = [1050.0")
    found = lines_of(misplaced + crossing)
    assert (line_with(misplaced, "dock_m = "), "mission.dock_m") in found


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", [(None, "missing key name"), *((None, f"missing table {table}") for table in TABLES)]),
        ("a = [\n1\n", [(3, "not a TOML file")]),
        ("a = 1\nb = \nc = 1", [(2, "not a TOML file")]),
        (TEXT + "[grid]", [(len(TEXT.split("\n")), "not a TOML file")]),
        (TEXT.replace("[reward]", "[rewards]"), [(line_with(TEXT, "[reward]"), "unknown key rewards")]),
        (TEXT.replace("[grid]", "[rid]\n", 1), [(line_with(TEXT, "[grid]"), "unknown key rid")]),
    ],
)
def test_files_that_lack_much(text: str, expected: list[tuple[int | None, str]]) -> None:
    assert lines_of(text) == expected


def test_a_table_that_is_none_hides_what_it_lacks() -> None:
    found = lines_of(f"name = 'a'\ngrid = 3\n{TEXT[TEXT.index('[users]') :]}")
    assert found == [(2, "grid")]


def test_of_very_many_problems_the_first() -> None:
    centres = "[" + ",\n".join("[1.0]" for _ in range(500)) + "]"
    _, found = problems.find(
        f"{TEXT[: TEXT.index('cluster_centres_m')]}cluster_centres_m = {centres}", Path()
    )
    assert len(found) == problems.PROBLEMS_MAX


@settings(derandomize=True, deadline=None, max_examples=40)
@given(start=st.integers(0, len(TEXT)), length=st.integers(0, 40), junk=st.text(max_size=12))
def test_a_damaged_file_has_problems_where_parse_has_an_error(start: int, length: int, junk: str) -> None:
    text = TEXT[:start] + junk + TEXT[start + length :]
    scenario, found = problems.find(text, Path())
    if scenario is not None:
        assert found == []
        assert parse(text, "f.toml") == scenario
    else:
        with pytest.raises(ScenarioError) as caught:
            parse(text, "f.toml")
        assert str(caught.value).removeprefix("f.toml: ") in {problem.text for problem in found}
    n_lines = text.count("\n") + 1
    assert all(problem.line is None or 1 <= problem.line <= n_lines for problem in found)
    assert all("\n" not in problem.within("f.toml") for problem in found)
