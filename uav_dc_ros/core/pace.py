"""The pace of a mission: lockstep, or a multiple of real time."""

from typing import TYPE_CHECKING

from uav_dc_ros.errors import ParameterError

if TYPE_CHECKING:  # a command line parses its pace before anything heavy is imported
    from uav_dc_ros.core.scenario import Scenario

LOCKSTEP = "lockstep"
WATCHABLE = 90.0  # a mission of sixty steps of 15 s takes ten seconds
PACE_MAX = 1e6
TIME_MAX_S = 2.0**31  # the seconds of a ROS time are a signed 32-bit integer
PERIOD_MIN_S = 0.005  # of a step at a pace; a step in lockstep takes a millisecond or two


def parse(text: str) -> float | None:
    """The factor of real time, or None for lockstep; raises ParameterError for any other text."""
    if text == LOCKSTEP:
        return None
    try:
        pace = 0.0 if "_" in text else float(text)  # Python's own notation
    except ValueError:
        pace = 0.0
    if not 0.0 < pace <= PACE_MAX:
        raise ParameterError(f"{text!r}; expected '{LOCKSTEP}' or a number above 0, at most {PACE_MAX:g}")
    return pace


def text(pace: float | None) -> str:
    """The text that `parse` reads as `pace`."""
    return LOCKSTEP if pace is None else repr(pace)


def period_s(scenario: "Scenario", pace: float | None) -> float:
    """Minimum duration of a step in the nodes, seconds; 0 in lockstep."""
    return 0.0 if pace is None else scenario.mission.step_s / pace


def check(scenario: "Scenario", pace: float | None, missions: int) -> None:
    """Raise ParameterError for steps too short for the nodes, or a time that ROS cannot represent."""
    if pace is not None and period_s(scenario, pace) < PERIOD_MIN_S:
        raise ParameterError(
            f"pace: {pace:g}; expected at most {scenario.mission.step_s / PERIOD_MIN_S:g}, which makes steps "
            f"of {PERIOD_MIN_S * 1e3:g} ms, or '{LOCKSTEP}', which is as fast as the nodes can"
        )
    seconds = missions * (scenario.mission.max_steps + 1) * scenario.mission.step_s
    if seconds >= TIME_MAX_S:
        raise ParameterError(
            f"missions: {missions} of {scenario.mission.max_steps} steps of {scenario.mission.step_s:g} s "
            f"are {seconds:g} s; expected less than the {TIME_MAX_S:g} s that a ROS time holds"
        )
