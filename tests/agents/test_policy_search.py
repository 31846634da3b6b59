"""Search on top of a policy: what it knows, what it promises, and what it does when time runs out."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.recordings.made import about, bag_message, flight, write
from tests.support.worlds import config, tiny
from uav_dc_ros import bag as bag_command
from uav_dc_ros import cdr, messages, scenarios
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.agents import network, set_network
from uav_dc_ros.agents.agent import greedy_act
from uav_dc_ros.agents.policy import Policy
from uav_dc_ros.agents.policy_search import PolicySearch, SearchedMove
from uav_dc_ros.agents.set_policy import PqnSettings, SetPolicyConfig
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.world import State, rollout_steps
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.experiments.evaluate.cli import candidates, main
from uav_dc_ros.experiments.evaluate.rollout import roll_out
from uav_dc_ros.run_config import RunConfig
from uav_dc_ros.runner import run_options

WEIGHT = 0.8
STATIC = {"mobility": {"model": "static"}, "v_max_mps": None}


def random_policy(scenario, observation="mission", seed=1):
    """A policy with random parameters."""
    rng = np.random.default_rng(seed)
    if observation == "entities":
        values = msgspec.to_builtins(scenario)
        made = SetPolicyConfig(
            name="any", width=8, hidden=(8,), hyperparameters=PqnSettings(), seed=0, iteration=0,
            version="test", scenario=values,
        )  # fmt: skip
        parameters = set_network.initial(made.architecture(scenario), rng)
    else:
        made = config(scenario, observation=observation)
        parameters = network.initial(made.architecture(scenario), rng)
    return Policy(folder=None, config=made, scenario=scenario, parameters=parameters, sha256="ab" * 32)


def one(state, i=0):
    """One mission of a batch, without what no node knows."""
    alone = {name: getattr(state, name)[i] for name in State.__dataclass_fields__}
    unknown = np.asarray(np.nan)
    return replace(State(**alone), total_reward=unknown, mission_reward=unknown)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    observation=st.sampled_from(["position", "mission", "entities"]),
    seed=st.integers(0, 9),
    weight=st.sampled_from([0.0, 0.5, 10 / 11, 1.0]),
    max_steps=st.integers(5, 12),
    interference=st.sampled_from(["all", "associated", "none"]),
    ends=st.sampled_from(["at_time_limit", "on_arrival"]),
)
def test_where_the_model_is_right_it_is_never_worse_than_the_policy(
    observation, seed, weight, max_steps, interference, ends
):
    """Users stay, the channel draws nothing, and a beam of 24 missions is wide in so small a field."""
    scenario = tiny(
        mission={"max_steps": max_steps, "episode_end": ends, "r_min_bits": 2e6},
        radio={"interference": interference},
        users=STATIC,
    )
    policy = random_policy(scenario, observation, seed)
    own = roll_out(scenario, greedy_act(policy, scenario, weight), range(2), service=False)
    search = PolicySearch(policy, scenario, weight, 25)
    found = roll_out(scenario, search, range(2), service=False)
    assert found.landed.all()
    assert (found.objective(scenario, weight) >= own.objective(scenario, weight)).all()


@settings(derandomize=True, deadline=None, max_examples=16)
@given(
    observation=st.sampled_from(["position", "energy", "entities"]),
    n=st.sampled_from([1, 3, 24]),
    max_steps=st.integers(4, 12),
    ends=st.sampled_from(["battery", "both"]),
    battery=st.sampled_from([18e3, 30e3]),
)
def test_it_lands_however_little_time_or_charge_there_is(observation, n, max_steps, ends, battery):
    scenario = tiny(
        mission={"max_steps": max_steps + 100 * (ends == "battery")},
        energy={"battery_j": battery, "ends": ends},
    )
    policy = random_policy(scenario, observation)
    assert roll_out(scenario, PolicySearch(policy, scenario, WEIGHT, n), range(2), service=False).landed.all()


def test_a_late_mission_flies_home():
    """After moves that a real vehicle did not fly, no way lands: the shortest one is flown, as without N."""
    scenario = tiny()
    search = PolicySearch(random_policy(scenario), scenario, WEIGHT, 12)
    state = next(rollout_steps(scenario, search, [0]))[0]
    late = replace(one(state), step=np.asarray(scenario.mission.max_steps - 2))
    assert ACTION_LABELS[search.decide(late).action] in ("right", "forward")
    over = replace(late, step=np.asarray(scenario.mission.max_steps))
    assert search.decide(over) == SearchedMove(search.own(over))


def test_it_improves_a_trained_policy_and_decides_by_the_state_alone():
    scenario = scenarios.load("three_clusters_hover")
    agent = agents.load("three_clusters_hover_dueling", search=8)
    assert (agent.knows_positions, agent.weighs, agent.name) == (True, True, "three_clusters_hover_dueling")
    search, decided = agent.act_in(scenario, WEIGHT), []

    def act(state):
        actions = search(state)
        decided.extend((one(state, i), actions[i]) for i in range(2))
        return actions

    found = roll_out(scenario, act, range(2), service=False)
    own = roll_out(scenario, greedy_act(agent.policy, scenario), range(2), service=False)
    assert (found.objective(scenario, WEIGHT) > own.objective(scenario, WEIGHT)).all()
    again = agent.act_in(scenario, WEIGHT)  # a node that was restarted
    for state, action in decided[::13]:
        assert again.decide(replace(state, motion=state.motion * np.nan)).action == action


def test_without_time_it_takes_the_policy_s_own_action_and_reports_it():
    scenario = scenarios.load("five_clusters_hover")
    agent = agents.load("five_clusters_hover_dueling", search=8)
    search, greedy = agent.act_in(scenario), greedy_act(agent.policy, scenario)
    differs = 0
    for state, _ in list(rollout_steps(scenario, greedy, [3]))[:-1:7]:
        out_of_time = search.decide(one(state), time_limit_s=0.0)
        assert out_of_time == SearchedMove(int(greedy(state)[0]), timed_out=True)
        in_time = search.decide(one(state), time_limit_s=60.0)
        assert in_time == search.decide(one(state)) != out_of_time
        differs += in_time.action != out_of_time.action
    assert differs


def test_verify_recomputes_searches_and_reports_those_out_of_time(tmp_path, capsys):
    name, scenario = "three_clusters_hover_dueling", scenarios.load("three_clusters_hover")
    agent = agents.load(name, search=8)
    search, moves, own = agent.act_in(scenario, WEIGHT), [], []

    def act(state):
        own.append(search.own(one(state)))
        moves.append(own[-1] if len(moves) in (4, 5) else int(search(state)[0]))
        return np.asarray(moves[-1:])

    list(rollout_steps(scenario, act, [0]))
    values = {"policy": name, "policy_sha256": agent.sha256, "objective_weight": repr(WEIGHT)}

    def verify(folder, timed_out, n):
        recorded = flight(scenario, act=lambda mission, step: moves[step])
        for i, message in enumerate(recorded):
            if message.topic == "/move":
                move = messages.decode(cdr.decode_string(message.data), messages.Move)
                if move.step in timed_out:
                    move = msgspec.structs.replace(move, search_timed_out=True)
                    recorded[i] = message._replace(data=bag_message("move", move, 0).data)
        path = write(tmp_path / folder, recorded, about(scenario, **values, search=n))
        with pytest.raises(SystemExit) as end:
            bag_command.main(["verify", str(path), "--complete"])
        return end.value.code, "".join(capsys.readouterr())

    status, text = verify("clean", (4, 5), "8")
    assert status == 0, text
    assert "search 8, w = 0.8)" in text
    assert "2 searches ran out of time: their moves are the policy's own" in text
    searched = next(step for step, move in enumerate(moves) if move != own[step])
    status, text = verify("false", (4, 5, searched), "8")
    assert (status, f"move: mission 0, step {searched}, action: recorded" in text) == (1, True)
    status, text = verify("bad", (), "many")
    assert (status, "search 'many'; expected a whole number from 0 to 1024" in text) == (2, True)


def test_evaluate_flies_each_policy_with_each_search(capsys):
    names = ["three_clusters_dueling", "search"]
    assert [(one.name, one.search) for one in candidates(names, [0, 8])] == [
        ("three_clusters_dueling", 0),
        ("three_clusters_dueling, search 8", 8),
        ("search", 0),
    ]
    for more, error in (
        (["tour", "--search", "8"], "--search 8: tour: planners only; expected a policy in --policy"),
        (["tour", "--search", "-1"], "argument --search: '-1'; expected a whole number from 0 to 1024"),
        (["tour", "--search", "1025"], "argument --search: '1025'; expected a whole number from 0 to 1024"),
        ([names[0], "--search", "8", "8"], "--search 8 is given 2 times; expected once"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["--scenario", "three_clusters", "--policy", *more])
        assert end.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.endswith(error)


def test_a_search_that_cannot_be_is_refused():
    with pytest.raises(ParameterError, match="search 8: 'search' is a planner; expected it with a policy"):
        agents.load("search", search=8)
    scenario = scenarios.load("five_clusters")

    def limit_s(**values):
        return run_options.search_time_limit_s(RunConfig(**values), scenario)

    assert limit_s() == limit_s(search=8, pace="lockstep") == 0.0
    assert limit_s(search=8, pace=10) == scenario.mission.step_s / 20
    assert limit_s(search=8, vehicle="mavros") == scenario.mission.step_s / 2
    assert limit_s(search=8, search_time_limit=0.25) == 0.25
    with pytest.raises(ParameterError, match=r"--search-time-limit 0\.2: expected --search with it"):
        limit_s(search_time_limit=0.2)
    with pytest.raises(ParameterError, match=r"limit 0\.2: expected a --pace in real time: a lockstep waits"):
        limit_s(search=8, search_time_limit=0.2, pace="lockstep")
    for values in ({"search": -1}, {"search": 1025}, {"search": True}, {"search_time_limit": 0.0}):
        with pytest.raises(ParameterError, match=f"{next(iter(values))}: .*; expected a"):
            RunConfig(**values)
