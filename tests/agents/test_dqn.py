"""The learner: its targets, its actions, its gradients, and that runs do not touch each other."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from uav_dc_ros.agents import network
from uav_dc_ros.agents.dqn import Learner, Member, td_target
from uav_dc_ros.agents.network import Architecture
from uav_dc_ros.agents.policy import Hyperparameters
from uav_dc_ros.agents.replay import TransitionBatch

CPU = torch.device("cpu")
# Both algorithms and both aggregations, in one batch, each with values of its own. Runs 1 and 2 are
# neighbours that share a learning rate; run 4 has theirs again.
MIXED = [
    (None, {"gamma": 0.5, "batch_size": 3, "learning_rate": 1e-2, "epsilon": 0.1}),
    ("mean", {"gamma": 0.9, "batch_size": 8, "learning_rate": 1e-3, "epsilon": 0.9}),
    ("max", {"gamma": 0.99, "batch_size": 5, "learning_rate": 1e-3, "epsilon": 0.5}),
    ("mean", {"gamma": 0.0, "batch_size": 1, "learning_rate": 3e-4, "epsilon": 1.0}),
    (None, {"gamma": 1.0, "batch_size": 8, "learning_rate": 1e-3, "epsilon": 0.0}),
]


def member(dueling, values, seed, hidden=(16,)):
    architecture = Architecture(n_inputs=3, hidden=hidden, n_actions=4, dueling=dueling)
    settings = Hyperparameters(**values)
    double = settings.gamma >= 0.9  # three of the mixed runs
    return Member(architecture, settings, np.random.default_rng(seed), double)


def members(hidden=(16,), mixed=MIXED, **values):
    return [member(dueling, own | values, seed, hidden) for seed, (dueling, own) in enumerate(mixed)]


def batches(n, mixed=MIXED):
    """Random mini-batches for all of them."""
    rngs = [np.random.default_rng([run, 1]) for run in range(len(mixed))]
    size = max(values["batch_size"] for _, values in mixed)

    def stack(draw):
        return torch.from_numpy(np.stack([draw(rng) for rng in rngs]))

    for _ in range(n):
        yield TransitionBatch(
            observation=stack(lambda rng: rng.random((size, 3), np.float32)),
            action=stack(lambda rng: rng.integers(0, 4, size)),
            reward=stack(lambda rng: rng.random(size, np.float32)),
            next_observation=stack(lambda rng: rng.random((size, 3), np.float32)),
            terminated=stack(lambda rng: rng.random(size) < 0.3),
        )


def of_run(batch, run, n_rows):
    """The first rows of a run's share of a mini-batch, without the dimension of the runs."""
    return TransitionBatch(*(values[run, :n_rows] for values in batch[:5]))


class Written:
    """One run of the paper's algorithm in plain torch: its loss, torch's own gradient and Adam."""

    def __init__(self, one: Member) -> None:
        self.member = one
        drawn = network.initial(one.architecture, one.rng)
        self.theta = {name: torch.from_numpy(values).double() for name, values in drawn.items()}
        self.copy()
        for values in self.theta.values():
            values.requires_grad_()
        rate = one.hyperparameters.learning_rate
        self.optimiser = torch.optim.Adam(self.theta.values(), lr=rate, foreach=False)
        self.iterations = 0

    def copy(self):
        self.target = {name: values.detach().clone() for name, values in self.theta.items()}

    def loss(self, batch):
        """Equations 20 to 22, over the rows that the run's batch size allows."""
        architecture, values = self.member.architecture, self.member.hyperparameters
        q = network.q_values(architecture, self.theta, batch.observation.double())
        taken = q[torch.arange(len(batch.action)), batch.action]
        next_q = network.q_values(architecture, self.target, batch.next_observation.double())
        chosen = next_q
        if self.member.double:
            chosen = network.q_values(architecture, self.theta, batch.next_observation.double())
        future = next_q.gather(-1, chosen.argmax(-1, keepdim=True))[:, 0]
        future = torch.where(batch.terminated, 0.0, future.detach())
        return torch.mean((batch.reward.double() + values.gamma * future - taken) ** 2)

    def update(self, batch):
        loss = self.loss(batch)
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        self.iterations += 1
        if self.iterations % self.member.hyperparameters.target_every == 0:
            self.copy()
        return loss.item()


def test_td_target_by_hand():
    """A step in flight, the last one of a mission, and one that was cut off: only the end ends the sum."""
    reward = torch.tensor([1.0, 1.0, 1.0])
    terminated = torch.tensor([False, True, False])  # the third was truncated, which is not termination
    next_q = torch.tensor([[0.0, 2.0, -1.0], [5.0, 7.0, 6.0], [-3.0, -2.0, -4.0]])
    expected = torch.tensor([1.0 + 0.9 * 2.0, 1.0, 1.0 - 0.9 * 2.0])
    torch.testing.assert_close(td_target(reward, terminated, next_q, 0.9), expected)


def test_td_target_of_a_population():
    next_q = torch.rand((2, 5, 4), generator=torch.Generator().manual_seed(0))
    gamma = torch.tensor([[0.5], [0.25]])
    y = td_target(torch.ones(2, 5), torch.zeros(2, 5, dtype=torch.bool), next_q, gamma)
    torch.testing.assert_close(y[0], 1.0 + 0.5 * next_q[0].max(-1).values)
    torch.testing.assert_close(y[1], 1.0 + 0.25 * next_q[1].max(-1).values)


def test_a_value_that_is_not_finite_does_not_leak_through_the_end():
    y = td_target(torch.ones(1), torch.tensor([True]), torch.tensor([[torch.inf, torch.nan]]), 0.9)
    assert y.item() == 1.0


def test_epsilon_is_the_probability_of_the_greedy_action_of_each_run():
    made = Learner(members(), CPU)
    n = 2_000
    observation = torch.full((len(MIXED), 3), 0.3)
    greedy = made.greedy(observation[:, None])[:, 0]
    explore, choice = torch.rand((2, n, len(MIXED)), generator=torch.Generator().manual_seed(0))
    actions = torch.stack([made.act(observation, explore[i], choice[i]) for i in range(n)])
    for run, (_, values) in enumerate(MIXED):
        share = torch.bincount(actions[:, run], minlength=4) / n
        # A random action is the greedy one in a quarter of the cases.
        expected = torch.full((4,), (1.0 - values["epsilon"]) / 4)
        expected[greedy[run]] += values["epsilon"]
        torch.testing.assert_close(share, expected, atol=0.03, rtol=0.0)


def test_the_extreme_draws_stay_inside():
    made = Learner(members(), CPU)
    observation = torch.zeros((len(MIXED), 3))
    lowest, highest = torch.zeros(len(MIXED)), torch.full((len(MIXED),), 1.0 - 2.0**-24)
    assert made.act(observation, highest, highest)[4] == 3
    assert made.act(observation, highest, lowest)[4] == 0
    greedy = made.greedy(observation[:, None])[:, 0]
    assert made.act(observation, highest, lowest)[3] == greedy[3], "epsilon 1 is always greedy"
    assert made.act(observation, lowest, highest)[4] == 3, "epsilon 0 is never greedy"


KINDS = {
    "all": MIXED,
    "plain": [MIXED[0], MIXED[4]],
    "mean": [MIXED[1], MIXED[3]],
    "max": [MIXED[2]],
    "plain and max": MIXED[2:5:2],
}


@pytest.mark.parametrize(
    ("hidden", "kinds"),
    [((), "all"), ((16,), "all"), ((9, 8, 7), "all"), *(((12, 8), kinds) for kinds in list(KINDS)[1:])],
    ids=str,
)
def test_the_written_out_gradient_is_the_one_that_torch_finds(hidden, kinds):
    mixed = KINDS[kinds]
    made = Learner(members(hidden, mixed, target_every=3), CPU)
    written = [Written(one) for one in members(hidden, mixed, target_every=3)]
    for i, batch in enumerate(batches(5, mixed)):
        losses = made.update(batch)
        for run, one in enumerate(written):
            own = of_run(batch, run, one.member.hyperparameters.batch_size)
            assert losses[run].item() == pytest.approx(one.update(own), rel=1e-4)
            found = torch.cat([made._gradient[name][run].flatten() for name in sorted(made._gradient)])
            expected = stacked({name: values.grad for name, values in one.theta.items()})
            torch.testing.assert_close(found, expected.float(), rtol=1e-3, atol=2e-6, msg=f"{i}, {run}")


def stacked(parameters):
    """One run's parameters in the learner's layout, flat, in the order of its names."""
    layers = {}
    for name, values in parameters.items():
        layer, part = name.split(".")
        layers.setdefault(layer, {})[part] = values if part == "weight" else values[None]
    if "q" in layers:
        q = layers.pop("q")
        head = {part: torch.cat([torch.zeros_like(v[:, :1]), v], dim=1) for part, v in q.items()}
    else:
        streams = [layers.pop("value"), layers.pop("advantage")]
        head = {part: torch.cat([stream[part] for stream in streams], dim=1) for part in streams[0]}
    layers["head"] = {part: values.mT for part, values in head.items()}
    return torch.cat(
        [layers[layer][part].flatten() for layer in sorted(layers) for part in sorted(layers[layer])]
    )


@pytest.mark.parametrize("rates", [{}, {"learning_rate": 2e-3}], ids=["rates of their own", "one rate"])
def test_each_run_of_a_mixed_population_learns_as_it_is_written(rates):
    """Over four copies of the target network, each run with its own size of mini-batch."""
    made = Learner(members(target_every=5, **rates), CPU)
    written = [Written(one) for one in members(target_every=5, **rates)]
    for batch in batches(24):
        made.update(batch)
        for run, one in enumerate(written):
            one.update(of_run(batch, run, one.member.hyperparameters.batch_size))
    for run, one in enumerate(written):
        start = network.initial(one.member.architecture, np.random.default_rng(run))
        for name, values in made.parameters(run).items():
            np.testing.assert_allclose(
                values, one.theta[name].detach(), rtol=2e-3, atol=2e-5, err_msg=f"{run} {name}"
            )
        moved = np.abs(made.parameters(run)["hidden_0.weight"] - start["hidden_0.weight"]).max()
        rate = one.member.hyperparameters.learning_rate
        # A step of Adam is of about the learning rate: a run with another's rate would be found out.
        assert 3 * rate < moved < 30 * rate


def test_a_run_learns_the_same_alone():
    together = Learner(members(target_every=7), CPU)
    for batch in batches(30):
        together.update(batch)
    for run in range(len(MIXED)):
        alone = Learner(members(target_every=7)[run : run + 1], CPU)
        size = MIXED[run][1]["batch_size"]
        for batch in batches(30):
            alone.update(TransitionBatch(*(values[run : run + 1, :size] for values in batch[:5])))
        for name, values in alone.parameters(0).items():
            np.testing.assert_allclose(values, together.parameters(run)[name], rtol=1e-4, atol=1e-6)


def test_the_same_seeds_give_the_same_parameters():
    made = [Learner(members(), CPU), Learner(members(), CPU)]
    for one in made:
        for batch in batches(20):
            one.update(batch)
    for run in range(len(MIXED)):
        first, second = (one.parameters(run) for one in made)
        assert all(np.array_equal(first[name], second[name]) for name in first)


def test_rows_beyond_a_run_s_batch_size_count_for_nothing():
    made, disturbed = Learner(members(), CPU), Learner(members(), CPU)
    for batch in batches(5):
        made.update(batch)
        other = TransitionBatch(*(values.clone() for values in batch[:5]))
        for run, (_, values) in enumerate(MIXED):
            other.reward[run, values["batch_size"] :] = 1e6
            other.observation[run, values["batch_size"] :] = 7.0
        disturbed.update(other)
    for run in range(len(MIXED)):
        expected, found = made.parameters(run), disturbed.parameters(run)
        assert all(np.array_equal(found[name], values) for name, values in expected.items()), run
    # The same in a row that does count is seen.
    other.reward[0, 2] = 1e6
    disturbed.update(other)
    made.update(batch)
    assert not np.array_equal(made.parameters(0)["q.bias"], disturbed.parameters(0)["q.bias"])
    assert np.array_equal(made.parameters(1)["value.bias"], disturbed.parameters(1)["value.bias"])


@pytest.mark.parametrize("hidden", [(), (16,), (12, 8)], ids=str)
def test_what_it_exports_answers_as_it_does(hidden):
    made = Learner(members(hidden), CPU)
    for run, one in enumerate(members(hidden)):
        drawn = network.initial(one.architecture, one.rng)
        exported = made.parameters(run)
        assert list(exported) == list(drawn)
        assert all(np.array_equal(exported[name], values) for name, values in drawn.items()), (
            "as it was drawn"
        )
    for batch in batches(20):
        made.update(batch)
    seen = torch.rand((len(MIXED), 50, 3), generator=torch.Generator().manual_seed(0))
    q = made.q_values(seen)
    assert q.shape == (len(MIXED), 50, 4)
    assert torch.equal(made.greedy(seen), q.argmax(-1))
    for run, one in enumerate(members(hidden)):
        exported = made.parameters(run)
        shapes = {name: values.shape for name, values in exported.items()}
        assert shapes == network.shapes(one.architecture)
        answer = network.q_values(one.architecture, exported, seen[run].numpy())
        np.testing.assert_allclose(q[run], answer, rtol=1e-4, atol=1e-6)


def test_what_it_exports_is_a_copy():
    made = Learner(members(), CPU)
    before = made.parameters(1)
    kept = {name: values.copy() for name, values in before.items()}
    for batch in batches(3):
        made.update(batch)
    assert all(np.array_equal(before[name], values) for name, values in kept.items())
    assert not np.array_equal(made.parameters(1)["advantage.weight"], kept["advantage.weight"])


def test_the_value_stream_of_a_plain_network_never_moves():
    made = Learner(members(), CPU)
    for batch in batches(20):
        made.update(batch)
    for name in ("head.weight", "head.bias"):
        value = made._theta[name][:, 0]
        still = [run for run in range(len(MIXED)) if not value[run].any()]
        assert still == [0, 4], "the runs without the dueling streams, and no other"


def test_the_target_network_stands_still_between_copies():
    made = Learner(members(target_every=5), CPU)
    targets = []
    for batch in batches(12):
        targets.append(made._theta_target["head.bias"].clone())
        made.update(batch)
    for run in range(len(MIXED)):
        steps = enumerate(pairwise(target[run] for target in targets), start=1)
        assert [i for i, (a, b) in steps if not torch.equal(a, b)] == [5, 10]


@pytest.mark.parametrize("rates", [{}, {"learning_rate": 2e-3}], ids=["rates of their own", "one rate"])
@pytest.mark.parametrize("n", [0, 1, 12])
def test_a_restored_learner_goes_on_as_if_nothing_had_happened(n, rates):
    made = Learner(members(target_every=5, **rates), CPU)
    stream = list(batches(n + 8))
    for batch in stream[:n]:
        made.update(batch)
    state = {name: values.clone() for name, values in made.state().items()}
    others = [member(one, values | {"target_every": 5} | rates, 99) for one, values in MIXED]
    restored = Learner(others, CPU)
    restored.restore(state)
    for batch in stream[n:]:
        assert torch.equal(made.update(batch), restored.update(batch))
    found = restored.state()
    for name, values in made.state().items():
        assert torch.equal(values, found[name]), name
