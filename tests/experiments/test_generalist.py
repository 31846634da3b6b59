"""Training for any field: rewards are the objective, targets are right, a run repeats, resumes and learns."""

import itertools

import numpy as np
import pytest

from tests.experiments.test_train_cli import field, refused  # noqa: F401
from tests.support.worlds import changed
from uav_dc_ros.agents import policy, set_network
from uav_dc_ros.agents.set_network import SetArchitecture
from uav_dc_ros.agents.set_policy import PqnSettings, RolloutSettings
from uav_dc_ros.core import mission, world
from uav_dc_ros.core.entities.encoding import (
    ALLOWED,
    GLOBAL,
    GLOBALS,
    LOSS,
    PRICE,
    WORTH,
    allowed,
    planned_action,
)
from uav_dc_ros.core.grid import MOVES, Action
from uav_dc_ros.experiments.evaluate.evaluation import evaluate
from uav_dc_ros.experiments.train.cli import main
from uav_dc_ros.experiments.train.generalist import card, layouts, symmetry
from uav_dc_ros.experiments.train.generalist import training as training_module
from uav_dc_ros.experiments.train.generalist.missions import LayoutMissions
from uav_dc_ros.experiments.train.generalist.pqn import Batch, PqnLearner, PqnTraining, lambda_returns
from uav_dc_ros.experiments.train.generalist.rollout_training import (
    ADVANTAGE,
    VALUE,
    Decisions,
    RolloutLearner,
    RolloutTraining,
)
from uav_dc_ros.experiments.train.generalist.rollouts import Situations, action_values

pytestmark = pytest.mark.usefixtures("one_thread")
SMALL = SetArchitecture(width=8, hidden=(16,), n_actions=7)
# Keys of clusters, which a field of listed users lacks.
CLUSTERED = ("cluster_centres_m", "users_per_cluster", "cluster_radius_m")
SMALL_RUN = {"iterations": 4, "layouts": 2, "missions": 4, "batch_size": 20}


def begun(algorithm):
    """A training before its first iteration."""
    if algorithm == "rollouts":
        return RolloutTraining(RolloutSettings(**SMALL_RUN, kept=2, tested=0.3), SMALL, 3)
    return PqnTraining(PqnSettings(**SMALL_RUN), SMALL, 3)


@pytest.mark.parametrize("masked", [True, False])
def test_the_rewards_of_a_mission_add_up_to_its_objective(masked):
    drawn = [layouts.draw(seed) for seed in range(6)]
    assert {one.mission.episode_end for one in drawn} == {"at_time_limit", "on_arrival"} or masked
    rng = np.random.default_rng(1)
    weights = rng.random((len(drawn), 5))
    flown = LayoutMissions(drawn, weights, rng)
    total = np.zeros(weights.size)
    while not flown.all_over:
        seen, flying = flown.observe()
        mask = allowed(seen) if masked else np.ones((len(seen), 7), bool)
        reward, _ = flown.step((rng.random(mask.shape) * mask).argmax(axis=-1))
        assert not reward[~flying].any()
        total += reward
    found = flown.objective().reshape(-1)
    assert flown.landed.all() or not masked
    # A mission that lands in step 1 without a user has cost nothing: the constant between J and the sum.
    steps = np.repeat([one.mission.max_steps for one in drawn], 5)
    origin = (1.0 - weights.reshape(-1)) * (1.0 - 1.0 / steps)
    landed = flown.landed.reshape(-1)
    np.testing.assert_allclose((total + origin)[landed], found[landed], atol=1e-4)
    assert not found[~landed].any()
    np.testing.assert_allclose(total[~landed], -(1.0 - weights.reshape(-1))[~landed], atol=1e-4)


def test_layouts_have_all_that_is_drawn():
    drawn = [layouts.draw(seed) for seed in (*range(20), 63, 137)]
    assert sum(one.name.startswith("random_") for one in drawn) > 5
    assert sum(bool(one.obstacles) for one in drawn) > 0
    assert sum(bool(one.users.user) for one in drawn) > 0
    assert sum(one.energy is not None for one in drawn) > 0
    assert {one.radio.interference for one in drawn} == {"all", "associated", "none"}


def test_lambda_returns_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    reward, best = rng.random((2, 6, 3))
    over = np.zeros((6, 3), bool)
    over[3:, 0] = over[5:] = True
    for trace, discount in ((0.0, 0.9), (0.7, 1.0), (0.7, 0.9), (1.0, 0.9)):
        found = lambda_returns(reward, over, best, trace, discount)
        worth = discount ** np.arange(7)
        for one, t in itertools.product(range(3), range(6)):
            last = int(over[:, one].argmax())
            if t > last:
                continue
            # The mean of the n-step returns with weights (1 - trace) trace^(n - 1); the last has the rest.
            expected, left = 0.0, 1.0
            for n in range(1, last - t + 2):
                whole = t + n > last
                value = worth[:n] @ reward[t : t + n, one]
                value += 0.0 if whole else worth[n] * best[t + n, one]
                share = left if whole else left * (1.0 - trace)
                expected, left = expected + share * value, left - share
            assert found[t, one] == pytest.approx(expected)


def rows_of(n):
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (n, SMALL.n_global + 3 * SMALL.n_cluster)).astype(np.float32)
    rows[:, GLOBAL :: SMALL.n_cluster] = 1.0
    rows[:, PRICE] = 0.1
    rows[:, ALLOWED : ALLOWED + 7] = 1.0
    rows[:, LOSS : LOSS + 7] = 0.0
    return rows, rng


def test_pqn_fits_targets_of_taken_actions():
    rows, rng = rows_of(256)
    action = rng.integers(0, 7, 256)
    target = (rows[:, 3] + 2.0 * action).astype(np.float32)
    learner = PqnLearner(SMALL, set_network.initial(SMALL, rng))
    batch = Batch(rows, action, target, np.zeros(256, bool))
    losses = [learner.fit(batch, rng.permutation(256), 64, 1e-2) for _ in range(40)]
    assert losses[-1] < 0.1 * losses[0]
    best = learner.preferences(rows).argmax(axis=-1).mean()
    shown = Batch(rows, np.zeros_like(action), target - 2.0 * action, np.ones(256, bool))
    for _ in range(40):
        learner.fit(shown, rng.permutation(256), 64, 1e-2)
    assert best > 4.5  # mostly the last action, which is the best one
    assert (learner.preferences(rows).argmax(axis=-1) == 0).mean() > 0.9, "preferred as demonstrated"


def test_rollouts_fit_v_and_the_differences_from_the_plan():
    rows, rng = rows_of(512)
    settings = RolloutSettings(steps_max=2.0, caution=0.5)
    learner = RolloutLearner(SMALL, set_network.initial(SMALL, rng), settings)
    learner.set_rate(3e-3, VALUE)
    learner.set_rate(3e-3, ADVANTAGE)
    # A number that no symmetry changes decides which of two actions is better than the plan's hover, by two
    # steps of 0.1 J. One is so bad that only the limit counts, and one is not allowed.
    number = GLOBALS.index("steps_left")
    best = np.where(rows[:, number] > 0, Action.UPWARD, Action.DOWNWARD)
    values = np.repeat(rows[:, number, None] * np.float32(0.1), 7, axis=1)
    values[np.arange(512), best] += 0.2
    values[:, Action.RIGHT] -= 100.0
    values[:, Action.LEFT] = np.nan
    losses = []
    for _ in range(350):
        some = rng.integers(512, size=64)
        losses.append(learner.fit(Decisions(rows[some], values[some]), int(rng.choice([0, 4]))))
    assert np.mean(losses[-20:]) < 0.1 * np.mean(losses[:20])
    found = learner.preferences(rows)
    found = found - found[:, Action.HOVER, None]
    assert (found[:, 1:].argmax(axis=-1) + 1 == best).mean() > 0.9
    assert abs(found[np.arange(512), best].mean() - 1.5) < 0.2, "less by the caution"
    assert found[:, Action.RIGHT].max() < -1.0, "bad, by at least about the limit"


def test_what_an_action_is_worth_is_what_a_mission_gains_after_it():
    """Against missions that are flown one by one in an environment."""
    layout = changed("five_clusters", mission={"max_steps": 44}, users={"v_max_mps": 0.0})
    weights = np.asarray([0.3, 10 / 11], np.float32)

    rng = np.random.default_rng(4)
    start = np.repeat(rng.random((1, *layout.draws_shape), np.float32), 2, axis=0)
    state = world.initial(layout, start)
    state, _ = world.step(layout, state, np.asarray([1, 1]), np.repeat(start[:1], 2, axis=0))
    observation = world.observe("entities", layout, state, weights)
    situations = Situations(state=state, weight=weights, arrival=np.full(2, np.nan, np.float32))
    values = action_values(layout, situations, observation, planned_action, 1000, np.random.default_rng(1))
    assert (np.isnan(values) == ~allowed(observation)).all()
    for row, weight in enumerate(weights):
        for action in np.flatnonzero(allowed(observation)[row]):
            one = situations.take(np.asarray([row])).state
            before, arrival, act = float(one.collected.sum()), None, np.asarray([action])
            while int(one.step[0]) < 44:  # users stand still: no draw matters
                one, outcome = world.step(layout, one, act, start[:1])
                docked = bool(mission.at_dock(one.cell, layout.dock_cell)[0])
                arrival = (arrival or int(one.step[0])) if docked else None
                act = planned_action(world.observe("entities", layout, one, weights[row : row + 1]))
            assert bool(outcome.landed[0])
            assert arrival is not None
            gained = weight * (float(one.collected.sum()) - before) / layout.n_users
            assert values[row, action] == pytest.approx(gained - (1 - weight) * (arrival - 1) / 44, abs=1e-5)
    short = action_values(layout, situations, observation, planned_action, 1, np.random.default_rng(1))
    for action in np.flatnonzero(allowed(observation)[0]):
        after, _ = world.step(layout, state, np.asarray([action, action]), np.repeat(start[:1], 2, axis=0))
        left = world.observe("entities", layout, after, weights)[:, WORTH]
        users = after.collected.sum(axis=-1) - state.collected.sum(axis=-1)
        expected = weights * users / layout.n_users - (1 - weights) / 44 + left
        np.testing.assert_allclose(short[:, action], expected, atol=1e-6)


@pytest.mark.parametrize("number", range(symmetry.N))
def test_a_turned_field_is_seen_as_the_turned_observation(number):
    swap, mirror_x, mirror_y = (bool(number >> bit & 1) for bit in range(3))

    def turned(x, y, last=900.0):
        x, y = (y, x) if swap else (x, y)
        return (last - x if mirror_x else x), (last - y if mirror_y else y)

    def layout(turn):
        places = (130.0, 280.0), (660.0, 210.0), (420.0, 830.0)
        users = [{"x_m": x, "y_m": y} for x, y in (turn(*place) for place in places)]
        return changed(
            "three_clusters",
            grid={"n_x": 10, "n_y": 10, "n_z": 2, "cell_m": 100.0, "altitude_step_m": 50.0},
            users={"user": users, "v_max_mps": 0.0} | dict.fromkeys(CLUSTERED),
            mission={"start_m": (*turn(300.0, 200.0), 150.0), "dock_m": turn(800.0, 700.0), "max_steps": 40},
        )

    def observed(one):
        state = world.initial(one, np.full((1, *one.draws_shape), 0.5, np.float32))
        return world.observe("entities", one, state, 0.8)

    found = symmetry.symmetry(number)
    plain = observed(layout(lambda x, y: (x, y)))
    np.testing.assert_allclose(found.of_observation(plain), observed(layout(turned)), atol=2e-5)
    moves = np.asarray(MOVES)
    for new, old in enumerate(found.action):
        x, y = turned(*moves[old][:2].astype(float), 0.0)
        assert (x, y, moves[old][2]) == tuple(moves[new])


def test_layouts_repeat_and_differ_and_share_no_seed():
    one, again, other = (layouts.draw(seed) for seed in (5, 5, 6))
    assert one.fingerprint == again.fingerprint != other.fingerprint
    assert not set(layouts.SELECTION_SEEDS) & set(layouts.TRAINING_SEEDS[:: 10**6])
    assert layouts.SELECTION_SEEDS.stop <= layouts.TRAINING_SEEDS.start
    assert layouts.SELECTION_SEEDS.start > 10**5  # above those of `random:SEED` that test


# The command does it with rollouts: test_the_command_writes_a_policy...
@pytest.mark.parametrize("algorithm", [pytest.param("rollouts", marks=pytest.mark.long), "pqn"])
def test_a_run_repeats_and_continues_to_the_last_bit(algorithm):
    def run(n, training):
        for _ in range(n):
            training.iterate()
        return training

    whole, part = run(3, begun(algorithm)), run(1, begun(algorithm))
    resumed = begun(algorithm)
    arrays, values = part.state()
    resumed.restore({name: v.clone() for name, v in arrays.items()}, values)
    run(2, resumed)
    for name, expected in whole.learner.parameters().items():
        np.testing.assert_array_equal(resumed.learner.parameters()[name], expected, err_msg=name)
    assert resumed.curve == whole.curve
    assert all(one.landed == 1.0 for one in whole.curve)
    assert np.abs(whole.learner.parameters()["advantage.head.weight"]).max() > 0, "it has learnt something"


@pytest.fixture
def quick(monkeypatch):
    """Fewer missions that select and evaluate."""
    monkeypatch.setattr(training_module, "SELECTION_LAYOUTS", 2)
    monkeypatch.setattr(training_module, "SELECTION_MISSIONS", 2)
    monkeypatch.setattr(card, "names", lambda: ["three_clusters"])
    monkeypatch.setattr(card, "evaluate", lambda made, world: evaluate(made, world, range(2)))


def command(folder, *more):
    options = (
        "--scenario random --algo rollouts --iterations 3 --layouts 2 --missions 3 --width 8 --hidden 16"
    )
    return [*options.split(), "--checkpoint-every", "2", "--out", str(folder), *more]


def test_the_command_writes_a_policy_and_resumes_with_the_same_bytes(tmp_path, monkeypatch, quick, capsys):
    with pytest.raises(SystemExit) as exit:
        main(command(tmp_path / "whole"))
    assert exit.value.code == 0
    made = policy.load(tmp_path / "whole")
    assert made.scenario.name == "five_clusters"
    files = {path.name for path in made.folder.iterdir()}
    assert files == {policy.CONFIG, policy.MODEL, policy.CARD, policy.LEARNING_CURVE, policy.TRAJECTORY}
    text = (made.folder / policy.CARD).read_text()
    assert "seeds 10000000 to 10000005" in text
    assert "| `three_clusters` |" in text

    iterate = RolloutTraining.iterate

    def stopped(self):
        if self.n_done == 2:
            raise KeyboardInterrupt
        return iterate(self)

    monkeypatch.setattr(RolloutTraining, "iterate", stopped)
    with pytest.raises(SystemExit) as exit:
        main(command(tmp_path / "again" / "whole"))
    assert exit.value.code == 130
    assert "--resume continues" in capsys.readouterr().err
    monkeypatch.setattr(RolloutTraining, "iterate", iterate)
    other = [*command(tmp_path / "again" / "whole"), "--resume", "--seed", "1"]
    assert "with seed = 0; expected 1" in refused(capsys, *other)
    with pytest.raises(SystemExit) as exit:
        main(command(tmp_path / "again" / "whole", "--resume"))
    assert exit.value.code == 0
    for name in (policy.CONFIG, policy.MODEL):
        assert (tmp_path / "again" / "whole" / name).read_bytes() == (made.folder / name).read_bytes()
    assert not list((tmp_path / "again").glob("*.checkpoints"))


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (["--scenario", "five_clusters"], "argument --scenario: invalid choice: 'five_clusters'"),
        (["--tested", "2"], "--tested is 2.0; expected float <= 1.0"),
        (["--layouts", "0"], "--layouts is 0; expected int >= 1"),
        (["--observation", "map"], "argument --observation: invalid choice: 'map'"),
    ],
)
def test_bad_options_are_one_error(tmp_path, capsys, more, expected):
    assert expected in refused(capsys, *command(tmp_path / "new"), *more)
    assert not list(tmp_path.iterdir())


def test_a_dqn_with_entities_double_targets_and_n_step_returns_lands(tmp_path, field):  # noqa: F811
    """It learns one field; the observation names the actions from which it can land."""
    options = "--algo dueling_double_dqn --n-step 3 --observation entities --episodes 2 --hidden 8"
    with pytest.raises(SystemExit) as exit:
        main(["--scenario", str(field), *options.split(), "--out", str(tmp_path / "made")])
    assert exit.value.code == 0
    made = policy.load(tmp_path / "made")
    assert made.config.hyperparameters.n_step == 3
    assert "Dueling double DQN for the scenario `tiny`" in (made.folder / policy.CARD).read_text()
    assert evaluate(made, made.scenario, range(20)).landing_rate.mean == 1.0
