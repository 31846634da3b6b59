"""The missions of a bag: how each ended, and which messages of its steps are missing."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.errors import BagDamagedError, BagError, UavDcError
from uav_dc_ros.recordings.mission_totals import MissionTotals
from uav_dc_ros.recordings.recorded_step import RecordedStep, mission_name
from uav_dc_ros.recordings.step_reader import STEP_TOPICS, Steps, scenario


@dataclass(kw_only=True)
class MissionSurvey(MissionTotals):
    """A mission. Before its end, `reason` is that of the latest phase report.

    Attributes:
        namespace: its namespace, without a slash at the end.
        flight, mission: counts runs in the bag from 0; index of the mission in its flight.
        missing: messages of its steps that the bag lacks, by topic.
    """

    namespace: str
    flight: int
    mission: int
    missing: Counter[str] = field(default_factory=Counter)


def survey_missions(reader: BagReader, namespace: str, problems: list[str]) -> list[MissionSurvey]:
    """The missions of a namespace; adds what cannot be read to `problems`."""
    where = f" in {namespace}" if namespace else ""
    found: list[MissionSurvey] = []
    try:
        try:
            step_ns = scenario(reader, namespace).step_ns
        except UavDcError:
            step_ns = 2**63  # unknown scenario, in a bag of another recorder
        steps = Steps(reader, namespace, step_ns)
        before: RecordedStep | None = None
        for step in steps:
            if before is None or (before.flight, before.mission) != (step.flight, step.mission):
                found.append(MissionSurvey(namespace=namespace, flight=step.flight, mission=step.mission))
                next_step = 0
            else:
                next_step = before.step + 1
                found[-1].missing.update(_missing(before, last=False))
            mission = found[-1]
            if step.step > next_step:
                mission.missing.update(dict.fromkeys(STEP_TOPICS, step.step - next_step))
            mission.add(step.step, step.status, step.rates)
            if step.status is not None and not mission.is_over:
                mission.reason = step.phase_reports[-1].reason if step.phase_reports else ""
            before = step
            if step.status is not None and step.status.phase.is_over:
                mission.missing.update(_missing(step, last=True))
    except BagDamagedError:
        raise
    except BagError as error:
        problems.append(str(error))
        return found
    problems += (f"{line}{where}" for line in steps.rejected.lines())
    return found


def _missing(step: RecordedStep, *, last: bool) -> list[str]:
    """Topics without a message of this step. The last step has no move."""
    has = {
        "pose": step.position_m is not None or not step.is_measured,
        "users": step.users is not None or not step.is_measured,
        "rates": step.rates is not None or not step.is_measured,
        "mission": step.status is not None,
        "move": step.move is not None or last,
    }
    return [topic for topic, recorded in has.items() if not recorded]


def mission_problems(reader: BagReader, missions: list[MissionSurvey]) -> Iterator[str]:
    """What the missions lack, a line each."""
    for namespace in dict.fromkeys(mission.namespace for mission in missions):
        where = f" in {namespace}" if namespace else ""
        flown = [mission for mission in missions if mission.namespace == namespace]
        missing: Counter[str] = Counter()
        for mission in flown:
            missing.update(mission.missing)
        if missing:
            yield f"steps{where} lack messages: {', '.join(f'{n:,} {topic}' for topic, n in missing.items())}"
        for mission in flown:
            if not mission.is_over:
                name = mission_name(mission.mission, mission.flight)
                yield f"{name}{where} has no end; its last step is {mission.steps}"
        wanted = reader.about.get("missions", "")
        n_over = len({mission.mission for mission in flown if mission.is_over})
        if wanted.isdecimal() and n_over < int(wanted):
            yield f"{n_over:,} of {int(wanted):,} missions{where} have an end"
