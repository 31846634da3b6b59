"""The missions of a bag: how each ended, and what the bag lacks of its steps."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.errors import BagDamagedError, BagError, UavDcError
from uav_dc_ros.recordings.mission_totals import MissionTotals
from uav_dc_ros.recordings.recorded_step import RecordedStep
from uav_dc_ros.recordings.step_reader import STEP_TOPICS, Steps, scenario


@dataclass(kw_only=True)
class MissionSurvey(MissionTotals):
    """A mission: of one that is not over, `reason` tells why it is as it is.

    Attributes:
        namespace: where it was flown, without a slash at its end.
        flight: counts runs in one bag from 0.
        mission: its index in its flight.
        missing: messages of its steps that the bag lacks, by topic.
    """

    namespace: str
    flight: int
    mission: int
    missing: dict[str, int] = field(default_factory=dict)


def look_through(reader: BagReader, namespace: str, problems: list[str]) -> list[MissionSurvey]:
    """The missions of a namespace, and what is missing of their steps."""
    where = f" in {namespace}" if namespace else ""
    found: list[MissionSurvey] = []
    try:
        try:
            step_ns = scenario(reader, namespace).step_ns
        except UavDcError:
            step_ns = 2**63  # the scenario is not known: the bag of another one
        steps = Steps(reader, namespace, step_ns)
        before: RecordedStep | None = None
        for step in steps:
            if before is None or (before.flight, before.mission) != (step.flight, step.mission):
                found.append(MissionSurvey(namespace=namespace, flight=step.flight, mission=step.mission))
                next_step = 0
            else:
                next_step = before.step + 1
                _enter_missing(found[-1], before, last=False)
            if step.step > next_step:
                _lack(found[-1], dict.fromkeys(STEP_TOPICS, step.step - next_step))
            found[-1].add(step.step, step.status, step.rates)
            if step.status is not None and not found[-1].is_over:
                found[-1].reason = step.told[-1].reason if step.told else ""
            before = step
            if step.status is not None and step.status.phase.is_over:
                _enter_missing(found[-1], step, last=True)
    except BagDamagedError:
        raise
    except BagError as error:
        problems.append(str(error))
        return found
    problems += (f"{line}{where}" for line in steps.rejected.lines())
    return found


def _enter_missing(mission: MissionSurvey, step: RecordedStep, *, last: bool) -> None:
    """Enter what a step lacks. The last one has no move, and one that is not over may be without the rest.

    A real vehicle that has not come to a step yet is not measured.
    """
    waits = not step.is_measured
    has = {
        "pose": step.position_m is not None or waits,
        "users": step.users is not None or waits,
        "rates": step.rates is not None or waits,
        "mission": step.status is not None,
        "move": step.move is not None or last,
    }
    _lack(mission, {topic: 1 for topic, there in has.items() if not there})


def _lack(mission: MissionSurvey, missing: dict[str, int]) -> None:
    for topic, n in missing.items():
        mission.missing[topic] = mission.missing.get(topic, 0) + n


def mission_problems(reader: BagReader, missions: list[MissionSurvey]) -> Iterator[str]:
    """What the missions lack, a line each."""
    for namespace in dict.fromkeys(mission.namespace for mission in missions):
        where = f" in {namespace}" if namespace else ""
        flown = [mission for mission in missions if mission.namespace == namespace]
        missing: Counter[str] = Counter()
        for mission in flown:
            missing.update(mission.missing)
        if missing:
            told = ", ".join(f"{n:,} {topic}" for topic, n in missing.items())
            yield f"steps{where} lack messages: {told}"
        for mission in flown:
            if not mission.is_over:
                flight = f" of flight {mission.flight}" if mission.flight else ""
                yield f"mission {mission.mission}{flight}{where} is not over at its step {mission.steps}"
        wanted = reader.about.get("missions", "")
        n_flown = len({mission.mission for mission in flown if mission.is_over})
        if wanted.isdecimal() and n_flown < int(wanted):
            yield f"{n_flown:,} of {int(wanted):,} missions{where} are there to their end"
