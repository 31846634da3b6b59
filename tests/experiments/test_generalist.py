"""Training for any field: rewards are the objective, targets are right, a run repeats, resumes and learns."""

import itertools

import numpy as np
import pytest

from tests.experiments.test_train_cli import field, refused  # noqa: F401
from uav_dc_ros.agents import policy, set_network
from uav_dc_ros.agents.set_network import SetArchitecture
from uav_dc_ros.agents.set_policy import PqnSettings
from uav_dc_ros.core.entities.encoding import ALLOWED, GLOBAL, allowed
from uav_dc_ros.experiments.evaluate.evaluation import evaluate
from uav_dc_ros.experiments.train.cli import main
from uav_dc_ros.experiments.train.generalist import card, layouts
from uav_dc_ros.experiments.train.generalist import training as training_module
from uav_dc_ros.experiments.train.generalist.missions import LayoutMissions
from uav_dc_ros.experiments.train.generalist.pqn import Batch, PqnLearner, lambda_returns
from uav_dc_ros.experiments.train.generalist.training import GeneralistTraining

pytestmark = pytest.mark.usefixtures("one_thread")
SMALL = SetArchitecture(width=8, hidden=(16,), n_actions=7)
SETTINGS = PqnSettings(iterations=4, layouts=2, missions=4, batch_size=64)


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
    drawn = [layouts.draw(seed) for seed in range(30)]
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
        for mission, t in itertools.product(range(3), range(6)):
            last = int(over[:, mission].argmax())
            if t > last:
                continue
            # The mean of the n-step returns with weights (1 - trace) trace^(n - 1); the last has the rest.
            expected, left = 0.0, 1.0
            for n in range(1, last - t + 2):
                whole = t + n > last
                value = worth[:n] @ reward[t : t + n, mission]
                value += 0.0 if whole else worth[n] * best[t + n, mission]
                share = left if whole else left * (1.0 - trace)
                expected, left = expected + share * value, left - share
            assert found[t, mission] == pytest.approx(expected)


def test_the_learner_fits_targets_of_taken_actions():
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (256, SMALL.n_global + 3 * SMALL.n_cluster)).astype(np.float32)
    rows[:, GLOBAL :: SMALL.n_cluster] = 1.0
    action = rng.integers(0, 7, 256)
    target = (rows[:, 3] + 0.2 * action).astype(np.float32)
    learner = PqnLearner(SMALL, set_network.initial(SMALL, rng))
    batch = Batch(rows, action, target, np.zeros(256, bool))
    losses = [learner.fit(batch, rng.permutation(256), 64, 3e-3) for _ in range(40)]
    assert losses[-1] < 0.1 * losses[0]
    rows[:, ALLOWED : ALLOWED + 7] = 1.0
    best = 0.2 * learner.q_values(rows).argmax(axis=-1).mean()
    shown = Batch(rows, np.zeros_like(action), target - 0.2 * action, np.ones(256, bool))
    for _ in range(40):
        learner.fit(shown, rng.permutation(256), 64, 3e-3)
    assert best > 1.0  # the last action is the best one
    assert (learner.q_values(rows).argmax(axis=-1) == 0).mean() > 0.9, "preferred as demonstrated"
    assert learner.q_values(rows).shape == (256, 7)


def test_layouts_repeat_and_differ_and_share_no_seed():
    one, again, other = (layouts.draw(seed) for seed in (5, 5, 6))
    assert one.fingerprint == again.fingerprint != other.fingerprint
    assert not set(layouts.SELECTION_SEEDS) & set(layouts.TRAINING_SEEDS[:: 10**6])
    assert layouts.SELECTION_SEEDS.stop <= layouts.TRAINING_SEEDS.start
    assert layouts.SELECTION_SEEDS.start > 10**5  # above those of `random:SEED` that test


def run(n, training=None):
    training = training or GeneralistTraining(SETTINGS, SMALL, 3)
    for _ in range(n):
        training.iterate()
    return training


def test_a_run_repeats_and_continues_to_the_last_bit():
    whole, part = run(3), run(1)
    resumed = GeneralistTraining(SETTINGS, SMALL, 3)
    arrays, values = part.state()
    resumed.restore({name: v.clone() for name, v in arrays.items()}, values)
    run(2, resumed)
    for name, expected in whole.learner.parameters().items():
        np.testing.assert_array_equal(resumed.learner.parameters()[name], expected, err_msg=name)
    assert resumed.curve == whole.curve
    assert all(one.landed == 1.0 for one in whole.curve)


@pytest.fixture
def quick(monkeypatch):
    """Fewer missions that select and evaluate."""
    monkeypatch.setattr(training_module, "SELECTION_LAYOUTS", 2)
    monkeypatch.setattr(training_module, "SELECTION_MISSIONS", 2)
    monkeypatch.setattr(card, "names", lambda: ["three_clusters"])
    monkeypatch.setattr(card, "evaluate", lambda made, world: evaluate(made, world, range(2)))


def command(folder, *more):
    options = "--scenario random --algo pqn --iterations 3 --layouts 2 --missions 3 --width 8 --hidden 16"
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

    iterate = GeneralistTraining.iterate

    def stopped(self):
        if self.n_done == 2:
            raise KeyboardInterrupt
        return iterate(self)

    monkeypatch.setattr(GeneralistTraining, "iterate", stopped)
    with pytest.raises(SystemExit) as exit:
        main(command(tmp_path / "again" / "whole"))
    assert exit.value.code == 130
    assert "--resume continues" in capsys.readouterr().err
    monkeypatch.setattr(GeneralistTraining, "iterate", iterate)
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
        (["--trace", "2"], "--trace is 2.0; expected float <= 1.0"),
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
