"""Training repeats, runs are independent, statistics are right, no device waits, and agents learn."""

import collections
import math

import msgspec
import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.support.worlds import population, run, tiny
from uav_dc_ros.agents import network
from uav_dc_ros.core import observations
from uav_dc_ros.core.world import BatchWorld, observe
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.evaluate.evaluation import TEST_SEEDS
from uav_dc_ros.experiments.evaluate.rollout import Missions, roll_out
from uav_dc_ros.experiments.train import training as training_module
from uav_dc_ros.experiments.train.episode_stats import CURVES, EpisodeStats
from uav_dc_ros.experiments.train.population import architecture
from uav_dc_ros.experiments.train.progress import latest_means
from uav_dc_ros.experiments.train.training import VALIDATION_SEEDS, Training, roll_out_greedily, validate

CPU = torch.device("cpu")
ENDS = ["at_time_limit", "on_arrival"]


pytestmark = pytest.mark.usefixtures("one_thread")


def trained(made, n=None, worlds_in=None):
    """A training after n episodes; after all of them by default."""
    training = Training(made, CPU, worlds_in)
    for _ in range(made.n_episodes if n is None else n):
        training.fly_episode()
    return training


def mixed(scenario, **values):
    """Runs that differ in everything in which runs may differ."""
    return (
        run(scenario, 5, algorithm="dqn", gamma=0.5, r_plus="binary", learning_rate=1e-2, **values),
        run(scenario, 6, aggregation="max", batch_size=16, form="immediate", beta=4.0, zeta=0.5, **values),
        run(scenario, 7, environment=3, epsilon=0.3, data_scale_bits=1e6, data="step", **values),
        run(scenario, 7, gamma=0.99, batch_size=2, form="immediate", r_plus="binary", zeta=3.0, **values),
    )


def assert_close(expected, found, of_expected, of_found):
    """One run of a training learnt what one of another did, but for the last digits."""
    for name, values in expected.curves.items():
        # A rate is a sum of many; everything else is of order one.
        atol = 10.0 if name == "throughput_bps" else 1e-4
        np.testing.assert_allclose(
            found.curves[name][:, of_found], values[:, of_expected], rtol=1e-4, atol=atol, err_msg=name
        )
    learnt = found.learner.parameters(of_found)
    for name, values in expected.learner.parameters(of_expected).items():
        np.testing.assert_allclose(learnt[name], values, rtol=1e-3, atol=1e-4, err_msg=name)


@pytest.mark.parametrize("end", ENDS)
def test_it_repeats_to_the_last_bit(end):
    scenario = tiny(mission={"episode_end": end})
    made = population(scenario, *mixed(scenario))
    first, second = trained(made), trained(made)
    for name, values in first.curves.items():
        np.testing.assert_array_equal(values, second.curves[name], err_msg=name)
    for one in range(len(made.runs)):
        again = second.learner.parameters(one)
        for name, values in first.learner.parameters(one).items():
            np.testing.assert_array_equal(values, again[name], err_msg=name)


@pytest.mark.parametrize("end", ENDS)
def test_a_run_learns_alone_what_it_learns_among_others(end):
    scenario = tiny(mission={"episode_end": end})
    runs = mixed(scenario)
    among = trained(population(scenario, *runs))
    for i, one in enumerate(runs):
        alone = trained(population(scenario, one))
        assert_close(alone, among, 0, i)
        # What it flew is the same to the last bit, though a product of many rows may round otherwise.
        for name in ("users_collected", "landing_rate", "arrival_step", "throughput_bps"):
            np.testing.assert_array_equal(among.curves[name][:, i], alone.curves[name][:, 0], err_msg=name)


def test_seeds_differ():
    scenario = tiny()
    made = trained(population(scenario, run(scenario, 1), run(scenario, 2), run(scenario, 1)))
    one, two, same = (made.learner.parameters(i)["hidden_0.weight"] for i in range(3))
    assert np.abs(one - two).max() > 0.1
    np.testing.assert_array_equal(one, same)


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("observation", ["position", "mission", "map"])
def test_worlds_in_torch_fly_the_same_episodes(end, observation):
    """The way of a GPU, on the CPU: the same moves from the same places, at the same pay."""
    scenario = tiny(mission={"episode_end": end})
    made = population(scenario, *mixed(scenario), observation=observation)
    in_numpy, in_torch = (trained(made, worlds_in=library) for library in ("numpy", "torch"))
    expected, _ = in_numpy.state()
    found, _ = in_torch.state()
    assert expected.keys() == found.keys()
    n_inputs = observations.size(observation, scenario)
    rows = expected["buffer.rows"].shape[1]
    assert rows == made.n_episodes * scenario.mission.max_steps, "every step is there to compare"
    torch.testing.assert_close(found["buffer.rows"], expected["buffer.rows"], rtol=1e-4, atol=1e-5)
    action, terminated = 2 * n_inputs, 2 * n_inputs + 2
    for column in (action, terminated):
        assert torch.equal(found["buffer.rows"][..., column], expected["buffer.rows"][..., column])
    for name in ("world.step", "world.cell", "world.collected", "books.arrival"):
        assert torch.equal(found[name], expected[name]), name
    for one in range(len(made.runs)):
        assert_close(in_numpy, in_torch, one, one)


class Crossings(TorchDispatchMode):
    """Counts what makes a device and the host wait for each other, or carries data between them."""

    OPERATORS = ("_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "lift_fresh")
    METHODS = (
        "item", "tolist", "numpy", "cpu", "__bool__", "__int__", "__float__", "__index__", "__array__",
        "__len__", "__iter__",
    )  # fmt: skip
    FUNCTIONS = ("from_numpy", "tensor", "as_tensor", "asarray")

    def __init__(self, monkeypatch):
        super().__init__()
        self.counts = collections.Counter()
        for owner, names in ((torch.Tensor, self.METHODS), (torch, self.FUNCTIONS)):
            for name in names:
                monkeypatch.setattr(owner, name, self.counted(name, getattr(owner, name)))

    def counted(self, name, function):
        def count(*arguments, **values):
            self.counts[name] += 1
            return function(*arguments, **values)

        return count

    def __torch_dispatch__(self, function, types, arguments=(), values=None):
        name = function.overloadpacket.__name__
        if name in self.OPERATORS:
            self.counts[name] += 1
        if name.startswith("index") and any(map(_is_mask, torch.utils._pytree.tree_leaves(arguments[1:]))):
            self.counts["nonzero"] += 1  # how many are chosen must be known
        return function(*arguments, **values or {})


def _is_mask(value):
    return isinstance(value, torch.Tensor) and value.dtype == torch.bool


def crossings(end, n_steps, worlds_in="torch"):
    scenario = tiny(mission={"episode_end": end, "max_steps": n_steps})
    # Exploring, so that under `on_arrival` missions end in the midst of an episode.
    made = population(scenario, *mixed(scenario, episodes=1, target_every=4))
    training = Training(made, CPU, worlds_in)
    with pytest.MonkeyPatch.context() as monkeypatch, Crossings(monkeypatch) as seen:
        training.fly_episode()
    assert len(training.curves["reward"]) == 1
    return seen.counts


@pytest.mark.parametrize("end", ENDS)
def test_the_number_of_waits_of_a_device_does_not_grow_with_the_steps(end):
    crossings(end, 8)  # constants are made once, the first time they are met
    few, many = crossings(end, 8), crossings(end, 32)
    assert few["cpu"] > 0, "the end of an episode is sent to the host"
    assert few["from_numpy"] > 0, "the start of an episode is sent to the device"
    assert many == few


def test_the_count_notices_a_crossing():
    """With worlds on the host, as beside a CPU, every step crosses over: the count is not blind."""
    few, many = crossings("at_time_limit", 8, None), crossings("at_time_limit", 32, None)
    assert many["numpy"] - few["numpy"] >= 24
    assert many["from_numpy"] - few["from_numpy"] >= 24
    values = torch.tensor([1.0, 2.0])
    with pytest.MonkeyPatch.context() as monkeypatch, Crossings(monkeypatch) as seen:
        values[values > 1.5]
        if values.sum() > 0.0:
            values.max().item()
    assert seen.counts["nonzero"] == 1
    assert seen.counts["_local_scalar_dense"] + seen.counts["is_nonzero"] >= 2


@pytest.mark.parametrize("end", ENDS)
def test_nothing_is_left_on_the_host(end, monkeypatch):
    """The meta device knows shapes and no values: reading one is an error, as is a tensor of the CPU."""
    meta, scenario = torch.device("meta"), tiny(mission={"episode_end": end})
    # Its own Adam is for devices that compute.
    monkeypatch.setattr(torch.optim, "Adam", lambda groups, fused: torch.optim.SGD(groups, foreach=False))
    monkeypatch.setattr(torch.Tensor, "cpu", lambda values: torch.zeros(values.shape))
    training = Training(population(scenario, *mixed(scenario), observation="map"), meta)
    training.fly_episode()
    arrays, _ = training.state()
    on_host = {name for name, values in arrays.items() if values.device != meta}
    assert on_host == {"learner.iterations", "buffer.added", "curves"}


def starts(made, monkeypatch, worlds_in=None):
    """Where users stood at the start of every mission of each run: N lists of `[U, 2]`."""
    found = [[] for _ in made.runs]
    restart = BatchWorld.restart

    def noted(worlds, where, draws):
        restart(worlds, where, draws)
        for i in np.flatnonzero(np.asarray(where)):
            found[i].append(np.asarray(worlds.state.users_m)[i].copy())

    monkeypatch.setattr(BatchWorld, "restart", noted)
    training = Training(made, CPU, worlds_in)
    for i, users_m in enumerate(np.asarray(training.state()[0]["world.users_m"])):
        found[i].append(users_m)
    for _ in range(made.n_episodes):
        training.fly_episode()
    return found


@pytest.mark.parametrize("worlds_in", ["numpy", "torch"])
@pytest.mark.parametrize("end", ENDS)
def test_a_fixed_environment_is_the_layout_of_the_mission_with_its_seed(end, worlds_in, monkeypatch):
    # One step from the dock: under `on_arrival` an exploring run ends many missions.
    scenario = tiny(mission={"episode_end": end, "start_m": [100.0, 200.0, 100.0]})
    values = {"epsilon": 0.0, "episodes": 12}
    runs = [run(scenario, i, environment=e, **values) for i, e in enumerate([None, 11, 12, 11])]
    found = starts(population(scenario, *runs), monkeypatch, worlds_in)
    for own, one in zip(found, runs, strict=True):
        # The first start, and one after each mission.
        assert len(own) > 13 if end == "on_arrival" else len(own) == 13
        if one.environment is None:
            assert len({users_m.tobytes() for users_m in own}) == len(own), "each is another"
        else:
            assert {users_m.tobytes() for users_m in own} == {own[0].tobytes()}
            _, info = DataCollectionEnv(scenario).reset(seed=one.environment)
            np.testing.assert_allclose(own[0], info["users_m"], rtol=1e-5, atol=1e-3)
    assert not np.allclose(found[1][0], found[2][0])


def flown_by_hand(scenario, one, actions):
    """The transitions, and the figures of every episode's missions, of a run's actions `[T]`.

    As the Gymnasium environment returns them.
    """
    values = msgspec.structs.replace(scenario, reward=one.reward)
    env, limit = DataCollectionEnv(values), scenario.mission.max_steps
    transitions, episodes, missions = [], [], []
    before, _ = env.reset(seed=one.environment)
    paid, rates, totals, arrival, step = 0.0, [], [], None, 0
    for t, action in enumerate(actions, start=1):
        after, reward, terminated, truncated, info = env.step(np.int64(action))
        transitions.append(np.concatenate([before, after, [action, reward, terminated]]))
        before = after
        step += 1
        paid += reward
        rates.append(float(info["sum_rate_bps"]))
        away = math.dist(info["cell"][:2], scenario.dock_cell)
        arrival = None if away else arrival or step
        r_plus = float(not away) if one.reward.r_plus == "binary" else math.exp(-away)
        counted = info["data_bits"]
        if one.reward.data == "step":
            counted = info["rate_bps"] * info["served"] * scenario.mission.step_s
        data = float(counted.mean()) / one.reward.data_scale_bits
        totals.append(one.reward.beta * data + one.reward.zeta * r_plus)
        if terminated or truncated:
            landed = bool(info["landed"])
            missions.append(
                {
                    "reward": np.mean(totals) if one.reward.data == "step" else totals[-1],
                    "episode_return": paid,
                    "throughput_bps": np.mean(rates),
                    "users_collected": info["collected"].sum(),
                    "landing_rate": landed,
                    "arrival_step": arrival if landed else limit,
                }
            )
            before, _ = env.reset(seed=one.environment)
            paid, rates, totals, arrival, step = 0.0, [], [], None, 0
        if t % limit == 0:
            episodes.append(missions)
            missions = []
    return np.array(transitions), episodes


@pytest.mark.parametrize("worlds_in", ["numpy", "torch"])
@pytest.mark.parametrize("end", ENDS)
def test_transitions_and_statistics_are_those_of_the_environment_for_the_same_actions(end, worlds_in):
    # No user walks, so that a run's environment and its actions decide everything.
    scenario = tiny(mission={"episode_end": end, "start_m": [100.0, 200.0, 100.0]}, users={"v_max_mps": 0.0})
    paid = [
        {"form": "immediate", "beta": 2.0, "zeta": 3.0, "r_plus": "exponential"},
        {"form": "episode", "beta": 1.0, "zeta": 0.5, "r_plus": "binary"},
        {"form": "immediate", "r_plus": "binary"},
        {"form": "episode", "r_plus": "exponential", "data_scale_bits": 1e6},
        {"form": "immediate", "r_plus": "exponential", "data": "step"},
        {"form": "episode", "r_plus": "binary", "data_scale_bits": 4e5, "data": "step"},
    ]
    runs = [
        run(scenario, i, environment=20 + i, epsilon=0.3, episodes=8, **own) for i, own in enumerate(paid)
    ]
    made = population(scenario, *runs)
    training = trained(made, worlds_in=worlds_in)
    rows = training.state()[0]["buffer.rows"]
    actions = rows[..., 2 * observations.size("mission", scenario)].to(torch.int64).numpy()
    max_missions = 0
    for i, one in enumerate(runs):
        transitions, episodes = flown_by_hand(scenario, one, actions[i])
        np.testing.assert_allclose(rows[i], transitions, rtol=1e-4, atol=1e-5)
        assert len(episodes) == 8
        max_missions = max(max_missions, *map(len, episodes))
        for name, values in training.curves.items():
            if name == "loss":
                assert np.isfinite(values).all()
                continue
            expected = [np.mean([mission[name] for mission in missions]) for missions in episodes]
            np.testing.assert_allclose(values[:, i], expected, rtol=2e-4, atol=1e-4, err_msg=f"{i} {name}")
    assert rows[..., -1].any(), "a mission has terminated"
    assert max_missions == 1 if end == "at_time_limit" else max_missions > 1, "several missions in an episode"
    assert len(set(training.curves["landing_rate"].ravel())) > 1, "some landed, some did not"


def test_the_loss_is_the_mean_over_the_iterations(monkeypatch):
    scenario = tiny()
    training = Training(population(scenario, *mixed(scenario)), CPU)
    update, losses = training.learner.update, []

    def noted(batch):
        losses.append(update(batch))
        return losses[-1].clone()

    monkeypatch.setattr(training.learner, "update", noted)
    for n in (1, 2):
        training.fly_episode()
        assert len(losses) == 8 * n, "one for each step"
        expected = torch.stack(losses[-8:]).mean(0)
        np.testing.assert_allclose(training.curves["loss"][-1], expected, rtol=1e-5)


@pytest.mark.parametrize("library", [np, torch], ids=["numpy", "torch"])
def test_an_episode_in_which_no_mission_ended_has_no_figures(library):
    scenario = tiny()
    worlds = BatchWorld(scenario, library.zeros((2, scenario.n_users, 2)))
    stats = EpisodeStats(scenario, worlds.state.total_reward)
    outcome = worlds.step(library.zeros((2,), dtype=library.int64), library.zeros((2, scenario.n_users, 2)))
    stats.add_step(worlds.state, outcome)
    second = library.asarray([False, True])
    stats.end_missions(second, worlds.state, outcome)
    for name, values in zip(CURVES, stats.take(), strict=False):
        assert np.isnan(values[0]), name
        assert np.isfinite(values[1]), name
    assert np.isnan(stats.take()).all(), "what was taken is gone"


@pytest.mark.parametrize("algorithm", ["dqn", "dueling_dqn"])
def test_it_learns_to_collect_and_land(algorithm):
    """Nine cells: the users stand on the way, and eight steps are enough to reach the dock."""
    scenario = tiny(reward={"form": "immediate", "beta": 4.0, "zeta": 4.0}, users={"v_max_mps": 0.0})
    values = {"episodes": 150, "batch_size": 32, "buffer_size": 2000, "target_every": 100, "epsilon": 0.8}
    runs = [run(scenario, seed, algorithm=algorithm, **values) for seed in (0, 1)]
    training = trained(population(scenario, *runs, hidden=(32,)))
    curves = training.curves
    assert curves["landing_rate"][-20:].mean() > 0.5
    assert curves["landing_rate"][-20:].mean() > curves["landing_rate"][:20].mean() + 0.2
    assert curves["episode_return"][-20:].mean() > curves["episode_return"][:20].mean()
    assert curves["loss"][-20:].mean() < curves["loss"][:20].mean()
    assert validate(training).brought_home.max() >= 2.0, "of four users, brought home by a greedy mission"


def test_validation_flies_what_is_exported():
    """Greedily, paid as each run is, from each run's own layout."""
    scenario = tiny()
    training = trained(population(scenario, *mixed(scenario)))
    seeds = range(1_000_000, 1_000_008)
    missions = roll_out_greedily(training, seeds)
    made = training.population
    shapes = [architecture(made, one) for one in made.runs]
    for i, one in enumerate(made.runs):
        own = msgspec.structs.replace(scenario, reward=one.reward)
        exact = {name: v.astype(np.float64) for name, v in training.learner.parameters(i).items()}

        def act(state, shape=shapes[i], exact=exact, own=own):
            seen = observe(made.observation, own, state).astype(np.float64)
            return network.q_values(shape, exact, seen).argmax(-1)

        layouts = [None]
        if one.environment is not None:
            drawn = np.random.default_rng(one.environment).random((scenario.n_users, 2))
            layouts = [drawn.astype(np.float32)]
        alone = roll_out(own, act, seeds, layouts=layouts)
        np.testing.assert_array_equal(missions.users_collected[i], alone.users_collected[0])
        np.testing.assert_array_equal(missions.landed[i], alone.landed[0])
        np.testing.assert_allclose(missions.reward[i], alone.reward[0], rtol=1e-6)
        np.testing.assert_allclose(missions.episode_return[i], alone.episode_return[0], rtol=1e-5, atol=1e-6)


def test_the_score_counts_users_brought_home():
    scenario = tiny()
    training = trained(population(scenario, *mixed(scenario)))
    missions = roll_out_greedily(training, VALIDATION_SEEDS)
    brought = [
        np.mean([n if landed else 0 for n, landed in zip(*both, strict=True)])
        for both in zip(missions.users_collected, missions.landed, strict=True)
    ]
    np.testing.assert_allclose(validate(training).brought_home, brought)


def test_policies_are_chosen_for_users_and_for_battery(monkeypatch):
    """Of four users and eight steps: a tenth of a user is worth two steps, and a hundredth is not."""
    scenario = tiny()
    collected = np.full((4, 100), 3)
    collected[1, 0] = 4
    collected[2, :10] = 4
    landed = np.ones((4, 100), bool)
    landed[3] = False
    arrival = np.where(landed, np.array([[5.0], [7.0], [6.0], [4.0]]), np.nan)
    nothing = np.zeros((4, 100))
    missions = Missions(
        users_collected=collected,
        landed=landed,
        steps=nothing,
        arrival_step=arrival,
        sum_rate_bps=nothing,
        data_bits=nothing,
        reward=nothing,
        episode_return=nothing,
    )
    monkeypatch.setattr(training_module, "roll_out_greedily", lambda training, seeds: missions)
    found = validate(Training(population(scenario, *[run(scenario, i) for i in range(4)]), CPU))
    np.testing.assert_allclose(found.brought_home, [3.0, 3.01, 3.1, 0.0])
    assert np.argsort(-found.selection_score).tolist() == [2, 0, 1, 3]
    # What versions before selected by: 1.1 J - 0.1
    merit = found.brought_home / 4 - 0.1 * np.array([5.0, 7.0, 6.0, 8.0]) / 8
    np.testing.assert_allclose(1.1 * found.selection_score - 0.1, merit)


def test_nothing_is_chosen_on_the_missions_that_judge():
    assert not set(VALIDATION_SEEDS) & set(TEST_SEEDS)


def test_progress_is_of_the_latest_episodes():
    scenario = tiny()
    training = trained(population(scenario, run(scenario, 0, episodes=23), run(scenario, 1, episodes=23)))
    means = latest_means(training)
    for name in ("episode_return", "users_collected", "landing_rate"):
        assert means[name] == pytest.approx(training.curves[name][3:].mean(), rel=1e-5), name
    assert training.curves["episode_return"][3:].mean() != training.curves["episode_return"].mean()


@pytest.mark.parametrize("key", ["episodes", "buffer_size", "target_every"])
def test_runs_that_cannot_share_a_batch_are_refused(key):
    scenario = tiny()
    with pytest.raises(TrainingError, match=rf"{key} of the runs of a population is \[7, 9\]"):
        population(scenario, run(scenario, **{key: 9}), run(scenario, **{key: 7}))


def test_a_population_without_runs_is_refused():
    with pytest.raises(TrainingError, match="0 runs"):
        population(tiny())
