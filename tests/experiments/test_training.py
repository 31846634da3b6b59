"""Training: it repeats, a run does not depend on the others, and it learns."""

import numpy as np
import pytest
import torch

from tests.small_worlds import config, tiny
from uav_dc_ros.agents.policy import Hyperparameters
from uav_dc_ros.experiments.evaluate import TEST_SEEDS
from uav_dc_ros.experiments.train import VALIDATION_SEEDS, train, validate

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def one_thread():
    """What training promises to repeat, it promises for one number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def last(made, scenario, n_runs=1):
    reports = list(train(made, scenario, n_runs, 1000, CPU))
    return reports[-1]


def test_it_repeats():
    scenario = tiny()
    made = config(scenario, hyperparameters=Hyperparameters(episodes=6, batch_size=8, target_every=10))
    first, second = last(made, scenario, 2), last(made, scenario, 2)
    assert (first.mean_return, first.score, first.run) == (second.mean_return, second.score, second.run)
    for name, values in first.best.items():
        np.testing.assert_array_equal(values, second.best[name])


def test_a_run_learns_alone_what_it_learns_among_others():
    scenario = tiny()
    values = Hyperparameters(episodes=8, batch_size=8, target_every=10)
    among = last(config(scenario, hyperparameters=values, seed=20), scenario, 3)
    alone = last(config(scenario, hyperparameters=values, seed=20 + among.run), scenario)
    assert alone.score == among.score
    for name, arrays in among.best.items():
        np.testing.assert_allclose(arrays, alone.best[name], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("algorithm", ["dqn", "dueling_dqn"])
def test_it_learns_to_collect_and_land(algorithm):
    """Nine cells: the users stand on the way, and eight steps are enough to reach the dock."""
    scenario = tiny(reward={"form": "immediate", "beta": 4.0, "zeta": 4.0}, users={"v_max_mps": 0.0})
    made = config(
        scenario,
        algorithm=algorithm,
        hidden=(32,),
        hyperparameters=Hyperparameters(episodes=150, batch_size=32, target_every=100, epsilon=0.8),
    )
    report = last(made, scenario, 2)
    assert report.landing_rate > 0.5
    assert report.score >= 2.0, "of four users, brought home by a greedy mission"


@pytest.mark.parametrize("end", ["at_time_limit", "on_arrival"])
def test_figures_of_a_report_are_those_of_episodes(end):
    scenario = tiny(mission={"episode_end": end})
    reports = list(train(config(scenario), scenario, 3, 1, CPU))
    assert [report.episode for report in reports] == [1, 2]
    for report in reports:
        assert 0.0 <= report.landing_rate <= 1.0
        assert 0.0 <= report.users_collected <= 4.0
        assert np.isfinite(report.mean_return)
    assert reports[0].best is not None, "the first validation is the best until then"


def test_the_best_is_what_validation_found():
    scenario = tiny()
    report = last(config(scenario), scenario, 3)
    one = {name: values[None] for name, values in report.best.items()}
    assert validate(config(scenario), scenario, one, 1).tolist() == [report.score]


def test_nothing_is_chosen_on_the_missions_that_judge():
    assert not set(VALIDATION_SEEDS) & set(TEST_SEEDS)
