"""Age of information, fairness and the last user: by hand, and alike wherever they are computed."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.recordings.made import flight
from tests.support.worlds import tiny
from uav_dc_ros import cdr, messages, scenarios
from uav_dc_ros.core.scenario import from_values
from uav_dc_ros.core.users.service import FIGURES, ServiceRecord, jain_index
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.env.vector_env import DataCollectionVectorEnv
from uav_dc_ros.experiments.evaluate.evaluation import evaluate_act
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.planners import PLANNERS
from uav_dc_ros.recordings.recorded_step import MissionTotals


def by_hand(scenario, served, collected, data_bits):
    """The definitions, user by user and step by step."""
    priorities = scenario.users.weights or [1 / scenario.n_users] * scenario.n_users
    age_s = 0.0
    for user, share in enumerate(priorities):
        last, ages = 0, []
        for step in range(1, len(served) + 1):
            last = step if served[step - 1][user] else last
            ages.append((step - last) * scenario.mission.step_s)
        age_s += share * sum(ages) / len(ages)
    volumes = scenario.user_r_min_bits(np.zeros(1))
    x = [d / v for d, v in zip(data_bits, np.broadcast_to(volumes, len(data_bits)), strict=True)]
    squares = sum(one * one for one in x)
    fairness = sum(x) ** 2 / (len(x) * squares) if squares else math.nan
    firsts = [list(column).index(True) + 1 for column in zip(*collected, strict=True) if any(column)]
    return {"mean_age_s": age_s, "fairness": fairness, "last_collected_step": max(firsts, default=math.nan)}


def field(**user):
    """Four users in the tiny field, of which the last is another one."""
    users = [{"x_m": 100.0 * i, "y_m": 50.0} for i in range(3)] + [{"x_m": 150.0, "y_m": 150.0} | user]
    values = msgspec.to_builtins(tiny())
    return from_values(values | {"users": {"user": users, "mobility": {"model": "static"}}}, "test")


@settings(derandomize=True, deadline=None, max_examples=60)
@given(
    served=arrays(bool, (6, 4)),
    collects=arrays(np.int64, 4, elements=st.integers(0, 9)),
    data=arrays(np.float64, 4, elements=st.floats(0.0, 1e8)),
    priority=st.sampled_from([1.0, 5.0]),
)
def test_the_figures_are_their_definitions(served, collects, data, priority, array):
    scenario = field(priority=priority, data_bits=2e6)
    collected = np.arange(1, 7)[:, None] >= np.where(collects == 0, 99, collects)
    record = ServiceRecord(array(np.zeros(4)))
    for step in range(6):
        record.add(array(np.asarray(step + 1)), array(served[step]), array(collected[step]))
    found = record.figures(scenario, array(data))
    expected = by_hand(scenario, served, collected, data)
    assert set(found) == set(expected) == set(FIGURES)
    for name, value in expected.items():
        np.testing.assert_allclose(np.asarray(found[name]), value, rtol=1e-12, err_msg=name)


def test_the_index_of_jain(array):
    """The examples of the report: k of n users with equal shares have k / n; a common factor is nothing."""
    shares = np.array([[1.0] * 10, [1.0] * 3 + [0.0] * 7, [5.0] + [0.0] * 9, [0.0] * 10])
    np.testing.assert_allclose(np.asarray(jain_index(array(shares))), [1.0, 0.3, 0.1, np.nan])
    other = np.random.default_rng(1).uniform(0, 1, (5, 10))
    np.testing.assert_allclose(np.asarray(jain_index(array(1e9 * other))), jain_index(other), rtol=1e-12)


def test_without_service_the_age_is_the_time():
    record = ServiceRecord(np.zeros(4))
    assert all(np.isnan(value) for value in record.figures(field(), np.zeros(4)).values())
    for step in range(1, 9):
        record.add(np.asarray(step), np.zeros(4, bool), np.zeros(4, bool))
    found = record.figures(field(), np.zeros(4))
    assert found["mean_age_s"] == 15.0 * 4.5
    assert np.isnan(found["fairness"])
    assert np.isnan(found["last_collected_step"])


def test_environments_rollouts_bags_and_evaluations_agree_to_the_last_bit():
    """Seeds 0 to 4, actions of a plan; missions of the vector environment end and restart at other times."""
    scenario = tiny(mission={"episode_end": "on_arrival", "r_min_bits": 3e6, "max_steps": 9})
    plans = [[1, 1, 2, 2], [6] * 9, [2, 2, 1, 1], [1, 6, 1, 6, 2, 6, 2], [2, 6, 6, 1, 1, 2]]

    def act(mission, step):
        return plans[mission][step]

    single = []
    for seed, plan in enumerate(plans):
        env = DataCollectionEnv(scenario)
        _, info = env.reset(seed=seed)
        assert "mean_age_s" not in info
        history, over, step = [], False, 0
        while not over:
            _, _, terminated, truncated, info = env.step(np.int64(plan[step]))
            step, over = step + 1, terminated or truncated
            assert ("mean_age_s" in info) == over
            history.append((info["served"], info["collected"]))
        served, collected = zip(*history, strict=True)
        expected = by_hand(scenario, served, collected, info["data_bits"])
        for name in FIGURES:
            np.testing.assert_allclose(info[name], expected[name], rtol=1e-12)
        single.append({name: float(info[name]) for name in FIGURES})
    assert len({tuple(one.values()) for one in single}) > 2

    padded = np.array([plan + [6] * (9 - len(plan)) for plan in plans]).T

    def by_plan(state):
        return padded[np.minimum(state.step, 8), np.arange(5)]

    missions = roll_out(scenario, by_plan, range(5))
    evaluated = evaluate_act("plan", None, by_plan, scenario, range(5))
    for name in FIGURES:
        np.testing.assert_array_equal(getattr(missions, name), [one[name] for one in single])
        np.testing.assert_array_equal(evaluated.values[name], [one[name] for one in single])
    assert roll_out(scenario, by_plan, range(5), service=False).fairness is None

    envs = DataCollectionVectorEnv(5, scenario)
    _, infos = envs.reset(seed=0)
    left = [list(plan) for plan in plans]
    ended, again = {}, 0
    for _ in range(25):
        _, _, terminated, truncated, infos = envs.step(
            np.array([plan.pop(0) if plan else 6 for plan in left])
        )
        over = terminated | truncated
        assert ("fairness" in infos) == over.any()
        for i in np.flatnonzero(over):
            np.testing.assert_array_equal(infos["_fairness"], over)
            again += i in ended
            ended.setdefault(i, {name: float(infos[name][i]) for name in FIGURES})
    assert again >= 3, "the figures of a second mission do not disturb"
    for i, one in enumerate(single):
        np.testing.assert_equal(ended[i], one)

    recorded = {}
    for message in flight(scenario, act=act, missions=5):
        if message.topic == "/rates":
            rates = messages.decode(cdr.decode_string(message.data), messages.Rates)
            totals = recorded.setdefault(rates.mission, MissionTotals())
            totals.add(rates.step, None, rates)
    for i, one in enumerate(single):
        known = {name: None if np.isnan(value) else value for name, value in one.items()}
        assert recorded[i].service_figures(scenario) == known
    assert MissionTotals().service_figures(scenario) == dict.fromkeys(FIGURES)


def test_a_second_mission_of_the_vector_environment_starts_anew():
    scenario = tiny(mission={"r_min_bits": 3e6, "max_steps": 4})
    envs, env = DataCollectionVectorEnv(2, scenario), DataCollectionEnv(scenario)
    envs.reset(seed=[3, 4])
    env.reset(seed=3)
    found, expected = [], []
    for _ in range(9):
        *_, infos = envs.step(np.array([1, 6]))
        found += [{name: float(infos[name][0]) for name in FIGURES}] if "fairness" in infos else []
    for _ in range(2):
        for _ in range(4):
            *_, info = env.step(np.int64(1))
        expected.append({name: float(info[name]) for name in FIGURES})
        env.reset()
    np.testing.assert_equal(found, expected)


@pytest.mark.parametrize("planner", ["nearest", "tour"])
def test_plausible_figures_of_the_shipped_field(planner):
    """A tour that collects nearly all is fair, and its last user comes late."""
    scenario = scenarios.load("three_clusters_hover")
    missions = roll_out(scenario, PLANNERS[planner](scenario), range(5))
    assert ((missions.fairness > 0.9) & (missions.fairness <= 1.0)).all()
    assert (missions.last_collected_step <= missions.steps).all()
    half_s = 15.0 * (scenario.mission.max_steps + 1) / 2
    assert (missions.mean_age_s > 0.2 * half_s).all()
    assert (missions.mean_age_s < half_s).all()
