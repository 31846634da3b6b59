"""What run_all sees of a mission whose end is heard before its rates: a stranger tells it in that order."""

import json
import time
from pathlib import Path

import pytest

from tests.conftest import Ros, finish
from uav_dc_ros import messages, scenarios
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase

STEPS = 3
MBIT = 1e6


def mission(scenario: Scenario, step: int) -> messages.Mission:
    """The vehicle's word for a step of a mission that goes east, and is aborted after a few."""
    return messages.Mission(
        mission=0,
        step=step,
        phase=Phase.READY if step < STEPS else Phase.ABORTED,
        cell=(min(step, 2), 0, 0),
        remaining_steps=scenario.mission.max_steps - step,
        seed=0,
        scenario=scenario.name,
        fingerprint=scenario.fingerprint,
    )


def rates(scenario: Scenario, step: int) -> messages.Rates:
    """A megabit of the first user in each step."""
    nothing = [0.0] * scenario.n_users
    return messages.Rates(
        mission=0,
        step=step,
        sum_rate_bps=MBIT if step else 0.0,
        sinr=nothing,
        rate_bps=nothing,
        data_bits=[step * MBIT, *nothing[1:]],
        served=[False] * scenario.n_users,
        collected=[False] * scenario.n_users,
    )


@pytest.mark.parametrize("heard", [STEPS + 1, *(pytest.param(n, marks=pytest.mark.long) for n in (2, 0))])
def test_the_end_is_heard_before_the_rates(
    ros: Ros, small_scenario: Path, small_policy: Path, heard: int
) -> None:
    """An observer hears topic by topic, and a lockstep may fly a mission before it looks again."""
    scenario = scenarios.load(small_scenario)
    options = ("--scenario", small_scenario, "--policy", small_policy, "--pace", "lockstep")
    run = ros.start(
        "uav_dc_ros.run_all", *options, "--nodes", "policy", "--no-record", "--summary", "summary.json"
    )
    stranger = ros.stranger("probe")
    assert stranger.stdin is not None

    def say(topic: str, payload: messages.Payload) -> None:
        command = {"topic": topic, "hearing": 2, "data": messages.encode(payload).decode()}
        assert stranger.stdin is not None
        stranger.stdin.write(json.dumps(command) + "\n")
        stranger.stdin.flush()

    for step in range(STEPS + 1):
        say("mission", mission(scenario, step))
    time.sleep(0.5)  # of which run_all takes a few looks
    for step in range(heard):
        say("rates", rates(scenario, step))
    status, output = finish(run)
    stranger.stdin.close()
    stranger.wait(10)
    assert "Traceback" not in output
    assert status == 1, output  # it was aborted
    told = json.loads((ros.folder / "summary.json").read_text())
    last = max(heard - 1, 0)
    assert (told["outcome"], told["steps"], told["data_bits"]) == ("aborted", last, last * MBIT)
    assert told["distance_m"] == 100.0 * min(last, 2)
