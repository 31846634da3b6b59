"""The plan of the sweep: complete, without repetition, paired."""

from itertools import product

import pytest

from uav_dc_ros import scenarios
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.claims.findings import CLAIMS
from uav_dc_ros.experiments.paper.plan import FIGURES, runs
from uav_dc_ros.experiments.paper.setting import (
    ALGORITHMS,
    FORMS,
    FULL,
    MAX_BLOCK,
    R_PLUS,
    RATIOS,
    SCALES,
    SMOKE,
    Setting,
)
from uav_dc_ros.experiments.paper.sweep import make_shards
from uav_dc_ros.experiments.train.training import VALIDATION_SEEDS

EVERYTHING = list(product(("three_clusters", "five_clusters"), ALGORITHMS, R_PLUS, FORMS, RATIOS))


@pytest.mark.parametrize("scale", SCALES.values(), ids=str)
def test_no_run_is_trained_twice_and_the_order_is_always_the_same(scale):
    planned = runs(scale)
    assert len(set(planned)) == len(planned)
    assert planned == runs(scale)
    assert runs(scale, ["lr", "Traj"]) == runs(scale, ["Traj", "lr"])


def test_the_full_sweep_has_every_combination_in_ten_environments_once():
    planned = runs(FULL)
    assert len(EVERYTHING) == 112
    for scenario, algorithm, r_plus, form, (beta, zeta) in EVERYTHING:
        wanted = Setting(
            scenario=scenario, algorithm=algorithm, r_plus=r_plus, form=form, beta=beta, zeta=zeta
        )
        found = [(run.environment, run.repeat) for run in planned if run.setting == wanted]
        assert found == list(product(range(10), [0])), wanted


def test_runs_of_one_environment_and_repeat_share_their_seed_and_no_others():
    seeds = {}
    for run in runs(FULL):
        seeds.setdefault((run.environment, run.repeat), set()).add(run.run(FULL).seed)
    assert all(len(of_pair) == 1 for of_pair in seeds.values())
    assert len(set.union(*seeds.values())) == len(seeds)


def test_blocks_have_environments_seeds_and_greedy_missions_of_their_own():
    """And none of those that train, validate or evaluate policies."""
    used = set(range(1000)) | set(VALIDATION_SEEDS)
    missions = set(VALIDATION_SEEDS)
    for block in (1, 2, MAX_BLOCK):
        scale = FULL.in_block(block)
        planned = runs(scale)
        assert [run.setting for run in planned] == [run.setting for run in runs(FULL)]
        assert scale.environments == tuple(10_000 * block + e for e in range(10))
        own = {run.environment for run in planned} | {run.seed for run in planned}
        assert not own & used
        used |= own
        (shard, _), *_ = make_shards(planned[:1], scale)
        first, count = shard.greedy_seeds
        assert not set(range(first, first + count)) & missions
        missions |= set(range(first, first + count))
    assert FULL.in_block(0) == FULL


def test_a_run_is_what_its_setting_says():
    setting = Setting(
        scenario="three_clusters",
        algorithm="dueling_dqn",
        r_plus="binary",
        form="immediate",
        beta=1,
        zeta=4,
        gamma=0.8,
        epsilon=0.7,
        batch_size=64,
        learning_rate=1e-4,
    )
    planned = next(iter(runs(FULL)))._replace(setting=setting, environment=3)
    run = planned.run(FULL)
    assert (run.environment, run.algorithm) == (3, "dueling_dqn")
    assert (run.reward.beta, run.reward.zeta) == (1.0, 4.0)
    assert (run.reward.r_plus, run.reward.form) == ("binary", "immediate")
    assert run.reward.data_scale_bits == scenarios.load("three_clusters").reward.data_scale_bits
    learning = run.hyperparameters
    assert (learning.gamma, learning.epsilon) == (0.8, 0.7)
    assert (learning.batch_size, learning.learning_rate, learning.episodes) == (64, 1e-4, FULL.episodes)


def test_ratios_are_written_as_in_the_paper():
    assert Setting().with_(ratio=(2, 1)).beta == 2
    assert [beta / zeta for beta, zeta in RATIOS] == [0.25, 1 / 3, 0.5, 1, 2, 3, 4]


def test_every_figure_and_every_claim_of_the_paper_is_there():
    assert len(FIGURES) == 13
    assert [claim.id for claim in CLAIMS] == [f"C{i}" for i in range(1, 21)]
    assert all(claim.figures for claim in CLAIMS)
    assert {name for figure in FIGURES.values() for name in figure.claims} == {claim.id for claim in CLAIMS}


def test_smoke_is_small():
    steps = sum(scenarios.load(run.setting.scenario).mission.max_steps for run in runs(SMOKE))
    assert steps * SMOKE.episodes <= 60_000


def test_an_unknown_figure_is_named():
    with pytest.raises(TrainingError, match=r"no figure 'lrr'; expected one of Traj, .*, lr"):
        runs(FULL, ["lr", "lrr"])
