"""The Q-network: two libraries, one definition."""

import numpy as np
import pytest
import torch

from uav_dc_ros.agents import network
from uav_dc_ros.agents.network import Architecture

DUELING = ["mean", "max", None]


def architecture(dueling, hidden=(8, 6)):
    return Architecture(n_inputs=5, hidden=hidden, n_actions=7, dueling=dueling)


def population(made, n):
    """Parameters of n networks, `[n, ...]`."""
    runs = [network.initial(made, np.random.default_rng(seed)) for seed in range(n)]
    return {name: np.stack([run[name] for run in runs]) for name in runs[0]}


@pytest.mark.parametrize("dueling", DUELING)
def test_numpy_and_torch_agree(dueling):
    made = architecture(dueling)
    parameters = {name: values.astype(np.float64) for name, values in population(made, 3).items()}
    seen = np.random.default_rng(9).normal(size=(3, 11, 5))
    tensors = {name: torch.from_numpy(values) for name, values in parameters.items()}
    np.testing.assert_allclose(
        network.q_values(made, parameters, seen),
        network.q_values(made, tensors, torch.from_numpy(seen)).numpy(),
        rtol=1e-12,
        atol=1e-14,
    )


@pytest.mark.parametrize("dueling", DUELING)
def test_each_network_of_a_population_answers_as_alone(dueling):
    made = architecture(dueling)
    parameters = population(made, 3)
    seen = np.random.default_rng(9).normal(size=(3, 11, 5)).astype(np.float32)
    together = network.q_values(made, parameters, seen)
    assert together.shape == (3, 11, 7)
    for run in range(3):
        alone = {name: values[run] for name, values in parameters.items()}
        np.testing.assert_allclose(together[run], network.q_values(made, alone, seen[run]), rtol=1e-5)


def test_it_is_what_the_paper_writes():
    """Against a network written out by hand, with one hidden unit of each sign."""
    made = Architecture(n_inputs=1, hidden=(2,), n_actions=2, dueling="mean")
    parameters = {
        "hidden_0.weight": np.array([[1.0, -1.0]]),
        "hidden_0.bias": np.array([0.5, 0.0]),
        "value.weight": np.array([[2.0], [3.0]]),
        "value.bias": np.array([0.25]),
        "advantage.weight": np.array([[1.0, 0.0], [0.0, 1.0]]),
        "advantage.bias": np.array([0.0, 4.0]),
    }
    # s = 2: features relu(2.5), relu(-2) = 2.5, 0; V = 5.25; A = 2.5, 4, of mean 3.25 and max 4.
    seen = np.array([[2.0]])
    np.testing.assert_allclose(network.q_values(made, parameters, seen), [[4.5, 6.0]])
    by_max = Architecture(n_inputs=1, hidden=(2,), n_actions=2, dueling="max")
    np.testing.assert_allclose(network.q_values(by_max, parameters, seen), [[3.75, 5.25]])


def test_dueling_identities():
    """Of Q = V + A - mean A the mean is V (eq. 30), of Q = V + A - max A the maximum is V (eq. 29)."""
    seen = np.random.default_rng(9).normal(size=(20, 5))
    parameters = network.initial(architecture("mean"), np.random.default_rng(0))
    only_value = dict(parameters)
    only_value["advantage.weight"] = np.zeros_like(parameters["advantage.weight"])
    value = network.q_values(architecture("mean"), only_value, seen)[:, 0]
    by_mean = network.q_values(architecture("mean"), parameters, seen)
    by_max = network.q_values(architecture("max"), parameters, seen)
    np.testing.assert_allclose(by_mean.mean(-1), value, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(by_max.max(-1), value, rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(by_mean.argmax(-1), by_max.argmax(-1))
    # A constant added to every advantage is invisible: that is what makes V identifiable.
    shifted = parameters | {"advantage.bias": parameters["advantage.bias"] + 3.0}
    np.testing.assert_allclose(network.q_values(architecture("mean"), shifted, seen), by_mean, atol=1e-6)


@pytest.mark.parametrize("dueling", DUELING)
def test_shapes_name_what_initial_makes(dueling):
    made = architecture(dueling, hidden=(4,))
    parameters = network.initial(made, np.random.default_rng(3))
    assert {name: values.shape for name, values in parameters.items()} == network.shapes(made)
    assert {values.dtype for values in parameters.values()} == {np.dtype(np.float32)}
    assert np.abs(parameters["hidden_0.weight"]).max() <= 5**-0.5
    again = network.initial(made, np.random.default_rng(3))
    assert all(np.array_equal(again[name], values) for name, values in parameters.items())
