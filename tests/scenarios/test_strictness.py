"""What the loader refuses, and what it says: file, key, value and expectation, in one line."""

import copy
import re
import tomllib
from datetime import date
from importlib.resources import files
from typing import get_type_hints

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uav_dc_ros import scenarios
from uav_dc_ros.core.channel import FreeSpace
from uav_dc_ros.core.scenario import Scenario, from_values, parse
from uav_dc_ros.errors import ScenarioError, UavDcError

TEXT = (files(scenarios) / "three_clusters_hover.toml").read_text("utf-8")
VALUES = tomllib.loads(TEXT)
TABLES = ("grid", "users", "mission", "radio", "reward")
LEAVES = [("name",), *((table, key) for table in TABLES for key in VALUES[table])]


def with_line(key, new):
    """The shipped file with the line(s) of `key` replaced."""
    text, n = re.subn(rf"(?m)^{key} *=.*$", lambda _: new, TEXT)
    assert n == 1
    return text


def refusal(path):
    """The one line that the loader answers with, without the file's name, which comes first."""
    with pytest.raises(ScenarioError) as caught:
        scenarios.load(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


@pytest.fixture
def refused(tmp_path):
    """What the loader says to a file of this text."""

    def refuse(text):
        path = tmp_path / "mine.toml"
        path.write_text(text, "utf-8")
        return refusal(path)

    return refuse


def test_a_users_own_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        with_line("max_steps", "max_steps = 77").replace("three_clusters_hover", "my_field"), "utf-8"
    )
    for wanted in (path, str(path)):
        scenario = scenarios.load(wanted)
        assert scenario.name == "my_field"
        assert scenario.mission.max_steps == 77
        assert scenario.users == scenarios.load("three_clusters_hover").users


def test_a_users_own_file_in_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "mine.toml").write_text(TEXT, "utf-8")
    monkeypatch.chdir(tmp_path)
    assert scenarios.load("mine.toml") == scenarios.load("three_clusters_hover")


def test_windows_line_ends_and_whole_numbers_for_real_ones(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_bytes(with_line("cell_m", "cell_m = 100").replace("\n", "\r\n").encode())
    scenario = scenarios.load(path)
    assert scenario == scenarios.load("three_clusters_hover")
    assert isinstance(scenario.grid.cell_m, float)


def test_a_cluster_is_in_reach_while_a_cell_reaches_its_disc(refused, tmp_path):
    """75 m beyond the last cell and 100 m down are 125 m."""
    changed = {"users": VALUES["users"] | {"cluster_radius_m": 10.0}, "mission": VALUES["mission"]}
    grid = VALUES["grid"]
    edge_m = (grid["n_x"] - 1) * grid["cell_m"]
    changed["grid"] = grid | {"altitude_min_m": 100.0}
    changed["mission"] |= {"d_cons_m": 125.0}
    for x_m, ok in ((edge_m + 85.0, True), (edge_m + 85.1, False)):
        changed["users"] |= {"cluster_centres_m": [[x_m, 0.0]]}
        if ok:
            from_values(VALUES | changed, "test")
        else:
            with pytest.raises(ScenarioError, match=r"cluster_centres_m\[0\].* is 125\.1 m from the nearest"):
                from_values(VALUES | changed, "test")


def test_a_byte_order_mark_is_no_part_of_the_scenario(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(TEXT, "utf-8-sig")  # as Windows editors write it
    assert scenarios.load(path) == scenarios.load("three_clusters_hover")


@pytest.mark.parametrize(
    ("key", "line", "message"),
    [
        # Mistyped values.
        ("n_x", 'n_x = "11"', "grid.n_x = '11'; expected int, got str"),
        ("n_x", "n_x = 11.0", "grid.n_x = 11.0; expected int, got float"),
        ("n_x", "n_x = true", "grid.n_x = True; expected int, got bool"),
        ("cell_m", 'cell_m = "100"', "grid.cell_m = '100'; expected float, got str"),
        ("cell_m", "cell_m = true", "grid.cell_m = True; expected float, got bool"),
        ("v_max_mps", "v_max_mps = [1.0]", "users.v_max_mps = [1.0]; expected float, got array"),
        ("name", "name = 3", "name = 3; expected str, got int"),
        ("form", "form = 1", "reward.form = 1; expected str, got int"),
        ("step_s", "step_s = 07:32:00", "mission.step_s = datetime.time(7, 32); expected float, got time"),
        (
            "start_m",
            "start_m = [0.0, 0.0]",
            "mission.start_m = [0.0, 0.0]; expected array of length 3, got 2",
        ),
        ("start_m", "start_m = 3.0", "mission.start_m = 3.0; expected array, got float"),
        ("dock_m", 'dock_m = [0.0, "a"]', "mission.dock_m[1] = 'a'; expected float, got str"),
        (
            "cluster_centres_m",
            "cluster_centres_m = [[1, 2], [3]]",
            "users.cluster_centres_m[1] = [3]; expected array",
        ),
        # Out of range.
        ("n_z", "n_z = 0", "grid.n_z = 0; expected int >= 1"),
        ("n_y", "n_y = 1001", "grid.n_y = 1001; expected int <= 1000"),
        ("cell_m", "cell_m = 0.0", "grid.cell_m = 0.0; expected float > 0.0"),
        ("altitude_min_m", "altitude_min_m = -1.0", "grid.altitude_min_m = -1.0; expected float > 0.0"),
        ("users_per_cluster", "users_per_cluster = 0", "users.users_per_cluster = 0; expected int >= 1"),
        ("cluster_radius_m", "cluster_radius_m = 0", "users.cluster_radius_m = 0; expected float > 0.0"),
        ("v_max_mps", "v_max_mps = -0.5", "users.v_max_mps = -0.5; expected float >= 0.0"),
        (
            "cluster_centres_m",
            "cluster_centres_m = []",
            "users.cluster_centres_m = []; expected array of length >= 1",
        ),
        ("step_s", "step_s = 0", "mission.step_s = 0; expected float > 0.0"),
        ("max_steps", "max_steps = 0", "mission.max_steps = 0; expected int >= 1"),
        ("r_min_bits", "r_min_bits = 0", "mission.r_min_bits = 0; expected float > 0.0"),
        ("bandwidth_hz", "bandwidth_hz = 0", "radio.bandwidth_hz = 0; expected float > 0.0"),
        ("tx_power_w", "tx_power_w = -5.0", "radio.tx_power_w = -5.0; expected float > 0.0"),
        (
            "noise_power_dbm",
            "noise_power_dbm = 101.0",
            "radio.noise_power_dbm = 101.0; expected float <= 100.0",
        ),
        ("ref_gain_db", "ref_gain_db = -201.0", "radio.ref_gain_db = -201.0; expected float >= -200.0"),
        (
            "path_loss_exponent",
            "path_loss_exponent = 0.5",
            "radio.path_loss_exponent = 0.5; expected float >= 1.0",
        ),
        ("beta", "beta = -1.0", "reward.beta = -1.0; expected float >= 0.0"),
        ("zeta", "zeta = -1.0", "reward.zeta = -1.0; expected float >= 0.0"),
        ("data_scale_bits", "data_scale_bits = 0.0", "reward.data_scale_bits = 0.0; expected float > 0.0"),
        ("name", 'name = "Mine"', "name = 'Mine'; expected a lower-case letter (a to z), then"),
        ("name", 'name = "a/../b"', "name = 'a/../b'; expected a lower-case letter (a to z), then"),
        ("name", 'name = "a\\n"', "name = 'a\\n'; expected a lower-case letter (a to z), then"),
        # Choices.
        (
            "interference",
            'interference = "al"',
            "radio.interference = 'al'; expected one of all, associated, none",
        ),
        ("form", 'form = "episodic"', "reward.form = 'episodic'; expected one of immediate, episode"),
        ("data", 'data = "mean"', "reward.data = 'mean'; expected one of step, so_far"),
        ("r_plus", 'r_plus = "exp"', "reward.r_plus = 'exp'; expected one of binary, exponential"),
        (
            "episode_end",
            'episode_end = "x"',
            "mission.episode_end = 'x'; expected one of at_time_limit, on_arrival",
        ),
        # Not finite.
        ("cell_m", "cell_m = nan", "grid.cell_m = nan; expected float > 0.0"),
        ("cell_m", "cell_m = inf", "grid.cell_m = inf; expected a finite number"),
        ("beta", "beta = inf", "reward.beta = inf; expected a finite number"),
        ("v_max_mps", "v_max_mps = nan", "users.v_max_mps = nan; expected float >= 0.0"),
        ("ref_gain_db", "ref_gain_db = nan", "radio.ref_gain_db = nan; expected float"),
        ("dock_m", "dock_m = [nan, 0.0]", "mission.dock_m[0] = nan; expected a finite number"),
        (
            "cluster_centres_m",
            "cluster_centres_m = [[1.0, 2.0], [3.0, -inf]]",
            "users.cluster_centres_m[1][1] = -inf; expected a finite number",
        ),
        # Does not fit the rest.
        (
            "start_m",
            "start_m = [50.0, 0.0, 200.0]",
            "mission.start_m = [50.0, 0.0, 200.0]; expected the centre of a cell: "
            "x 0 to 1000 and y 0 to 1000 m in steps of 100, altitude 100 to 200 m in steps of 50",
        ),
        (
            "start_m",
            "start_m = [0.0, 0.0, 250.0]",
            "mission.start_m = [0.0, 0.0, 250.0]; expected the centre",
        ),
        (
            "dock_m",
            "dock_m = [1100.0, 0.0]",
            "mission.dock_m = [1100.0, 0.0]; expected the centre of a cell: x 0 to 1000 and y 0 to 1000 m",
        ),
        ("cell_m", "cell_m = 1e-320", "mission.dock_m = [1000.0, 1000.0]; expected the centre of a cell"),
        ("step_s", "step_s = 1e9", "mission.step_s = 1e+09; expected less than 4.66844e+07, so that"),
        (
            "max_steps",
            "max_steps = 19",
            "mission.max_steps = 19; expected at least 20, the moves from start to dock",
        ),
        (
            "d_cons_m",
            "d_cons_m = 99.0",
            "mission.d_cons_m = 99; expected at least grid.altitude_min_m = 100, or no user can be served",
        ),
        (
            "cluster_centres_m",
            "cluster_centres_m = [[100.0, 100.0], [0.0, 2000.0], [50.0, 50.0]]",
            "users.cluster_centres_m[1] = [0.0, 2000.0]: its disc is ",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) and "=" in value and ";" not in value else "",
)
def test_a_bad_value(refused, key, line, message):
    assert refused(with_line(key, line)).startswith(message)


def test_the_limits_themselves_are_allowed(tmp_path):
    for key, line in (
        ("max_steps", "max_steps = 20"),
        ("d_cons_m", "d_cons_m = 100.0"),
        ("beta", "beta = 0"),
    ):
        path = tmp_path / f"{key}.toml"
        path.write_text(with_line(key, line), "utf-8")
        scenarios.load(path)


@pytest.mark.parametrize(
    ("table", "typo", "meant"),
    [
        ("", "grd", "grid"),
        ("grid", "cel_m", "cell_m"),
        ("users", "v_max", "v_max_mps"),
        ("mission", "maxsteps", "max_steps"),
        ("radio", "bandwith_hz", "bandwidth_hz"),
        ("reward", "betta", "beta"),
    ],
)
def test_an_unknown_key_and_what_was_meant(refused, table, typo, meant):
    text = f"{typo} = 3\n{TEXT}" if not table else TEXT.replace(f"[{table}]", f"[{table}]\n{typo} = 3")
    name = f"{table}.{typo}" if table else typo
    assert refused(text) == f"unknown key {name} = 3; did you mean {meant!r}?"


@pytest.mark.parametrize("table", ["", *TABLES])
def test_an_unknown_key_like_no_other(refused, table):
    text = f"qqqq = 3\n{TEXT}" if not table else TEXT.replace(f"[{table}]", f"[{table}]\nqqqq = 3")
    known = VALUES[table] if table else [*VALUES, "energy", "datum_deg", "obstacles"]
    if table == "radio":
        known = ["model", *get_type_hints(FreeSpace)]
    if table == "users":
        known = [*known, "mobility", "user", "file"]
    name = f"{table}.qqqq" if table else "qqqq"
    assert refused(text) == f"unknown key {name} = 3; expected one of {', '.join(known)}"


@pytest.mark.parametrize("key", ['"a - at `b"', '""', '"a.b"', '"a\\nb"', '"ü"'])
def test_an_unknown_key_that_needs_quotes(refused, key):
    assert refused(TEXT.replace("[grid]", f"[grid]\n{key} = 3")).startswith('unknown key grid."')


def test_an_unknown_table(refused):
    assert refused(f"{TEXT}\n[missions]\n") == "unknown key missions = {}; did you mean 'mission'?"


def test_a_scenario_without_the_data_of_the_reward_counts_the_data_so_far():
    """As those of version 0.1.0 do; it is written in any case."""
    scenario = parse(with_line("data", ""), "old.toml")
    assert scenario == scenarios.load("three_clusters_hover")
    assert msgspec.to_builtins(scenario)["reward"]["data"] == "so_far"


@pytest.mark.parametrize("path", [path for path in LEAVES if path != ("reward", "data")], ids=".".join)
def test_a_missing_key(path):
    values = copy.deepcopy(VALUES)
    table = values if len(path) == 1 else values[path[0]]
    del table[path[-1]]
    with pytest.raises(ScenarioError) as caught:
        from_values(values, "mine.toml")
    assert str(caught.value) == f"mine.toml: missing key {'.'.join(path)}"


@pytest.mark.parametrize("table", TABLES)
def test_a_missing_table(table):
    with pytest.raises(ScenarioError) as caught:
        from_values({name: value for name, value in VALUES.items() if name != table}, "mine.toml")
    assert str(caught.value) == f"mine.toml: missing table {table}"


def test_a_value_where_a_table_belongs(refused):
    assert refused('name = "a"\ngrid = 3\n') == "grid = 3; expected table, got int"


def test_an_empty_file(refused):
    assert refused("") == "missing key name"


@pytest.mark.parametrize("text", ["max_steps 60", "a = [", "[grid]\n[grid]", "\x00", "a = 1" + "0" * 5000])
def test_not_toml(refused, text):
    assert refused(text).startswith("not a TOML file: ")


def test_not_utf_8(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_bytes(b'name = "\xff\xfe"\n')
    assert refusal(path).startswith("cannot be read: 'utf-8' codec can't decode byte 0xff")


def test_an_unreadable_file(tmp_path):
    path = tmp_path / ("x" * 5000)
    assert refusal(path).startswith("cannot be read: ")


@pytest.mark.parametrize(
    "wanted",
    ["six_clusters", "missing/mine.toml", "", "Three_Clusters", "a\0b", "random:", "random:-1", "random:1e3"],
)
def test_no_such_name_or_file(wanted):
    with pytest.raises(ScenarioError) as caught:
        scenarios.load(wanted)
    assert str(caught.value) == (
        f"scenario {wanted!r}: no such name or file; expected one of farm, five_clusters, "
        "five_clusters_hover, three_clusters, three_clusters_hover, town, random:SEED with a whole number, "
        "or the path of a TOML file"
    )


def test_a_directory_instead_of_a_file(tmp_path):
    with pytest.raises(ScenarioError, match=r"no such name or file; expected one of .*TOML file") as caught:
        scenarios.load(tmp_path)
    assert repr(str(tmp_path)) in str(caught.value)


def test_a_caller_can_catch_it_with_everything_else():
    assert issubclass(ScenarioError, UavDcError)


def believed_or_refused(make):
    """The scenario, or None after a refusal in one line of a readable length. Nothing else may happen."""
    try:
        scenario = make()
    except ScenarioError as error:
        message = str(error)
    else:
        assert isinstance(scenario, Scenario)
        return scenario
    assert message.startswith("junk.toml: ")
    assert "\n" not in message
    assert len(message) < 400
    return None


JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.sampled_from([10**400, -(10**20), 2**63, date(2021, 6, 1)]),
    st.floats(),
    st.text(max_size=10),
    st.recursive(
        st.floats() | st.integers(-5, 2000) | st.text(max_size=3),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=6,
    ),
)


@settings(derandomize=True, deadline=None, max_examples=300)
@given(
    places=st.lists(
        st.tuples(
            st.sampled_from([*LEAVES, *((table,) for table in TABLES)])
            | st.tuples(st.sampled_from(TABLES), st.text(max_size=6)),
            JUNK,
        ),
        min_size=1,
        max_size=2,
    )
)
def test_junk_is_a_scenario_or_a_scenario_error(places):
    values = copy.deepcopy(VALUES)
    for path, junk in places:
        table = values if len(path) == 1 else values[path[0]]
        if isinstance(table, dict):
            table[path[-1]] = junk
    scenario = believed_or_refused(lambda: from_values(values, "junk.toml"))
    if scenario is not None:
        # Believed: then everything made from it can be made.
        assert scenario.grid.cell_at(scenario.mission.start_m) == scenario.start_cell
        assert len(scenario.dock_cell) == 2
        assert len(scenario.fingerprint) == 12
        assert from_values(msgspec.to_builtins(scenario), "again") == scenario


@settings(derandomize=True, deadline=None, max_examples=200)
@given(start=st.integers(0, len(TEXT)), length=st.integers(0, 40), junk=st.text(max_size=12))
def test_a_damaged_file_is_a_scenario_or_a_scenario_error(start, length, junk):
    believed_or_refused(lambda: parse(TEXT[:start] + junk + TEXT[start + length :], "junk.toml"))
