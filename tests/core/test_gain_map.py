"""The channel `gain_map`: a table of free space, interpolation, place, and unsuitable files."""

import hashlib
import json
import re
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from tests.core.test_world import flight, fly
from tests.support.worlds import tiny
from uav_dc_ros import scenario as check
from uav_dc_ros import scenarios
from uav_dc_ros.core import channel, radio, world
from uav_dc_ros.core.mobility import GaussMarkov, RandomWaypoint, Static
from uav_dc_ros.core.propagation import gain_map
from uav_dc_ros.core.scenario import from_values
from uav_dc_ros.errors import ScenarioError

TINY = tiny()
# Of the only cluster, at (100, 0): its disc, and the farthest walk.
REACH_M = TINY.users.cluster_radius_m + TINY.users.v_max_mps * TINY.mission.step_s * TINY.mission.max_steps
X_M = np.linspace(100.0 - REACH_M, 100.0 + REACH_M, 261)
Y_M = np.linspace(-REACH_M, REACH_M, 271)
REF_GAIN_DB = -50.0


def free_space_db(grid, x_m=X_M, y_m=Y_M):
    """The path gains of the paper's channel, `[X, Y, Z, I, J]`, dB."""
    cells = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1)
    uav_m = grid.centre_m(cells, like=np.zeros(0))[..., None, None, :]
    square_m2 = (uav_m[..., 0] - x_m[:, None]) ** 2 + (uav_m[..., 1] - y_m) ** 2 + uav_m[..., 2] ** 2
    return REF_GAIN_DB - 10.0 * np.log10(square_m2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scenario file with a gain map of free space beside it."""
    path = tmp_path_factory.mktemp("map")
    (path / "maps").mkdir()
    gain_map.save(path / "maps" / "free.npz", TINY.grid, X_M, Y_M, free_space_db(TINY.grid))
    (path / "mapped.toml").write_text(toml("maps/free.npz"))
    return path


def toml(place, **extra):
    """`tiny` with a gain map, as TOML: an inline table is what JSON and TOML have in common, nearly."""
    values = msgspec.to_builtins(TINY)
    common = ("bandwidth_hz", "tx_power_w", "noise_power_dbm", "interference")
    own = {name: values["radio"][name] for name in common} | {"model": "gain_map", "file": str(place)} | extra
    tables = values | {"radio": own}
    lines = []
    for name, table in tables.items():
        if isinstance(table, dict):
            lines += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
        else:
            lines.insert(0, f"{name} = {json.dumps(table)}")
    return "\n".join(lines)


@pytest.fixture(scope="module")
def mapped(folder):
    return scenarios.load(folder / "mapped.toml")


def test_a_map_of_free_space_is_free_space(mapped, array):
    """Between points 1.2 m apart and 100 m away the bilinear error stays below 0.001 dB."""
    draws, actions = flight(TINY, (5,), seed=2)
    free = fly(TINY, array(draws), array(actions))
    for (state, one), (_, other) in zip(free, fly(mapped, array(draws), array(actions)), strict=True):
        np.testing.assert_allclose(
            np.asarray(other.link.sinr), np.asarray(one.link.sinr), rtol=1e-3, atol=0.0
        )
        np.testing.assert_array_equal(np.asarray(one.link.served), np.asarray(other.link.served))
        assert np.asarray(state.users_m).shape == (5, 4, 2)


def test_points_of_the_map_are_exact_and_between_them_it_is_bilinear(mapped, array):
    values = mapped.radio
    table = gain_map.load(values.file, values.sha256).gain_db
    uav_m = TINY.grid.centre_m(np.array([2, 1, 0]), like=np.zeros(0))
    i, j, x, y = 37, 120, 0.25, 0.6
    points_m = np.array([[X_M[i], Y_M[j]], [X_M[-1], Y_M[-1]], [X_M[0], Y_M[0]]])
    step_m = np.array([X_M[1] - X_M[0], Y_M[1] - Y_M[0]])
    users_m = np.concatenate([points_m, points_m[:1] + step_m * (x, y)])
    found = np.asarray(gain_map.gain_db(values.file, values.sha256, array(uav_m), array(users_m)))
    at = table[2, 1, 0]
    between = (at[i, j] * (1 - y) + at[i, j + 1] * y) * (1 - x) + (
        at[i + 1, j] * (1 - y) + at[i + 1, j + 1] * y
    ) * x
    np.testing.assert_allclose(found, [at[i, j], at[-1, -1], at[0, 0], between], rtol=1e-9)


def test_a_vehicle_off_its_cell_has_the_gains_of_the_nearest_one_and_far_users_those_of_the_edge(mapped):
    values = mapped.radio
    centre_m = TINY.grid.centre_m(np.array([1, 2, 0]), like=np.zeros(0))
    users_m = np.array([[20.0, -30.0], [X_M[-1], 12.0]])

    def at(uav_m, users_m):
        return gain_map.gain_db(values.file, values.sha256, np.asarray(uav_m), np.asarray(users_m))

    expected = at(centre_m, users_m)
    np.testing.assert_array_equal(at(centre_m + np.array([30.0, -49.0, 8.0]), users_m), expected)
    np.testing.assert_array_equal(at(centre_m, users_m + np.array([[0.0, 0.0], [5e3, 0.0]])), expected)
    corner_m = TINY.grid.centre_m(np.array([2, 2, 0]), like=np.zeros(0))
    np.testing.assert_array_equal(
        at(corner_m + np.array([900.0, 900.0, -900.0]), users_m), at(corner_m, users_m)
    )


def test_shadowing_and_fading_come_on_top(folder, mapped):
    extra = {"shadowing": {"sigma_db": 6.0, "correlation_m": 50.0}, "fading": {"model": "rayleigh"}}
    values = msgspec.to_builtins(mapped)
    values["radio"] |= extra
    random = from_values(values, "test")
    free = msgspec.to_builtins(TINY)
    free["radio"] |= extra
    draws, actions = flight(TINY, (), seed=3)
    pairs = zip(fly(random, draws, actions), fly(from_values(free, "test"), draws, actions), strict=True)
    for (_, one), (_, other) in pairs:
        np.testing.assert_allclose(one.link.sinr, other.link.sinr, rtol=1e-3)


def test_float32_and_other_devices(mapped):
    uav_m, users_m = torch.rand(7, 3), torch.rand(7, 4, 2) * 100.0
    found = channel.path_gain(mapped.radio, uav_m, users_m, radio.distance(uav_m, users_m))
    assert found.dtype == torch.float32
    double = channel.path_gain(mapped.radio, uav_m.double(), users_m.double(), uav_m[..., :1])
    np.testing.assert_allclose(found, double, rtol=1e-4)
    draws = torch.rand((4, mapped.n_users, 2), device="meta")
    state = world.initial(mapped, draws)
    _, outcome = world.step(mapped, state, torch.zeros(4, dtype=torch.int64, device="meta"), draws)
    assert outcome.link.rate_bps.device.type == "meta"


def test_the_content_counts_not_the_place(folder, mapped, tmp_path):
    """The fingerprint is that of the content; policies and bags hold the path and the SHA-256."""
    content = (folder / "maps" / "free.npz").read_bytes()
    assert mapped.radio.sha256 == hashlib.sha256(content).hexdigest()
    (tmp_path / "copy.npz").write_bytes(content)
    (tmp_path / "same.toml").write_text(toml("copy.npz"))
    assert scenarios.load(tmp_path / "same.toml").fingerprint == mapped.fingerprint
    assert channel.title(mapped.radio) == "gain_map, free.npz"
    gain_map.save(tmp_path / "copy.npz", TINY.grid, X_M, Y_M, free_space_db(TINY.grid) - 1.0)
    other = scenarios.load(tmp_path / "same.toml")
    assert other.fingerprint != mapped.fingerprint
    recorded = msgspec.to_builtins(other)
    (tmp_path / "copy.npz").unlink()
    gain_map.load.cache_clear()
    gain_map._values.cache_clear()
    again = from_values(recorded, "test")
    assert again == other, "a policy or a bag can be read without the map"
    with pytest.raises(ScenarioError, match=r"gain map .*copy\.npz: cannot be read: No such file"):
        world.measure(again, np.zeros(3), np.zeros((4, 2)), np.zeros(4, bool))
    (tmp_path / "copy.npz").write_bytes(content)
    with pytest.raises(
        ScenarioError, match=r"SHA-256 is [0-9a-f]{12}\.\.\.; expected [0-9a-f]{12}\.\.\., with"
    ):
        world.measure(again, np.zeros(3), np.zeros((4, 2)), np.zeros(4, bool))


def test_the_manual_s_example_is_a_scenario_s(folder):
    text = (Path(__file__).parents[2] / "docs" / "channels.md").read_text("utf-8")
    (example,) = re.findall(r"```toml\n([^`]*gain_map[^`]*)```", text)
    radio = tomllib.loads(example)["radio"] | {"file": "maps/free.npz"}
    values = msgspec.to_builtins(TINY) | {"radio": radio}
    values = gain_map.with_absolute_path(values, folder, "docs")
    assert channel.title(from_values(values, "docs").radio) == "gain_map, free.npz"


def test_equal_maps_are_equal_files(folder, tmp_path):
    gain_map.save(tmp_path / "free.npz", TINY.grid, X_M, Y_M, free_space_db(TINY.grid))
    assert (tmp_path / "free.npz").read_bytes() == (folder / "maps" / "free.npz").read_bytes()


def arrays(**changes):
    """The arrays of a small valid file, with changes; None removes one."""
    x_m, y_m = np.linspace(X_M[0], X_M[-1], 4), np.linspace(Y_M[0], Y_M[-1], 5)
    values = {
        "gain_db": free_space_db(TINY.grid, x_m, y_m),
        "uav_x_m": np.array([0.0, 100.0, 200.0]),
        "uav_y_m": np.array([0.0, 100.0, 200.0]),
        "uav_z_m": np.array([100.0]),
        "ground_x_m": x_m,
        "ground_y_m": y_m,
    }
    return {name: value for name, value in (values | changes).items() if value is not None}


def nan_at(values, at):
    values = values.copy()
    values[at] = np.nan
    return values


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"ground_y_m": None},
            "lacks ground_y_m; expected uav_x_m, uav_y_m, uav_z_m, ground_x_m, ground_y_m and",
        ),
        (
            {"gain_db": arrays()["gain_db"][..., :4]},
            "gain_db is (3, 3, 1, 4, 4); expected (3, 3, 1, 4, 5), the",
        ),
        (
            {"gain_db": nan_at(arrays()["gain_db"], (2, 0, 0, 3, 1))},
            "gain_db[2, 0, 0, 3, 1] = nan; expected finite numbers",
        ),
        ({"gain_db": arrays()["gain_db"] > -90.0}, "gain_db is of type bool; expected numbers"),
        (
            {"ground_x_m": np.array([0.0, 1.0, 3.0, 4.0])},
            "ground_x_m is (4,), 0 to 4 m; expected at least 2 coord",
        ),
        ({"ground_x_m": arrays()["ground_x_m"][::-1]}, "ground_x_m is (4,), "),
        (
            {"ground_x_m": np.zeros((4, 1))},
            "ground_x_m is (4, 1), 0 to 0 m; expected at least 2 coordinates of one",
        ),
        ({"ground_x_m": np.zeros(0)}, "ground_x_m is (0,), empty; expected at least 2 coordinates of one"),
        ({"ground_x_m": np.array(3.0)}, "ground_x_m is (), 3 to 3 m; expected at least 2 coordinates of one"),
        (
            {"uav_z_m": np.array([120.0])},
            "its uav_z_m are 1, 120 to 120 m; expected the centres of the grid's cells",
        ),
        (
            {"uav_x_m": np.array([0.0, 50.0, 100.0])},
            "its uav_x_m are 3, 0 to 100 m; expected the centres of the ",
        ),
        (
            {"ground_x_m": np.linspace(-50.0, 150.0, 4)},
            "its ground_x_m are -50 to 150 m; expected at least ",
        ),
    ],
    ids=str,
)
def test_an_unsuitable_map_is_one_line(tmp_path, changes, message):
    np.savez(tmp_path / "map.npz", **arrays(**changes))
    (tmp_path / "mapped.toml").write_text(toml("map.npz"))
    with pytest.raises(ScenarioError) as caught:
        scenarios.load(tmp_path / "mapped.toml")
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{tmp_path / 'mapped.toml'}: radio.file")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "extra", "message"),
    [
        (None, {}, "map.npz: cannot be read: No such file or directory"),
        (b"", {}, "not a NumPy file (.npz): "),
        (b"PK\x03\x04 torn", {}, "not a NumPy file (.npz): "),
        (b"\x93NUMPY", {}, "not a NumPy file (.npz): "),
        (b"text", {}, "not a NumPy file (.npz): "),
        (
            b"text",
            {"sha256": "00"},
            "radio.sha256 = '00'; expected '982d9e3eb996f559e633f4d194def3761d909f5a3b6",
        ),
        (b"text", {"ref_gain_db": -50.0}, "unknown key radio.ref_gain_db = -50.0; expected one of model, "),
        (b"text", {"file": 3}, "radio.file = 3; expected str, got int"),
    ],
    ids=str,
)
def test_a_file_that_is_no_map_is_one_line(tmp_path, content, extra, message):
    if content is not None:
        (tmp_path / "map.npz").write_bytes(content)
    (tmp_path / "mapped.toml").write_text(toml("map.npz", **extra))
    with pytest.raises(ScenarioError) as caught:
        scenarios.load(tmp_path / "mapped.toml")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_users_stay_in_the_area_that_a_map_must_cover():
    """The discs and the farthest walk; the field for users who move in it."""
    walk, grid = TINY.users, TINY.grid
    mission_s = TINY.mission.max_steps * TINY.mission.step_s
    assert walk.area_m(grid, mission_s) == (X_M[0], Y_M[0], X_M[-1], Y_M[-1])
    radius_m = walk.cluster_radius_m
    assert walk.area_m(grid, 0.0) == (100.0 - radius_m, -radius_m, 100.0 + radius_m, radius_m)
    still = msgspec.structs.replace(walk, v_max_mps=None, mobility=Static())
    assert still.area_m(grid, mission_s) == walk.area_m(grid, 0.0)
    drift = msgspec.structs.replace(still, mobility=GaussMarkov(alpha=0.5, mean_speed_mps=3.0))
    legs = {"v_min_mps": 1.0, "v_max_mps": 2.0, "pause_s": 0.0}
    to_field = msgspec.structs.replace(still, mobility=RandomWaypoint(**legs))
    (west_m, south_m), (east_m, north_m) = grid.area_m
    for moving in (drift, to_field):
        assert moving.area_m(grid, mission_s) == (west_m, min(south_m, -radius_m), east_m, north_m)
    at_home = msgspec.structs.replace(still, mobility=RandomWaypoint(**legs, waypoints="start_disc"))
    assert at_home.area_m(grid, mission_s) == still.area_m(grid, mission_s)


def test_scenario_check_names_the_line(folder, tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        check.main(["check", str(folder / "mapped.toml")])
    assert end.value.code == 0, capsys.readouterr()
    assert "channel gain_map, free.npz" in capsys.readouterr().out
    text = toml("none.npz", fading={"model": "rice"}).replace('{"model": "rice"}', '{ model = "rice" }')
    line = text.splitlines().index('file = "none.npz"') + 1
    for given, expected in (
        (toml("none.npz"), f"bad.toml:{line}: radio.file = '{tmp_path / 'none.npz'}': gain map "),
        (text, "radio.fading.model = 'rice'; expected one of rayleigh, rician"),
    ):
        (tmp_path / "bad.toml").write_text(given)
        with pytest.raises(SystemExit) as end:
            check.main(["check", str(tmp_path / "bad.toml")])
        assert (end.value.code, expected in capsys.readouterr().err) == (2, True), expected


def test_values_made_by_hand_name_the_content(folder, mapped):
    values = msgspec.to_builtins(mapped)
    del values["radio"]["sha256"]
    with pytest.raises(
        ScenarioError, match=f"^test: missing key radio.sha256; expected '{mapped.radio.sha256}'"
    ):
        from_values(values, "test")


def test_save_refuses_what_cannot_be_a_map_of_the_grid(tmp_path):
    gains = free_space_db(TINY.grid)
    for shape in (gains[:2], gains[..., 1:]):
        with pytest.raises(ScenarioError, match="gain_db is"):
            gain_map.save(tmp_path / "x.npz", TINY.grid, X_M, Y_M, shape)
    assert list(tmp_path.iterdir()) == []
