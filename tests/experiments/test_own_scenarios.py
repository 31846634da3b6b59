"""Making, checking and drawing scenarios."""

import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.conftest import ROOT
from tests.support.worlds import changed, tiny
from uav_dc_ros import scenario as command
from uav_dc_ros import scenarios
from uav_dc_ros.core import world
from uav_dc_ros.core.keys import leaves
from uav_dc_ros.core.scenario import Scenario, parse, read_values
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.experiments.scenarios.rate_map import rate_map, scale_bar_m
from uav_dc_ros.planners import PLANNERS
from uav_dc_ros.scenarios.generation import document, field, flyable

FIVE = scenarios.find("five_clusters_hover").read_text("utf-8")


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Runs `scenario`; exit status, standard output, and standard error."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        command.main([str(one) for one in arguments])
    assert isinstance(ended.value.code, int)
    return ended.value.code, *capsys.readouterr()


def check_random_field(seed: int) -> None:
    """Valid, apart and within the grid; flyable by other missions than those that its budget was set with."""
    scenario = field.at_random(seed)
    assert parse(document.text(scenario), "") == scenario
    assert flyable.examine(scenario).problems == ()
    missions = roll_out(scenario, PLANNERS["fixed_tour"](scenario), range(100, 105))
    assert missions.landed.all(), seed
    assert missions.users_collected.mean() > 0.8 * scenario.n_users, seed
    centres_m, radius_m = scenario.cluster_centres_m, scenario.users.clusters[0].radius_m
    apart_m = [math.dist(a, b) for i, a in enumerate(centres_m) for b in centres_m[:i]]
    assert min(apart_m, default=math.inf) > 2.0 * radius_m, seed
    grid = scenario.grid
    for at_m, n in (
        (at_m, n) for centre_m in centres_m for at_m, n in zip(centre_m, grid.shape, strict=False)
    ):
        assert radius_m <= at_m <= (n - 1) * grid.cell_m - radius_m, seed


@pytest.mark.parametrize("seed", range(6))
def test_a_random_field_can_be_flown(seed: int) -> None:
    check_random_field(seed)


@pytest.mark.long
def test_two_hundred_random_fields_can_be_flown() -> None:
    for seed in range(200):
        check_random_field(seed)


def test_equal_seeds_give_equal_bytes_and_others_other_fields() -> None:
    made = [
        subprocess.run(
            [sys.executable, "-m", "uav_dc_ros.scenario", "random", "--seed", str(seed)],
            capture_output=True, check=True, cwd=ROOT,
        ).stdout
        for seed in (5, 5)
    ]  # fmt: skip
    assert made[0] == made[1]
    text = made[0].decode()
    assert text.startswith("# Made by: uav-dc scenario random --seed 5\n")
    assert parse(text, "") == field.at_random(5)
    assert len({field.at_random(seed).fingerprint for seed in range(5)}) == 5


def test_a_random_field_has_a_name_everywhere(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    status, made, _ = run(capsys, "random", "--seed", 5)
    assert (status, made) == (0, scenarios.read("random:5"))
    assert run(capsys, "show", "random:5")[:2] == (0, made)
    assert scenarios.load("random:5") == field.at_random(5)
    status, out, _ = run(capsys, "check", "random:5")
    assert (status, out.startswith("random:5: ")) == (0, True)
    monkeypatch.chdir(tmp_path)
    names = ("random:5", "farm", "own.toml", "random:x")
    assert [scenarios.from_anywhere(one) for one in names] == [
        *names[:2],
        *(str(tmp_path / one) for one in names[2:]),
    ]


def test_what_is_given_is_not_drawn() -> None:
    scenario = field.at_random(3, n_clusters=4, users_per_cluster=7, size_m=(1500.0, 800.0), name="mine")
    grid = scenario.grid
    assert (scenario.name, scenario.n_clusters, scenario.n_users) == ("mine", 4, 28)
    assert ((grid.n_x - 1) * grid.cell_m, (grid.n_y - 1) * grid.cell_m) == (1500.0, 800.0)


@settings(derandomize=True, deadline=None, max_examples=6)
@given(
    clusters=st.integers(1, 12),
    users=st.sampled_from([1, 2, 10, 40]),
    size_m=st.tuples(st.floats(100.0, 5000.0), st.floats(100.0, 5000.0)),
)
def test_an_even_field_can_be_flown_or_has_no_room(
    clusters: int, users: int, size_m: tuple[float, float]
) -> None:
    try:
        scenario = field.even("even", clusters, users, size_m)
    except ParameterError as error:
        message = str(error)
    else:
        message = ""
    if message:
        assert re.match(rf"{clusters} clusters in .* m; expected fewer", message)
        return
    assert (scenario.n_clusters, scenario.users.users_per_cluster) == (clusters, users)
    assert flyable.examine(scenario).problems == ()
    grid = scenario.grid
    for given_m, n in zip(size_m, grid.shape, strict=False):
        assert abs(given_m - (n - 1) * grid.cell_m) <= grid.cell_m


ENERGY = {"battery_j": 9e4, "ends": "both", "cruise_mps": 12.5}
URBAN = {"model": "air_to_ground", "bandwidth_hz": 1e6, "tx_power_w": 0.1, "noise_power_dbm": -110.0}
URBAN |= {"carrier_hz": 2e9, "environment": "urban", "line_of_sight": "mean_gain", "interference": "none"}


@pytest.mark.parametrize(
    "scenario",
    [
        *map(scenarios.load, scenarios.names()),
        changed("five_clusters_hover", energy=ENERGY),
        tiny(mission={"r_min_bits": 1e-7 / 3}),
    ],
    ids=lambda scenario: scenario.name,
)
def test_the_text_of_a_scenario_is_the_scenario_and_explains_each_key(scenario: Scenario) -> None:
    text = document.text(scenario, "a header\nof two lines")
    assert text.startswith("# a header\n# of two lines\n\nname = ")
    assert parse(text, "") == scenario
    assert parse(text, "").fingerprint == scenario.fingerprint
    keys = {key.partition("[")[0] for key, _ in leaves(read_values(text, "")) if " " not in key}
    assert {key for key in keys if not key.startswith("energy.")} <= {*document.COMMENTS, "users.user"}
    assert max(map(len, text.splitlines())) <= document.WIDTH


def test_the_commented_battery_is_valid() -> None:
    text = document.text(scenarios.load("five_clusters_hover"))
    with_battery = (
        text.replace("# [energy]", "[energy]").replace("# battery_j", "battery_j").replace("# ends", "ends")
    )
    scenario = parse(with_battery, "")
    assert scenario.energy is not None
    assert flyable.examine(scenario).problems == ()


def test_tables_and_texts_of_any_kind_can_be_written() -> None:
    values = {"a": 'x"\n\x7fü', "b": {"c": True, "d": {"e": 1e-9}}, "f": [{"g": [[1.5, 2.0]]}, {"g": []}]}
    lines = document._table(values, ())
    assert read_values("\n".join(lines), "") == values


def test_new_writes_the_shipped_field_or_one_of_other_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "My Field-2.toml"
    status, out, err = run(capsys, "new", path)
    assert (status, err) == (0, "")
    assert out.startswith(f"{path}: 50 users in 5 clusters")
    made = scenarios.load(path)
    assert made.name == "my_field_2"
    shipped = scenarios.load("five_clusters_hover")
    assert (made.grid, made.users, made.mission, made.radio) == (
        *(shipped.grid, shipped.users, shipped.mission, shipped.radio),
    )
    assert run(capsys, "check", path)[0] == 0
    status, _, err = run(capsys, "new", path)
    assert (status, err) == (2, f"python -m uav_dc_ros.scenario: {path} exists; expected a new file\n")
    status, out, _ = run(capsys, "new", "--clusters", "3", "--size", "900x600")
    made = parse(out, "")
    assert out.startswith("# Made by: uav-dc scenario new --clusters 3 --size 900x600\n")
    assert (made.name, made.n_clusters, made.users.users_per_cluster) == ("my_field", 3, 10)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("new", "--clusters", "0"), "argument --clusters: '0'; expected 1 to 50"),
        (("new", "--users", "1001"), "argument --users: '1001'; expected 1 to 1000"),
        (("new", "--size", "50"), "argument --size: '50'; expected metres from 100 to 100000"),
        (("new", "--size", "800x"), "argument --size: '800x'; expected metres"),
        (("new", "--size", "nan"), "argument --size: 'nan'; expected metres"),
        (("new", "--clusters", "50", "--size", "500x100"), "50 clusters in 500 x 100 m; expected fewer"),
        (("random",), "the following arguments are required: --seed"),
        (("random", "--seed", "1", "--clusters", "50", "--size", "5000x100"), "50 clusters in 5000 x 100 m;"),
        (("random", "--seed", "1", "no/folder.toml"), "no/folder.toml cannot be written: No such file"),
        (("check", "nowhere.toml"), "scenario 'nowhere.toml': no such name or file"),
        (("draw", "five_clusters_hover", "--out", "a.gif"), "--out a.gif; expected a name that ends in .png"),
        (("draw", "five_clusters_hover", "--out", "no/map.png"), "no/map.png cannot be written"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_and_status_2(
    arguments: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run(capsys, *arguments)
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert expected in err


def line_of(text: str, start: str) -> int:
    """The only line that starts so, counted from 1."""
    (line,) = [i for i, one in enumerate(text.split("\n"), 1) if one.lstrip().startswith(start)]
    return line


@pytest.mark.parametrize(
    ("old", "new", "line", "problem"),
    [
        (
            "[800.0, 700.0]",
            "[1150.0, 700.0]",
            "[1150.0",
            r"users\.cluster_centres_m\[4\] = \[1150\.0, 700\.0\]: 88% of its disc is in reach of a cell "
            r"with mission\.d_cons_m = 250; expected all of it, as with 288$",
        ),
        (
            "max_steps = 60",
            "max_steps = 22",
            "max_steps",
            r"mission\.max_steps = 22: a tour collects no user of users\.cluster_centres_m\[0\], .*; "
            r"expected at least 5\d, the steps of a tour of all clusters$",
        ),
        (
            "r_min_bits = 6e6",
            "r_min_bits = 6e9",
            "r_min_bits",
            r"mission\.r_min_bits = 6e\+09: even flights to one cluster alone collect no user of "
            r"users\.cluster_centres_m\[0\], .*; expected at most \d\.?\d*e\+08, what one of its users",
        ),
        (
            "[reward]",
            "[energy]\nbattery_j = 90e3\n[reward]",
            "battery_j",
            r"energy\.battery_j = 90000: a mission takes 1\d{5}(\.\d+)? J; expected at least that, or "
            r"energy\.ends = 'both'$",
        ),
    ],
    ids=["coverage", "steps", "data", "battery"],
)
def test_a_problem_of_each_kind_has_its_line(
    old: str, new: str, line: str, problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, text = tmp_path / "own.toml", FIVE.replace(old, new, 1)
    path.write_text(text, "utf-8")
    status, out, err = run(capsys, "check", path)
    assert status == 1
    assert out.startswith(f"{path}: 50 users in 5 clusters")
    assert "\ntour: lands in 10 of 10 missions, collects " in out
    prefix = f"{path}:{line_of(text, line)}: "
    assert any(
        one.startswith(prefix) and re.match(problem, one[len(prefix) :]) for one in err.splitlines()
    ), err
    assert f"problems: {err.count(chr(10))}\n" in out


LISTED = (
    FIVE[: FIVE.index("[users]")]
    + "[users]\nfile = 'users.csv'\nv_max_mps = 1.0\n"
    + FIVE[FIVE.index("[mission]") :]
)


def test_users_of_a_file_are_checked_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, users = tmp_path / "own.toml", tmp_path / "users.csv"
    path.write_text(LISTED, "utf-8")
    users.write_text(
        "x_m,y_m,name,cluster,radius_m\n200,300,a,east,30\n250,300,,east,\n1040,500,far,,300\n", "utf-8"
    )
    line = line_of(LISTED, "file = ")
    status, out, err = run(capsys, "check", path)
    assert (status, err.count("\n")) == (1, 1)
    assert "3 users in 2 clusters" in out
    assert re.match(
        rf"{path}:{line}: users\.user\[2\] \(far\) = \[1040\.0, 500\.0\]: 87% of its disc is in", err
    )
    assert run(capsys, "draw", path, "--out", tmp_path / "map.png")[0] == 0
    assert run(capsys, "draw", path, "--out", tmp_path / "map.html")[0] == 0
    users.write_text("x_m,y_m\n200,east\n", "utf-8")
    path.write_text(LISTED.replace("beta = 1.0", "beta = -1.0"), "utf-8")
    status, out, err = run(capsys, "check", path)
    assert (status, out) == (2, "")
    assert err.splitlines() == [
        f"{path}:{line}: {users}, line 2: y_m = 'east'; expected a finite number, such as 12.5",
        f"{path}:{line_of(LISTED, 'beta = ')}: reward.beta = -1.0; expected float >= 0.0",
    ]
    listed = changed(
        "five_clusters_hover",
        users={"user": [{"x_m": 1.0, "y_m": 2.0, "name": "a"}]}
        | dict.fromkeys(("cluster_centres_m", "users_per_cluster", "cluster_radius_m")),
    )
    assert parse(document.text(listed), "") == listed


def csv_of_users(degrees: bool) -> str:
    """Thirty users: four clusters of six, and six alone."""
    rng = np.random.default_rng(4)
    rows = [("name", "latitude", "longitude") if degrees else ("name", "y_m", "x_m")]
    for i in range(30):
        north, east = rng.random(2) if i >= 24 else 0.1 + 0.2 * (i % 4) + 0.05 * rng.random(2)
        at = (47.39 + 0.008 * north, 8.53 + 0.012 * east) if degrees else (900.0 * north, 900.0 * east)
        rows.append((f"u{i}", *(f"{value:.6f}" for value in at)))
    clusters = ["cluster", *(f"c{i % 4}" if i < 24 else "" for i in range(30))]
    return "".join(f"{','.join(row)},{cluster}\n" for row, cluster in zip(rows, clusters, strict=True))


@pytest.mark.parametrize("degrees", [True, False], ids=["degrees", "metres"])
def test_a_field_around_the_users_of_a_file(
    degrees: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    users, path = tmp_path / "data" / "users.csv", tmp_path / "own.toml"
    users.parent.mkdir()
    users.write_text(csv_of_users(degrees), "utf-8")
    status, out, err = run(capsys, "import", users, "--out", path)
    assert (status, err) == (0, "")
    assert out.startswith(f"{path}: 30 users in 10 clusters, ")
    text = path.read_text("utf-8")
    assert 'file = "data/users.csv"' in text
    scenario = scenarios.load(path)
    assert (scenario.datum_deg is not None) is degrees
    centres_m = np.asarray(scenario.user_centres_m)
    assert centres_m.min() >= 0.0
    assert centres_m.min() < 2.0 or not degrees, "the grid begins where the users do"
    assert flyable.examine(scenario).problems == ()
    assert run(capsys, "check", path)[0] == 0
    missions = roll_out(scenario, PLANNERS["fixed_tour"](scenario), range(2))
    assert missions.landed.all()
    assert missions.users_collected.mean() >= 27.0


TOWER = {"polygon_m": [[-40.0, -40.0], [60.0, -40.0], [60.0, 60.0], [-40.0, 60.0]], "height_m": 120.0}
ZONE = {
    "kind": "no_fly",
    "name": "school",
    "polygon_m": [[350.0, 0.0], [450.0, 0.0], [450.0, 400.0], [350.0, 400.0]],
}


def test_a_field_among_obstacles_is_checked_and_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    users = [{"x_m": 100.0 * i + 90.0, "y_m": 60.0 * i} for i in range(10)]
    scenario = field.around("town", users, None, [TOWER, ZONE])
    assert scenario.mission.start_m[:2] != (0.0, 0.0), "the tower stands there"
    found = flyable.examine(scenario)
    assert found.problems == ()
    missions = roll_out(scenario, PLANNERS["fixed_tour"](scenario), range(2))
    assert missions.landed.all()
    ground_m = np.asarray([[0.0, 0.0], [400.0, 300.0]])
    near_m = flyable.nearest_cells_m(scenario, ground_m)
    assert scenario.moves is not None
    cells = [scenario.grid.cell_at(tuple(one)) for one in near_m]
    assert all(cell is not None and scenario.moves.free[cell] for cell in cells)
    rates = rate_map(scenario)
    assert [int(np.isnan(layer.sum_rate_bps).sum()) for layer in rates.layers] == [
        int((~scenario.moves.free[..., up]).sum()) for up in range(3)
    ]
    path = tmp_path / "town.toml"
    path.write_text(document.text(scenario), "utf-8")
    assert scenarios.load(path) == scenario
    assert run(capsys, "check", path)[0] == 0
    for name in ("map.png", "map.html"):
        assert run(capsys, "draw", path, "--out", tmp_path / name)[0] == 0


def ring(latitude: float, longitude: float, side: float) -> list[list[float]]:
    """A closed square of a GeoJSON polygon."""
    corners = ((0.0, 0.0), (side, 0.0), (side, side), (0.0, side), (0.0, 0.0))
    return [[longitude + east, latitude + north] for east, north in corners]


def test_a_field_among_zones_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    users, zones, path = tmp_path / "users.csv", tmp_path / "zones.geojson", tmp_path / "own.toml"
    users.write_text(csv_of_users(degrees=True), "utf-8")
    features = [
        {
            "type": "Feature",
            "properties": {"name": name},
            "geometry": {"type": "Polygon", "coordinates": [at]},
        }
        for name, at in (("school", ring(47.392, 8.534, 0.0008)), ("farm", ring(47.395, 8.537, 0.001)))
    ]
    zones.write_text(json.dumps({"type": "FeatureCollection", "features": features}), "utf-8")
    status, _, err = run(capsys, "import", users, "--zones", zones, "--out", path)
    assert (status, err) == (0, "")
    text = path.read_text("utf-8")
    assert 'zones = "zones.geojson"' in text
    scenario = scenarios.load(path)
    assert [one.name for one in scenario.obstacles] == ["school", "farm"]
    assert run(capsys, "check", path)[0] == 0
    # An error of the zones has the line of their file's name, beside other problems.
    features[1]["geometry"]["coordinates"] = [ring(47.395, 8.537, 0.0)]  # type: ignore[index]
    zones.write_text(json.dumps({"type": "FeatureCollection", "features": features}), "utf-8")
    path.write_text(text.replace("beta = 1.0", "beta = -1.0"), "utf-8")
    status, _, err = run(capsys, "check", path)
    assert status == 2
    assert f"{path}:{line_of(text, 'beta = ')}: reward.beta = -1.0" in err
    assert f"{path}:{line_of(text, 'zones = ')}: " in err


ZONES = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "properties": {"name": "school"},
            "geometry": {"type": "Polygon", "coordinates": [ring(47.392, 8.534, 0.0008)]},
        }
    ],
}
METRES = "x_m,y_m\n60,90\n700,80\n650,600\n"
DEGREES = "latitude,longitude\n47.391,8.531\n47.391,8.539\n47.395,8.538\n"


@pytest.mark.parametrize("content", [METRES, DEGREES], ids=["metres", "degrees"])
def test_a_datum_puts_the_grid_on_the_earth(
    content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    users, zones, path = tmp_path / "users.csv", tmp_path / "zones.geojson", tmp_path / "own.toml"
    users.write_text(content, "utf-8")
    zones.write_text(json.dumps(ZONES), "utf-8")
    arguments = ("import", users, "--datum", "47.3901,8.53", "--zones", zones, "--out", path)
    assert run(capsys, *arguments)[::2] == (0, "")
    scenario = scenarios.load(path)
    assert scenario.datum_deg == (47.3901, 8.53)
    assert f"{users} --datum 47.3901,8.53 --zones {zones}\n" in path.read_text("utf-8")
    east_m, north_m = scenario.obstacles[0].polygon_m[0]
    a_degree_m = 111_200.0  # of latitude; within a part in 200
    assert north_m == pytest.approx(0.0019 * a_degree_m, rel=5e-3)
    assert east_m == pytest.approx(0.004 * a_degree_m * math.cos(math.radians(47.39)), rel=5e-3)
    if content == METRES:
        assert scenario.user_centres_m[0] == (60.0, 90.0)
    assert flyable.examine(scenario).problems == ()


@pytest.mark.parametrize(
    ("content", "datum", "expected"),
    [
        (METRES, None, "positions in degrees beside users in metres; expected --datum LAT,LON"),
        (METRES, "8.53,47.39", "zones.geojson: own: obstacles[0] 'school': its polygon lies outside"),
        (METRES, "-8.53,47.39", "with the grid at --datum -8.53,47.39"),
        (METRES, "here", "--datum: 'here'; expected LAT,LON: latitude from -90 to 90"),
        (METRES, "47.39", "--datum: '47.39'; expected LAT,LON"),
        (METRES, "47.39,8.53,488", "--datum: '47.39,8.53,488'; expected LAT,LON"),
        (METRES, "nan,8.53", "--datum: 'nan,8.53'; expected LAT,LON"),
        (METRES, "47.39,190", "--datum: '47.39,190'; expected LAT,LON"),
        (DEGREES, "47.392,8.53", "south edge, with the grid at --datum 47.392,8.53"),
    ],
)
def test_a_datum_that_does_not_fit(
    content: str, datum: str | None, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    users, zones = tmp_path / "users.csv", tmp_path / "zones.geojson"
    users.write_text(content, "utf-8")
    zones.write_text(json.dumps(ZONES), "utf-8")
    given = ("--datum", datum) if datum else ()
    status, out, err = run(capsys, "import", users, *given, "--zones", zones, "--out", tmp_path / "own.toml")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert expected in err
    assert not (tmp_path / "own.toml").exists()


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("x_m,y_m\n-5,3\n", "x_m from -5 to -5; expected 0 to 100000 m from the west edge"),
        ("x_m,y_m\n5,3e6\n", "y_m from 3e+06 to 3e+06; expected 0 to 100000 m from the south edge"),
        (
            "x_m,y_m,data_bits\n5,3,1e12\n",
            "a tour cannot collect these users; expected fewer, less data_bits",
        ),
        ("latitude,longitude\n47,8\n-47,8\n", "y_m from "),
        ("x_m\n5\n", "line 1: no column y_m; expected x_m and y_m, or latitude and longitude"),
        ("", "no header; expected the columns x_m and y_m"),
    ],
)
def test_users_around_which_there_is_no_field(
    content: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    users = tmp_path / "users.csv"
    users.write_text(content, "utf-8")
    status, out, err = run(capsys, "import", users, "--out", tmp_path / "own.toml")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert f"{users}" in err
    assert expected in err
    assert not (tmp_path / "own.toml").exists()


def test_users_of_one_place_are_asked_for_the_same_whether_they_are_a_cluster_or_not() -> None:
    """They interfere all the same."""
    at_m = [(x, y) for x in (300.0, 320.0, 340.0) for y in (500.0, 530.0)] + [(900.0, 900.0)]
    users = [{"x_m": x, "y_m": y} for x, y in at_m]
    together = [user | {"cluster": "yard"} for user in users[:-1]] + users[-1:]
    alone, clustered = (field.around("own", some, None) for some in (users, together))
    assert (alone.n_clusters, clustered.n_clusters) == (7, 2)
    assert alone.mission.r_min_bits == clustered.mission.r_min_bits
    spread = [{"x_m": 400.0 * i, "y_m": 400.0 * i} for i in range(3)]
    assert field.around("own", spread, None).mission.r_min_bits > alone.mission.r_min_bits


def test_a_check_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "check", "three_clusters_hover", "--json")
    found = json.loads(out)
    assert (status, err, found["problems"], found["valid"]) == (0, "", [], True)
    assert found["fingerprint"] == scenarios.load("three_clusters_hover").fingerprint
    assert "three_clusters_hover_dueling" in found["policies"]
    assert (found["tour"]["landed"], found["tour"]["missions"]) == (10, 10)
    assert sum(cluster["collected"] for cluster in found["clusters"]) == pytest.approx(
        found["tour"]["collected"]
    )
    path = tmp_path / "own.toml"
    path.write_text(FIVE.replace("max_steps = 60", "max_steps = 0"), "utf-8")
    status, out, err = run(capsys, "check", path, "--json", tmp_path / "found.json")
    assert (status, out) == (2, "")
    line = line_of(FIVE, "max_steps = ")
    assert err == f"{path}:{line}: mission.max_steps = 0; expected int >= 1\n"
    assert json.loads((tmp_path / "found.json").read_bytes()) == {
        "file": str(path),
        "valid": False,
        "problems": [{"line": line, "text": "mission.max_steps = 0; expected int >= 1"}],
    }


def test_what_a_tour_collects_is_what_evaluate_reports() -> None:
    for scenario in (
        scenarios.load("five_clusters_hover"),
        changed("five_clusters_hover", mission={"episode_end": "on_arrival"}),
        changed("five_clusters_hover", energy={"battery_j": 1e5, "ends": "both"}),
    ):
        found = flyable.examine(scenario, range(5)).tour
        missions = roll_out(scenario, PLANNERS["fixed_tour"](scenario), range(5))
        assert (found.missions, found.landed) == (5, missions.landed.sum())
        assert found.collected == pytest.approx(missions.users_collected.mean())
        assert found.docked_step == pytest.approx(np.nanmean(missions.arrival_step))
        if missions.energy_used_j is not None:
            assert found.energy_used_j == missions.energy_used_j.max()


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    points=st.lists(st.tuples(st.floats(-900, 1900), st.floats(-900, 1900)), min_size=1, max_size=20),
    n_x=st.integers(1, 11),
)
def test_the_nearest_cell_is_the_nearest_of_all(points: list[tuple[float, float]], n_x: int) -> None:
    scenario = tiny(
        grid={"n_x": n_x + 2, "n_y": 4, "n_z": 2, "cell_m": 70.0}, mission={"dock_m": [140.0, 140.0]}
    )
    grid = scenario.grid
    cells = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    centres_m = grid.centre_m(cells, like=np.zeros(1))
    ground_m = np.asarray([(x, y, 0.0) for x, y in points])
    expected = np.linalg.norm(ground_m[:, None] - centres_m, axis=-1).min(axis=1)
    np.testing.assert_allclose(flyable.nearest_cell_m(scenario, ground_m[:, :2]), expected, rtol=1e-12)


def test_half_of_a_disc_is_in_reach() -> None:
    """A chord through its centre divides it: the reach ends 100 m beyond the edge, where the centre is."""
    edge_m, radius_m = 1000.0, 5.0
    centre_m = (edge_m + 100.0, 500.0)
    mission = {"d_cons_m": math.hypot(100.0, 100.0)}
    users = {"cluster_centres_m": [centre_m], "cluster_radius_m": radius_m}
    share, needed_m = flyable.reach(
        changed("five_clusters_hover", users=users, mission=mission), centre_m, radius_m
    )
    assert share == pytest.approx(0.5, abs=0.03)
    assert needed_m == pytest.approx(math.hypot(105.0, 100.0), abs=0.01)


def test_a_cluster_that_cannot_be_collected_has_no_tour_without_a_limit() -> None:
    assert flyable.steps_of_tour(scenarios.load("five_clusters_hover"), range(5)) == pytest.approx(
        50.0, abs=1.5
    )
    assert (
        flyable.steps_of_tour(changed("five_clusters_hover", mission={"r_min_bits": 1e10}), range(2)) is None
    )


def test_the_rate_over_a_cell_is_that_of_the_world() -> None:
    scenario = changed("five_clusters_hover", users={"users_per_cluster": 3})
    rates = rate_map(scenario)
    states = [
        world.initial(scenario, np.random.default_rng(seed).random(scenario.draws_shape))
        for seed in range(rates.missions)
    ]
    uav_m = np.asarray([300.0, 200.0, 150.0])
    expected = [world.measure(scenario, uav_m, one.users_m, one.collected).sum_rate_bps for one in states]
    layer = rates.layers[1]
    east, north = list(rates.east_m).index(300.0), list(rates.north_m).index(200.0)
    assert layer.altitude_m == 150.0
    assert layer.sum_rate_bps[east, north] == pytest.approx(np.mean(expected), rel=1e-12)
    assert layer.reach_m == pytest.approx(200.0)
    np.testing.assert_array_equal(rates.users_m, states[0].users_m)


def test_of_a_large_field_some_cells_are_drawn_with_both_edges() -> None:
    scenario = tiny(
        grid={"n_x": 300, "n_y": 2, "n_z": 20, "altitude_step_m": 1.0}, mission={"dock_m": [200.0, 100.0]}
    )
    rates = rate_map(scenario)
    assert (len(rates.east_m), len(rates.north_m), len(rates.layers)) == (60, 2, 6)
    assert (rates.east_m[0], rates.east_m[-1]) == (0.0, 29_900.0)
    assert rates.layers[-1].altitude_m == 119.0


@given(st.floats(1e-3, 1e7))
def test_a_scale_bar_is_round_and_fits(wide_m: float) -> None:
    length_m = scale_bar_m(wide_m)
    assert wide_m / 12 < length_m <= wide_m / 4 * (1 + 1e-9)
    assert f"{length_m:.0e}"[0] in "125"


def test_equal_scenarios_give_equal_pictures_and_pages(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = tiny(users={"cluster_centres_m": [[450.0, 0.0]]})  # part of it is out of reach
    (tmp_path / "own.toml").write_text(document.text(scenario), "utf-8")
    for name, start in (("map.png", b"\x89PNG"), ("map.html", b"<!doctype html>")):
        out = tmp_path / name
        contents = []
        for _ in range(2):
            assert run(capsys, "draw", tmp_path / "own.toml", "--out", out) == (0, f"{out}\n", "")
            contents.append(out.read_bytes())
        assert contents[0] == contents[1]
        assert contents[0].startswith(start)


@pytest.mark.parametrize(("library", "out"), [("matplotlib", "map.png"), ("plotly", "map.html")])
def test_drawing_names_the_library_that_is_missing(library: str, out: str, tmp_path: Path) -> None:
    program = (
        f"import sys; sys.modules[{library!r}] = None\n"
        "from uav_dc_ros import scenario\n"
        f"scenario.main(['draw', 'three_clusters_hover', '--out', {out!r}])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False,
        env={"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 2
    assert library in done.stderr
    assert "pip install" in done.stderr
    assert done.stderr.count("\n") == 1
