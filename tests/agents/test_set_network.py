"""The network for sets: one function on numpy and torch; neither order nor padding of the clusters counts."""

import time

import msgspec
import numpy as np
import pytest
import torch

from tests.agents.test_policy_folder import edit_config, refused
from uav_dc_ros import scenarios
from uav_dc_ros.agents import policy, set_network
from uav_dc_ros.agents.agent import greedy_act
from uav_dc_ros.agents.set_network import SetArchitecture
from uav_dc_ros.agents.set_policy import PqnSettings, SetPolicyConfig
from uav_dc_ros.core import world
from uav_dc_ros.core.entities.encoding import CLUSTER, GLOBAL, LOSS, PRICE, allowed
from uav_dc_ros.core.world import initial
from uav_dc_ros.errors import PolicyError
from uav_dc_ros.experiments.train.generalist.set_learner import active

SIZES = SetArchitecture(width=16, hidden=(24, 24), n_actions=7)


def observations(n_clusters, n=5):
    rng = np.random.default_rng(n_clusters)
    rows = rng.uniform(-1.0, 1.0, (n, GLOBAL + CLUSTER * n_clusters))
    rows[:, GLOBAL::CLUSTER] = 1.0  # present
    rows[:, PRICE] = 0.01
    return rows


def trained():
    """Random parameters, also of the heads, which are zero at first."""
    rng = np.random.default_rng(0)
    return {
        name: rng.uniform(-0.3, 0.3, v.shape).astype(np.float32)
        for name, v in set_network.initial(SIZES, rng).items()
    }


def q_values(rows, dtype=np.float64):
    return set_network.q_values(SIZES, {name: v.astype(dtype) for name, v in trained().items()}, rows)


def test_where_the_network_prefers_no_action_the_plan_decides():
    rows = observations(4)
    rows[:, LOSS : LOSS + 7] = np.random.default_rng(0).permuted(np.tile(np.arange(7) / 7, (5, 1)), axis=1)
    untrained = set_network.initial(SIZES, np.random.default_rng(0))
    found = set_network.preferences(SIZES, untrained, rows.astype(np.float32))
    np.testing.assert_array_equal(found.argsort(axis=-1), (-rows[:, LOSS : LOSS + 7]).argsort(axis=-1))


def test_the_order_of_the_clusters_does_not_count():
    rows = observations(6)
    clusters = rows[:, GLOBAL:].reshape(5, 6, CLUSTER)[:, [3, 1, 0, 5, 2, 4]]
    other = np.concatenate([rows[:, :GLOBAL], clusters.reshape(5, -1)], axis=-1)
    assert np.ptp(q_values(rows), axis=-1).min() > 1e-3
    np.testing.assert_allclose(q_values(other), q_values(rows), atol=1e-12)


def test_padding_does_not_count():
    rows = observations(3)
    padded = np.pad(rows, ((0, 0), (0, 4 * CLUSTER)))
    np.testing.assert_allclose(q_values(padded), q_values(rows), atol=1e-12)


def test_torch_computes_the_same_with_its_own_layer_normalisation():
    rows = observations(5).astype(np.float32)
    theta = {name: torch.from_numpy(v) for name, v in trained().items()}
    found = set_network.q_values(SIZES, theta, torch.from_numpy(rows), active).numpy()
    np.testing.assert_allclose(found, q_values(rows.astype(np.float64)), atol=1e-4)


def made(folder, **values):
    """A saved policy for any field with random parameters."""
    config = SetPolicyConfig(
        name="any",
        width=16,
        hidden=(24, 24),
        hyperparameters=PqnSettings(),
        seed=0,
        iteration=0,
        version="test",
        scenario=msgspec.to_builtins(scenarios.load("five_clusters")),
    )
    policy.save(folder / "any", msgspec.structs.replace(config, **values), trained(), lambda _: "")
    return policy.load(folder / "any")


def test_one_policy_flies_in_every_shipped_scenario_and_lands(tmp_path):
    own = made(tmp_path)
    assert own.scenario.name == "five_clusters"
    for name in ("five_clusters", "three_clusters_hover", "farm"):
        scenario = scenarios.load(name)
        act, rng = greedy_act(own, scenario), np.random.default_rng(0)
        state = initial(scenario, rng.random((4, *scenario.draws_shape)))
        for _ in range(scenario.mission.max_steps):
            seen = world.observe("entities", scenario, state)
            action = act(state)
            assert np.take_along_axis(allowed(seen), action[:, None], axis=-1).all()
            state, outcome = world.step(scenario, state, action, rng.random((4, *scenario.draws_shape)))
        assert outcome.landed.all()


def test_the_weight_is_an_input(tmp_path):
    own, scenario = made(tmp_path), scenarios.load("three_clusters")
    state = initial(scenario, np.random.default_rng(0).random((1, *scenario.draws_shape)))
    seen = [world.observe("entities", scenario, state, weight) for weight in (None, 10 / 11, 0.2)]
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.array_equal(own.q_values(seen[1]), own.q_values(seen[2]))


def test_a_field_or_a_file_that_it_cannot_read_is_an_error(tmp_path):
    own = made(tmp_path)
    small = scenarios.load("five_clusters")
    grid = msgspec.structs.replace(small.grid, n_x=100)
    with pytest.raises(PolicyError, match="policy 'any' needs the observation 'entities' in scenario "):
        own.check(msgspec.structs.replace(small, grid=grid))
    folder = tmp_path / "any"
    edit_config(folder, features=2)
    assert "features = 2; expected 3" in refused(folder)
    edit_config(folder, features=3, width=8)
    assert "tensor 'advantage.cluster.bias' is float32 (16,); expected float32 (8,)" in refused(folder)
    edit_config(folder, width=16, format=2)
    assert "format = 2; expected 3" in refused(folder)
    edit_config(folder, format=4)
    assert "$.format" in refused(folder)


def test_a_decision_takes_little_time(tmp_path):
    """The median, which a busy machine leaves alone; benchmarks/decisions.py measures the 99th percentile."""
    config = {"width": 64, "hidden": (128, 128)}
    sizes = SetArchitecture(n_actions=7, **config)
    parameters = {k: v.astype(float) for k, v in set_network.initial(sizes, np.random.default_rng(0)).items()}
    row, times_s = observations(8, 1), []
    for _ in range(50):
        started = time.perf_counter()
        set_network.q_values(sizes, parameters, row)
        times_s.append(time.perf_counter() - started)
    assert np.median(times_s) < 2e-3
