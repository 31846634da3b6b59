"""Policies as folders: what is written is what is read, and nothing damaged ever flies."""

import json
import re
import shutil

import msgspec
import numpy as np
import pytest
import safetensors.numpy

from tests.support.worlds import changed, config, saved, tiny
from uav_dc_ros import scenarios
from uav_dc_ros.agents import network, policy
from uav_dc_ros.errors import PolicyError


def refused(folder):
    """The one line with which a policy is refused."""
    with pytest.raises(PolicyError) as error:
        policy.load(folder)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.fixture
def folder(tmp_path):
    return saved(tmp_path / "made", tiny())


def edit_config(folder, **values):
    path = folder / policy.CONFIG
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def edit_model(folder, **arrays):
    """Replaces tensors; None takes one away."""
    held = safetensors.numpy.load_file(folder / policy.MODEL) | arrays
    kept = {name: values for name, values in held.items() if values is not None}
    (folder / policy.MODEL).write_bytes(safetensors.numpy.save(kept))


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"algorithm": "dqn"},
        {"aggregation": "max", "observation": "map"},
        {"observation": "position", "hidden": (5,)},
    ],
    ids=str,
)
def test_round_trip(tmp_path, values):
    scenario = tiny()
    made = config(scenario, **values)
    parameters = network.initial(made.architecture(scenario), np.random.default_rng(4))
    policy.save(tmp_path / "new", made, parameters, lambda read: f"# {read.name}\n")
    loaded = policy.load(tmp_path / "new")
    assert msgspec.json.encode(loaded.config) == msgspec.json.encode(made)
    assert loaded.scenario == scenario
    assert loaded.name == "test"
    assert loaded.folder == tmp_path / "new"
    assert (tmp_path / "new" / policy.CARD).read_text() == "# test\n"
    state = {
        "cell": np.random.default_rng(0).integers(0, 3, (4, 5, 3)) * [1, 1, 0],
        "step": np.full((4, 5), 3),
        "data_bits": np.full((4, 5, 4), 1e6),
        "collected": np.zeros((4, 5, 4), bool),
    }
    seen = loaded.observe(scenario, **state)
    q = loaded.q_values(seen)
    assert q.shape == (4, 5, 7)
    expected = network.q_values(made.architecture(scenario), parameters, seen.reshape(20, -1))
    np.testing.assert_allclose(q.reshape(20, 7), expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(loaded.act(seen), q.argmax(-1))
    # One mission alone gets the same answer as among others, to the last bit of what it does.
    alone = loaded.observe(scenario, **{name: values[2, 3] for name, values in state.items()})
    assert loaded.act(alone) == loaded.act(seen)[2, 3]


def test_the_hash_names_what_flies(tmp_path, folder):
    before = policy.load(folder).sha256
    assert re.fullmatch("[0-9a-f]{64}", before)
    assert policy.load(saved(tmp_path / "again", tiny())).sha256 == before
    edit_model(folder, **{"value.bias": np.ones(1, np.float32)})
    changed_model = policy.load(folder).sha256
    edit_config(folder, seed=1)
    assert len({before, changed_model, policy.load(folder).sha256}) == 3


def test_files_are_readable_by_others(folder):
    modes = {path.name: path.stat().st_mode & 0o777 for path in folder.iterdir()}
    assert len(modes) == 3
    assert len(set(modes.values())) == 1, modes


def test_a_folder_that_exists_is_never_touched(folder):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(PolicyError, match=r"made' exists.*never overwritten"):
        saved(folder, tiny())
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_failure_leaves_nothing_behind(tmp_path):
    made = config(tiny())
    broken = network.initial(made.architecture(tiny()), np.random.default_rng(0))
    broken["value.bias"] = np.array([np.nan])
    with pytest.raises(PolicyError, match=r"value\.bias.*not finite"):
        policy.save(tmp_path / "new", made, broken, lambda _: "")
    assert list(tmp_path.iterdir()) == []


def test_a_picture_that_fails_leaves_nothing_behind(tmp_path):
    def draw(made, partial):
        (partial / policy.TRAJECTORY).touch()
        raise RuntimeError("no ink")

    made = config(tiny())
    parameters = network.initial(made.architecture(tiny()), np.random.default_rng(0))
    with pytest.raises(RuntimeError, match="no ink"):
        policy.save(tmp_path / "new", made, parameters, lambda _: "", draw)
    assert list(tmp_path.iterdir()) == []


def test_pictures_are_drawn_of_what_was_read_back_beside_it(tmp_path):
    made = config(tiny())
    parameters = network.initial(made.architecture(tiny()), np.random.default_rng(0))
    drawn = []

    def draw(loaded, partial):
        drawn.append((loaded.sha256, sorted(path.name for path in partial.iterdir())))
        (partial / policy.TRAJECTORY).write_bytes(b"ink")

    policy.save(tmp_path / "new", made, parameters, lambda _: "# test\n", draw)
    assert drawn == [(policy.load(tmp_path / "new").sha256, [policy.CARD, policy.CONFIG, policy.MODEL])]
    assert (tmp_path / "new" / policy.TRAJECTORY).read_bytes() == b"ink"


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(PolicyError, match="cannot be written"):
        saved(tmp_path / "file" / "new", tiny())


def test_an_unknown_name_lists_the_known_ones(tmp_path):
    message = refused("five_clusters_hover_duelling")
    assert "'five_clusters_hover_duelling'" in message
    assert all(name in message for name in policy.names())


@pytest.mark.parametrize("name", [policy.CONFIG, policy.MODEL])
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    assert re.search(f"{name}: cannot be read: No such file", refused(folder))


def test_a_model_cut_short_anywhere_is_refused(folder):
    """After any number of bytes: in the length, in the header, on its edge, in the numbers."""
    path = folder / policy.MODEL
    whole = path.read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    for n in [0, 1, 7, 8, 9, header // 2, header - 1, header, header + 1, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:n])
        assert f"{policy.MODEL}: damaged" in refused(folder), n


def test_a_model_with_something_added_or_scribbled_is_refused(folder):
    path = folder / policy.MODEL
    whole = path.read_bytes()
    for damaged in (whole + b"\0", b"\xff" * 8 + whole[8:], whole[:20] + b"\0\0\0\0" + whole[24:], b"hello"):
        path.write_bytes(damaged)
        assert policy.MODEL in refused(folder)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"value.bias": None}, r"tensor 'value\.bias' is missing; expected shape \(1,\)"),
        ({"extra": np.ones(1, np.float32)}, "unexpected tensor 'extra'; expected hidden_0.weight"),
        ({"value.bias": np.ones(2, np.float32)}, r"'value\.bias' is float32 \(2,\); expected float32 \(1,\)"),
        ({"value.bias": np.ones(1)}, r"'value\.bias' is float64"),
        ({"value.bias": np.array([np.nan], np.float32)}, r"'value\.bias' holds values that are not finite"),
        ({"value.bias": np.array([np.inf], np.float32)}, r"'value\.bias' holds values that are not finite"),
    ],
    ids=["missing", "extra", "shape", "type", "nan", "inf"],
)
def test_a_model_that_does_not_fit_is_refused(folder, arrays, message):
    edit_model(folder, **arrays)
    assert re.search(message, refused(folder))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"format": 4}, r"Invalid enum value 4.*format"),
        ({"learns": True}, "unknown field `learns`"),
        ({"algorithm": "sarsa"}, r"'sarsa'.*algorithm"),
        ({"observation": "radar"}, r"'radar'.*observation"),
        ({"hidden": []}, "hidden"),
        ({"hidden": [0]}, "hidden"),
        ({"hidden": [9, 8]}, r"hidden_0\.bias"),
        ({"name": "../x"}, "name"),
        ({"actions": ["hover", "left"]}, r"actions = \['hover', 'left'\]; expected \['left', 'right'"),
        ({"scenario": {}}, "scenario: missing key"),
        ({"hyperparameters": {"gamma": 2.0}}, r"<= 1.*gamma"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_bad_config_is_refused(folder, values, message):
    edit_config(folder, **values)
    found = refused(folder)
    assert policy.CONFIG in found or policy.MODEL in found
    assert re.search(message, found)


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"\xff\xfe"])
def test_a_config_that_is_not_json_is_refused(folder, text):
    (folder / policy.CONFIG).write_bytes(text)
    assert policy.CONFIG in refused(folder)


def test_a_stored_scenario_with_a_bad_value_is_refused(folder):
    values = msgspec.to_builtins(tiny())
    values["mission"]["max_steps"] = 0
    edit_config(folder, scenario=values)
    assert re.search(r"mission\.max_steps = 0", refused(folder))


def test_check_names_both_layouts(tmp_path):
    five = scenarios.load("five_clusters_hover")
    sees_mission = policy.load(saved(tmp_path / "mission", five))
    sees_position = policy.load(saved(tmp_path / "position", five, observation="position"))
    sees_mission.check(
        changed("five_clusters_hover", mission={"max_steps": 30}, users={"users_per_cluster": 3})
    )
    larger = changed("five_clusters_hover", grid={"n_z": 4})
    for one in (sees_mission, sees_position):
        with pytest.raises(
            PolicyError, match=r"'five_clusters_hover'.*\(11, 11, 4\); expected \(11, 11, 3\)"
        ):
            one.check(larger)
    three = scenarios.load("three_clusters_hover")
    with pytest.raises(PolicyError, match=r"'three_clusters_hover': the number of clusters is 3; expected 5"):
        sees_mission.check(three)
    sees_position.check(three)


def test_names_are_folders_with_a_config(tmp_path, monkeypatch, folder):
    shutil.copytree(folder, tmp_path / "policies" / "b")
    shutil.copytree(folder, tmp_path / "policies" / "a")
    (tmp_path / "policies" / "a.checkpoints").mkdir()
    shutil.copytree(folder, tmp_path / "policies" / ".c.123.partial")  # left by a killed training
    monkeypatch.setattr(policy.files, "shipped_folder", lambda name: tmp_path / name)
    assert policy.names() == ["a", "b"]
    assert policy.load("b").folder == tmp_path / "policies" / "b"
