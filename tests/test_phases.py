"""The phases of a mission: the table is whole, flights keep to it, and nothing else is ever published."""

import itertools

import pytest

from tests.support import flights
from tests.support.fake_autopilot.simulated import ARMING, Flight, fly_to_step
from tests.support.worlds import tiny
from uav_dc_ros.errors import PhaseError
from uav_dc_ros.messages import Phase
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.phases import OFFBOARD, RESTART, TRANSITIONS, PhaseTransition, next_phases, transition_error

OVER = {phase for phase in Phase if phase.is_over}


def test_every_transition_is_there_once_with_its_reason() -> None:
    assert len({edge[:3] for edge in TRANSITIONS}) == len(TRANSITIONS)
    assert all(
        isinstance(edge, PhaseTransition) and edge.reason and edge.steps in (0, 1) for edge in TRANSITIONS
    )
    assert {edge.before for edge in TRANSITIONS} == set(Phase) - OVER, "and nothing follows an end"
    assert {edge.after for edge in TRANSITIONS} == set(Phase) - {Phase.IDLE}


def test_a_mission_can_be_given_up_in_any_phase() -> None:
    """Else the bridge would find no way out where its phases went wrong, or a pilot took over."""
    assert all(Phase.ABORTED in next_phases(phase) for phase in set(Phase) - OVER)
    assert all(Phase.LANDING in next_phases(phase) for phase in OFFBOARD)


def test_another_bridge_may_begin_after_any_phase() -> None:
    for phase in Phase:
        assert all(set(RESTART) <= set(next_phases(phase, steps, restarts=True)) for steps in (0, 1))
    assert transition_error(Phase.READY, Phase.CONNECTING, 0) is not None, "but not the same one"


@pytest.mark.parametrize("fault", flights.FAULTS)
def test_flights_keep_to_the_table(fault: str) -> None:
    told = flights.phases(flights.Flight(tiny(), beat=flights.FAULTS[fault][0]).fly())
    for (step, phase, _), (next_step, next_phase, _) in itertools.pairwise(told):
        if (step, phase) != (next_step, next_phase):
            assert next_phase in next_phases(phase, next_step - step, restarts=fault == "restart")


def test_what_cannot_follow_is_an_error_in_tests() -> None:
    flight = fly_to_step(3)
    with pytest.raises(PhaseError, match="preflight after moving, with 0 more steps flown; expected landing"):
        flight.bridge._enter(Phase.PREFLIGHT, "")


@pytest.mark.parametrize("wrong", [Phase.IDLE, Phase.TAKEOFF, Phase.LANDED, Phase.TIMEOUT])
@pytest.mark.parametrize("more_steps", [0, 1, 7])
def test_in_the_air_it_is_the_end_of_the_mission(
    monkeypatch: pytest.MonkeyPatch, wrong: Phase, more_steps: int
) -> None:
    monkeypatch.setattr(MissionController, "is_strict", False)
    flight = fly_to_step(3)
    flight.bridge.progress.step += more_steps
    flight._step += more_steps
    before = len(flight.log)
    (flight.bridge._end if wrong.is_over else flight.bridge._enter)(wrong, "wrong")
    assert flight.bridge.setpoint is not None, "it is held until it obeys"
    flight.until(Phase.ABORTED)
    assert [phase for phase, *_ in flight.log[before:]][:1] == [Phase.LANDING], "nothing else was published"
    assert flight.bridge.reason.startswith(
        f"an error of the bridge: {wrong} after moving, with {more_steps} "
    )
    flight.bridge._enter(Phase.READY, "wrong")
    assert flight.bridge.phase is Phase.ABORTED, "what is over stays so"


def test_on_the_ground_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MissionController, "is_strict", False)
    bridge = Flight(ARMING).bridge
    bridge._enter(Phase.READY, "wrong")
    assert (bridge.phase, bridge.setpoint) == (Phase.ABORTED, None)
    assert bridge.reason.startswith("an error of the bridge: ready after idle")
