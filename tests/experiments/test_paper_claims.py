"""The paper's claims on made-up results: each can come true, and each can fail."""

import dataclasses
import functools

import numpy as np
import pytest

from tests.experiments.paper_sweeps import SHORT, of_the_data_of_the_step, realistic, sweep
from uav_dc_ros.core.stats import Interval
from uav_dc_ros.experiments.paper.claims.criteria import (
    RULES,
    Criterion,
    all_within,
    everywhere,
    fall,
    greater,
    joint,
    lead,
    within,
)
from uav_dc_ros.experiments.paper.claims.findings import CLAIMS, check, finding
from uav_dc_ros.experiments.paper.evidence import Evidence, settling
from uav_dc_ros.experiments.paper.plan import FIGURES, runs
from uav_dc_ros.experiments.paper.report import tables_md
from uav_dc_ros.experiments.paper.setting import FULL, RATIOS, SMOKE, Setting

ONE = RATIOS.index((1, 1))


def three(s):
    return s.scenario == "three_clusters"


def dueling(s):
    return s.algorithm == "dueling_dqn"


def exponential(s):
    return s.r_plus == "exponential"


def episode(s):
    return s.form == "episode"


def reward(s, *factors):
    return {"reward": (s.beta + s.zeta) * np.prod(factors)}


def data(*factors):
    return {"throughput_bps": 2e5 * np.prod(factors)}


def above_one(s):
    """How many ratios above 1:1; 0 up to it."""
    return max(RATIOS.index(s.ratio) - ONE, 0)


def dueling_last(s):
    return dueling(s) and s.ratio == (4, 1)


def best_of_11(s):
    return data(1.5 if dueling(s) and not exponential(s) else 1.0) if s.ratio == (1, 1) else {}


def dqn_peak(s):
    return data(1.2) if not dueling(s) and s.ratio == (1, 2) else {}


def rates(s, reward_of, tau_of, jitter_of):
    rate = s.learning_rate
    return reward(s, reward_of.get(rate, 1)) | {"tau": tau_of.get(rate, 20), "jitter": jitter_of.get(rate, 0)}


# What each setting reaches in a world in which the claim is true.
TRUE = {
    "C1": lambda s: {"greedy_users_collected": 37.0},
    "C2": lambda s: reward(s, 1 + 0.1 * exponential(s)) | {"tau": 20 if exponential(s) else 60},
    "C3": lambda s: reward(s, 1 + 0.1 * exponential(s), 1 + 0.1 * dueling(s)),
    "C4": lambda s: reward(s, 1 + 0.1 * episode(s)),
    "C5": lambda s: reward(s, 1 + 0.01 * dueling(s)) | {"tau": 30},
    "C6": lambda s: reward(s, 1 + 0.1 * dueling(s)) | {"tau": 20 if dueling(s) else 60},
    "C7": lambda s: reward(s, 1 + 0.1 * dueling(s), 1 + exponential(s) * (0.02 if above_one(s) else 0.1)),
    "C8": lambda s: reward(s, 1 + 0.1 * episode(s)) | {"tau": 20 if exponential(s) else 60},
    "C9": lambda s: reward(s, 1 + 0.1 * episode(s)),
    "C10": lambda s: data(1 - 0.05 * abs(RATIOS.index(s.ratio) - ONE)),
    "C11": lambda s: best_of_11(s) | dqn_peak(s),
    "C12": lambda s: data(1.2 if s.ratio in ((1, 1), (2, 1)) else 1.0),
    "C13": lambda s: data(1 + 0.01 * above_one(s)),
    "C14": lambda s: data(1 - 0.05 * above_one(s)) | {"arrival_step": 40.0 - above_one(s)},
    "C15": lambda s: data(1 + 0.1 * episode(s)),
    "C16": lambda s: data(1 + 0.1 * dueling(s) * (-1 if s.ratio == (4, 1) else 1)),
    "C17": lambda s: data(1 + 0.1 * exponential(s), 1 + 0.1 * episode(s), 1 + 0.1 * dueling(s)),
    "C18": lambda s: reward(s, 1.2 if (s.gamma, s.epsilon) == (0.9, 0.9) else 1.0),
    "C19": lambda s: {"tau": 20 if s.batch_size == 32 else 60},
    "C20": lambda s: rates(s, {1e-3: 1.1, 1e-5: 0.4}, {1e-4: 100, 1e-5: 100}, {1e-2: 0.3}),
}
# And in one in which one part of it is false, the others being true.
FALSE = {
    "C1 lands": ("C1", lambda s: TRUE["C1"](s) | {"greedy_landing_rate": 0.1}),
    "C1 users": ("C1", lambda s: {"greedy_users_collected": 27.0}),
    "C2 best": ("C2", lambda s: TRUE["C2"](s) | reward(s, 1 - 0.1 * exponential(s))),
    "C2 faster": ("C2", lambda s: TRUE["C2"](s) | {"tau": 30}),
    "C3 dueling": ("C3", lambda s: reward(s, 1 + 0.1 * exponential(s), 1 - 0.1 * dueling(s))),
    "C3 exponential": ("C3", lambda s: reward(s, 1 - 0.1 * exponential(s), 1 + 0.1 * dueling(s))),
    "C4": ("C4", lambda s: reward(s, 1 + 0.1 * episode(s) * (1 if exponential(s) or dueling(s) else -1))),
    "C5 similar": ("C5", lambda s: reward(s, 1 + 0.2 * dueling(s)) | {"tau": 30}),
    "C5 stable": ("C5", lambda s: {"tau": 300}),
    "C6 best": ("C6", lambda s: TRUE["C6"](s) | reward(s, 1 - 0.1 * dueling(s))),
    "C6 faster": ("C6", lambda s: TRUE["C6"](s) | {"tau": 30}),
    "C7 dueling": (
        "C7",
        lambda s: TRUE["C7"](s) | (reward(s, 0.5) if dueling(s) and s.ratio == (4, 1) else {}),
    ),
    "C7 exponential": ("C7", lambda s: reward(s, 1 + 0.1 * dueling(s), 1 - 0.1 * exponential(s))),
    "C7 above": (
        "C7",
        lambda s: reward(s, 1 + 0.1 * dueling(s), 1 + 0.1 * exponential(s) * (1 + above_one(s))),
    ),
    "C8 form": ("C8", lambda s: TRUE["C8"](s) | reward(s, 1 - 0.1 * episode(s))),
    "C8 faster": ("C8", lambda s: TRUE["C8"](s) | {"tau": 60 if exponential(s) else 20}),
    "C8 above": ("C8", lambda s: TRUE["C8"](s) | reward(s, 1 - episode(s) * (0.2 * above_one(s) - 0.1))),
    "C9": ("C9", lambda s: reward(s, 1 - 0.1 * episode(s))),
    "C10 highest": ("C10", lambda s: data(1 - 0.05 * RATIOS.index(s.ratio))),
    "C10 falls": ("C10", lambda s: data(2.0 if s.ratio == (1, 1) else 1 + 0.5 * above_one(s))),
    "C11 best": ("C11", lambda s: dqn_peak(s)),
    "C11 peak": ("C11", lambda s: best_of_11(s)),
    "C12": ("C12", lambda s: data(1.2 if s.ratio == (1, 1) else 1.0)),
    "C13": ("C13", lambda s: data(0.6 if s.ratio == (4, 1) else 1.0)),
    "C14 stable": ("C14", lambda s: TRUE["C14"](s) | (data(2.0) if s.ratio == (1, 4) else {})),
    "C14 falls": ("C14", lambda s: TRUE["C14"](s) | data(1 + 0.05 * above_one(s))),
    "C14 shorter": ("C14", lambda s: TRUE["C14"](s) | {"arrival_step": 40.0 + above_one(s)}),
    "C15": ("C15", lambda s: data(1 + 0.1 * episode(s) * (-1 if s.ratio == (1, 3) else 1))),
    "C16": ("C16", lambda s: data(1 + 0.1 * dueling(s) * (-1 if s.ratio in ((4, 1), (1, 1)) else 1))),
    "C17 exponential": ("C17", lambda s: data(1 - 0.1 * exponential(s), 1.5 if favourite_of_17(s) else 1.0)),
    "C17 best": ("C17", lambda s: data(1 + 0.1 * exponential(s), 1 - 0.05 * dueling(s))),
    "C18": ("C18", lambda s: TRUE["C18"](s) | (reward(s, 1.4) if s.gamma == 0.99 else {})),
    "C19": ("C19", lambda s: TRUE["C19"](s) | ({"tau": 5} if s.batch_size == 8 else {})),
    "C20 fluctuates": ("C20", lambda s: rates(s, {1e-3: 1.1, 1e-5: 0.4}, {1e-4: 100, 1e-5: 100}, {})),
    "C20 slower": ("C20", lambda s: rates(s, {1e-3: 1.1, 1e-4: 1.09, 1e-5: 0.4}, {1e-4: 5}, {1e-2: 0.3})),
    "C20 best": ("C20", lambda s: rates(s, {1e-2: 1.4, 1e-5: 0.4}, {1e-4: 100}, {1e-2: 0.3})),
}


def favourite_of_17(s):
    """The setting that C17 calls best, at one ratio: enough for its mean over ratios alone."""
    return dueling(s) and exponential(s) and episode(s) and s.ratio == (4, 1)


def finding_of(results, claim):
    return finding(next(one for one in CLAIMS if one.id == claim), Evidence(results))


@pytest.mark.parametrize("claim", TRUE)
def test_a_claim_that_is_true_holds(claim):
    found = finding_of(sweep(TRUE[claim]), claim)
    assert found.verdict == "holds", found.criteria
    assert found.decisive == found.criteria[0]


@pytest.mark.parametrize("case", FALSE)
def test_a_claim_of_which_one_part_is_false_does_not_hold(case):
    claim, levels = FALSE[case]
    found = finding_of(sweep(levels), claim)
    assert found.verdict == "does not hold", found.criteria
    assert found.decisive.verdict == "does not hold"


def test_every_claim_is_tried_both_ways():
    assert set(TRUE) == {claim.id for claim in CLAIMS} == {claim for claim, _ in FALSE.values()}


@pytest.mark.parametrize("claim", ["C1", "C4", "C9", "C12", "C13", "C15", "C17", "C18"])
def test_environments_that_disagree_decide_nothing(claim):
    """True in six environments, and its opposite in four by as much."""
    good, flat = sweep(TRUE[claim]), sweep()
    turned = [i for i, run in enumerate(good.planned) if run.environment in (1, 3, 6, 8)]
    for name, values in good.curves.items():
        values[turned] = 2 * flat.curves[name][turned] - values[turned]
    for name, values in good.greedy.items():
        values[turned] = 2 * flat.greedy[name][turned] - values[turned]
        if claim == "C1":
            values[turned] *= 0.7
    if claim == "C13":
        one = [i for i in turned if good.planned[i].setting.ratio == (4, 1)]
        good.curves["throughput_bps"][one] *= 0.8
    found = finding_of(good, claim)
    assert found.verdict == "undecided", found.criteria


once = functools.cache(realistic)


def decided_by(figure):
    """Claims that the runs of one figure decide."""
    full = once(SMOKE)
    wanted = set(runs(SMOKE, [figure]))
    kept = [i for i, run in enumerate(full.planned) if run in wanted]
    some = dataclasses.replace(
        full,
        planned=tuple(full.planned[i] for i in kept),
        curves={name: values[kept] for name, values in full.curves.items()},
        greedy={name: values[kept] for name, values in full.greedy.items()},
    )
    return {one.claim.id for one in check(some) if one.verdict != "not tested"}


def test_runs_that_were_not_made_leave_claims_untested():
    assert decided_by("lr") == {"C1", "C20"}, "C1 needs the setting that all learning rates are compared with"


@pytest.mark.parametrize(
    "scale", [pytest.param(FULL, id="full", marks=pytest.mark.long), pytest.param(SMOKE, id="smoke")]
)
def test_every_claim_can_be_tested(scale):
    results = once(scale)
    for one in check(results):
        assert one.verdict != "not tested"
        assert all(np.isfinite(criterion.effect).all() for criterion in one.criteria)
        assert any(
            text.count("\n") > 1 for table in one.claim.tables for text in tables_md(Evidence(results), table)
        )


def test_convergence_is_where_a_curve_gets_to_its_level_and_stays():
    episodes = np.arange(10, 210, 10)
    step = np.where(episodes > 100, 1.0, 0.0)
    # The average over five points is below 0.9 until the window holds no 0: two points after the step.
    assert settling(step[None], np.array([1.0]), episodes) == [130]
    relapse = step.copy()
    relapse[16] = 0.0
    assert settling(relapse[None], np.array([1.0]), episodes) == [200]
    never = np.zeros((1, 20))
    assert settling(never, np.array([0.0]), episodes) == [200], "does not rise"
    assert settling(never, np.array([1.0]), episodes) == [200], "does not get there"
    assert settling(1 - step[None], np.array([0.0]), episodes) == [200], "falls"


def test_the_reward_with_the_binary_r_plus_is_found_from_throughput_and_landing():
    results = sweep(lambda s: {"throughput_bps": 3e5, "landing_rate": 0.5})
    setting = Setting(beta=2, zeta=1)
    here = 1 + 0.02 * np.arange(10)
    rise = 0.2 + 0.8 * (1 - np.exp(-(results.episode[-8:] - results.episode[0]) / 40)).mean()
    expected = (2 * 3e-6 * 3e5 + 0.5) / 3 * here * rise
    np.testing.assert_allclose(Evidence(results).of("common_share", setting), expected, rtol=1e-5)


def test_as_a_mean_over_the_steps_it_counts_those_over_the_dock():
    results = of_the_data_of_the_step(
        sweep(lambda s: {"throughput_bps": 3e5, "landing_rate": 0.5, "arrival_step": 40.0})
    )
    found = Evidence(results)
    setting = Setting(beta=2, zeta=1)
    throughput, landed, arrival = (
        found.of(name, setting) for name in ("throughput_bps", "landing_rate", "arrival_step")
    )
    data_per_bps = results.metadata.worlds["five_clusters"].data_per_bps
    expected = (2 * data_per_bps * throughput + (60 - arrival + landed) / 60) / 3
    np.testing.assert_allclose(found.of("common_share", setting), expected, rtol=1e-6)


def test_the_rules_of_a_direction():
    assert greater("", np.array([1.0, 2, 3, 2, 1]), "").verdict == "holds"
    assert greater("", -np.array([1.0, 2, 3, 2, 1]), "").verdict == "does not hold"
    assert greater("", np.zeros(5), "").verdict == "does not hold", "a tie is not better"
    assert greater("", np.array([1.0, -2, 3, -2, 1]), "").verdict == "undecided"


def test_the_rules_of_an_equality():
    def relative(values):
        samples = np.array([values, np.ones(5)]).T
        return within("", samples, lambda means: means[:, 0] / means[:, 1] - 1).verdict

    assert relative([1.01, 0.99, 1.02, 0.98, 1.0]) == "holds"
    assert relative([1.2, 1.3, 1.2, 1.3, 1.2]) == "does not hold"
    assert relative([0.7, 0.8, 0.7, 0.8, 0.7]) == "does not hold"
    assert relative([1.2, 0.8, 1.2, 0.9, 1.0]) == "undecided"


def test_the_rules_of_everywhere():
    ratios = RATIOS[:3]
    up, mixed, down = np.ones(5), np.array([1.0, -1, 1, -1, 0.5]), -np.ones(5)

    def verdicts(*columns):
        effects = np.stack(columns, axis=1)
        return [everywhere("", effects, ratios, "", exceptions=n).verdict for n in (0, 1)]

    assert verdicts(up, up, up) == ["holds", "holds"]
    assert verdicts(up, up, mixed) == ["undecided", "holds"]
    assert verdicts(up, up, down) == ["does not hold", "holds"]
    assert verdicts(up, mixed, down) == ["does not hold", "undecided"]
    assert verdicts(up, down, down) == ["does not hold", "does not hold"]
    part = everywhere("", np.stack([up, 2 * up, down], axis=1), ratios, "")
    assert (part.effect.mean, part.detail) == (-1.0, "as claimed at 2 of 3 ratios, not at 1:2")


def test_the_effect_shown_of_everywhere_agrees_with_its_verdict():
    """The worst mean may belong to a ratio that is undecided: it is not what decided."""
    effects = np.array([[-2, -0.3, 1], [1, -0.2, 1], [-1.5, -0.25, 1], [1, -0.3, 1], [-1, -0.3, 1]])
    part = everywhere("", effects, RATIOS[:3], "")
    assert part.verdict == "does not hold"
    assert part.effect.mean == pytest.approx(effects[:, 1].mean())
    assert part.effect.high < 0


@pytest.mark.parametrize("figure", FIGURES)
def test_a_figure_s_own_runs_decide_its_claims(figure):
    assert set(FIGURES[figure].claims) <= decided_by(figure)


def test_the_worst_ratio_is_shown_of_an_equality():
    samples = np.ones((5, 3)) * [1.0, 1.0, 2.5]
    part = all_within("", samples, RATIOS[:3])
    assert part.verdict == "does not hold"
    assert part.effect.mean == pytest.approx(100 * (2.5 / 1.5 - 1))


def test_the_best_of_the_others_is_found_anew_in_every_resample():
    """Two rivals, good in different environments: a resample has a best of them, above both their means."""
    options = np.array([[1.0, 2.0, 0.0], [1.0, 0.0, 2.0], [1.0, 2.0, 0.0], [1.0, 0.0, 2.0]])
    effect = lead(options, [0])
    assert effect.mean == 0.0
    assert effect.low == 0.0, "the means of the resamples show how much the best of two is flattered"
    assert effect.high > 1.0


def test_a_fall_is_a_slope_turned_round():
    np.testing.assert_allclose(fall(np.array([[4.0, 3.0, 2.0], [1.0, 1.0, 1.0]])), [1.0, 0.0], atol=1e-12)


def test_one_criterion_that_fails_decides():
    def of(*verdicts):
        return joint([Criterion("", Interval(0, 0, 0), "", "", verdict) for verdict in verdicts])

    assert of("holds", "holds") == "holds"
    assert of("holds", "undecided") == "undecided"
    assert of("undecided", "does not hold", "holds") == "does not hold"


def test_the_rules_name_the_numbers_they_use():
    assert RULES.count("20%") == 1
    assert "±5%" in RULES
    assert "over 5 points" in RULES
    assert SHORT.repeats == FULL.repeats
