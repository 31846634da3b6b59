"""Verify a bag: recompute its missions, and compare to the last bit."""

import argparse
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec

from uav_dc_ros import __version__, cli, files
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.agents.agent import Agent
from uav_dc_ros.agents.policy import CONFIG
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core import pace
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.objective import DEFAULT_WEIGHT, check_weight
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagError, ParameterError, PolicyError, UavDcError
from uav_dc_ros.messages import printable
from uav_dc_ros.planners import PLANNERS
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.recorded_step import RecordedStep, mission_name
from uav_dc_ros.recordings.step_reader import Steps
from uav_dc_ros.recordings.verify.recompute import ChannelCheck, Check, DecisionCheck, WorldCheck
from uav_dc_ros.recordings.verify.service import ServiceSummary
from uav_dc_ros.recordings.verify.vehicle_flights import VehicleCheck
from uav_dc_ros.run_config import SEARCH_MAX
from uav_dc_ros.topics import SIMULATED

NEEDED = ("pose", "users", "rates", "mission")  # topics without which nothing can be recomputed
SHOWN = 5  # different decisions of another policy that are shown with their Q-values
LISTED = 100  # missions with different decisions
DIFFERS = 1  # exit status

EPILOG = """\
Exit status 0: nothing differs; 1: something does, or, with --complete, something could not be recomputed;
2: the bag cannot be verified at all.

What a bag lacks cannot be recomputed; it is counted with its reason, and the last line then is 'verified in
part'. Poses, and users from the seed, are recomputed for flights in this project's simulated world. On
another machine the last digits may differ: --tolerance 1e-12 accepts that, and counts it.

A real vehicle measures its own poses. Its phase changes must be allowed ones, no move may be flown twice, and
users have the time of a pose. Its distance from the centres of cells is reported and is no difference: a step
also ends when its time is over.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog, parser.formatter_class = EPILOG, argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    add("--policy", metavar="NAME|DIR", help="also show where this policy or planner decides differently")
    add("--policy-dir", type=Path, metavar="DIR", help="folder of the policy that flew, or of policies")
    add("--scenario", metavar="NAME|FILE", help="the world, for a bag without one")
    add("--namespace", metavar="NAME", help="of the mission, for a bag with several")
    tolerance = cli.number(0.0, 1e-3, "a number from 0 to 0.001")
    what = "relative, of numbers; 0: to the last bit"
    add("--tolerance", type=tolerance, default=0.0, metavar="X", help=what)
    add("--complete", action="store_true", help="exit status 1 also for what could not be recomputed")
    json = "JSON instead, into a file or to the output"
    add("--json", nargs="?", const="-", metavar="FILE", help=json)


def run(options: argparse.Namespace) -> int:
    """Verify; the exit status. Raises BagError if nothing in the bag can be recomputed."""
    with BagReader(options.bag) as reader:
        namespace = step_reader.namespace(reader, options.namespace)
        _check_topics(reader, namespace)
        scenario = step_reader.scenario(reader, namespace, options.scenario)
        result = _verify(reader, namespace, scenario, options)
    if options.json is not None:
        text = msgspec.json.format(msgspec.json.encode(result.report), indent=2) + b"\n"
        if options.json == "-":
            print(text.decode(), end="")
        else:
            files.write(Path(options.json), text)
    else:
        print(f"{options.bag}: {result.lines[0]}", *result.lines[1:], sep="\n")
        if result.report.recorded_by not in (None, __version__) and result.report.result == "differs":
            print(f"  (recorded by version {result.report.recorded_by}; this is {__version__})")
        print(result.report.result)
    gaps = options.complete and result.report.result == "verified in part"
    return DIFFERS if gaps or result.report.result == "differs" else 0


class CheckReport(msgspec.Struct, frozen=True, kw_only=True):
    """One aspect of a bag."""

    title: str  # channel, world, vehicle, decisions
    recomputed: int  # steps
    differing: int  # recomputed steps with a difference
    within_tolerance: int  # values that are equal only within it
    not_recomputed: dict[str, int]  # steps by reason
    first_difference: str | None


class VerifyReport(msgspec.Struct, frozen=True, kw_only=True):
    """The file of `--json`."""

    bag: str
    result: Literal["verified", "verified in part", "differs"]
    namespace: str  # without a slash at its end
    scenario: str
    fingerprint: str
    policy: str | None  # the policy or planner whose decisions are recomputed
    policy_sha256: str | None  # null for a planner
    objective_weight: float | None  # w of a planner that depends on it
    search: int  # missions of the policy's search before each move; 0: none
    searches_out_of_time: int  # recomputed steps in which it took the policy's own move
    decisions_missing: str  # why no decisions are recomputed; empty
    recorded_by: str | None  # version of this package
    verified_by: str  # likewise
    missions: int
    steps: int
    checks: list[CheckReport]
    losses: list[str]  # messages that are part of no step
    service: dict[str, float | None]  # figures of `core.users.service`, means over the missions
    # Steps in which the policy of `--policy` decides differently, of those compared; null without it
    other_policy: tuple[int, int] | None


class Verified(NamedTuple):
    """The result of a verification, and the same as text."""

    report: VerifyReport
    lines: list[str]


class OtherPolicy(DecisionCheck):
    """Decisions of another policy or planner than the one that flew."""

    def __init__(self, scenario: Scenario, agent: Agent, weight: float) -> None:
        super().__init__(scenario, agent, weight)
        self._details: list[str] = []
        self._missions = 0  # with different decisions
        self._before = 0, 0  # steps compared and differing before the mission

    def add(self, step: RecordedStep) -> str | None:
        """Compare the decision of a step."""
        action = super().add(step)
        if action is not None and self.differing <= SHOWN and step.move is not None:
            own, recorded = self._with_q(step, action), self._with_q(step, step.move.action)
            self._details.append(f"  {step.name}: {own}, recorded {recorded}")
        return action

    def _with_q(self, step: RecordedStep, action: str) -> str:
        """An action with its Q-value; of a planner, which has none, the action alone."""
        observed, policy = step.observed(self._scenario), self.agent.policy
        if policy is None or observed is None:
            return action
        q_values = policy.q_values(policy.observe(self._scenario, **observed))
        return f"{action} (Q {q_values[ACTION_LABELS.index(action)]:.6g})"

    def end_mission(self, name: str) -> None:
        """Count the decisions of a mission after its last step."""
        compared, differing = self.compared - self._before[0], self.differing - self._before[1]
        self._before = self.compared, self.differing
        self._missions += differing > 0
        if differing and self._missions <= LISTED:
            self._details.append(f"  {name}: {differing} of {compared} moves")

    def lines(self) -> list[str]:
        """The result as text."""
        more = [f"  and in {self._missions - LISTED} more missions"] if self._missions > LISTED else []
        summary = f"{self.agent.name!r} decides differently in {self.differing} of {self.compared} steps"
        return [summary, *self._details, *more]


def _verify(reader: BagReader, namespace: str, scenario: Scenario, options: argparse.Namespace) -> Verified:
    """Recompute the missions in a namespace; raises BagError if nothing can be recomputed."""
    about, tolerance = reader.about, options.tolerance
    weight = _weight(reader)
    other = OtherPolicy(scenario, agents.load(options.policy), weight) if options.policy else None
    vehicle = step_reader.vehicle(reader, namespace)
    seed, lockstep, real = about.get("seed"), about.get("pace") == pace.LOCKSTEP, vehicle != SIMULATED
    agent, missing_policy = _agent(about, scenario, options.policy_dir, _search(reader))
    channel = ChannelCheck(scenario, tolerance)
    world = WorldCheck(scenario, seed=seed, lockstep=lockstep, real=real, tolerance=tolerance)
    flights = VehicleCheck(scenario, vehicle) if real else None
    decisions = DecisionCheck(scenario, agent, weight) if agent else None
    service = ServiceSummary(scenario)
    recorded = Steps(reader, namespace, scenario.step_ns)
    n_missions = n_steps = 0
    for (flight, mission), steps in groupby(recorded, attrgetter("flight", "mission")):
        n_missions += 1
        for step in steps:
            n_steps += 1
            service.add(step)
            if step.is_measured or step.users is not None or step.rates is not None:
                channel.add(step)
            for check in (world, flights, decisions, other):
                if check:
                    check.add(step)
        service.end_mission()
        if other:
            other.end_mission(mission_name(mission, flight))
    if not channel.compared and not world.compared:
        skipped = ", ".join(f"{reason} ({n})" for reason, n in channel.skipped.most_common())
        why = "; ".join(recorded.rejected.lines()) or skipped or "there are none"
        raise BagError(f"bag {reader.path}: none of its {n_steps} steps can be recomputed: {why}")
    checks: list[Check] = [one for one in (channel, world, flights, decisions) if one]
    lines = [line for check in checks for line in check.lines()]
    if not decisions:
        lines.append(f"decisions: not verified: {missing_policy}")
    lines += service.lines()
    losses = list(recorded.losses())
    missions = f"{n_missions} mission{'s' * (n_missions != 1)}"
    by = "" if agent is None else f", {_title(agent, weight)}"
    flown = f"{missions}, {n_steps} steps in scenario {scenario.name!r}{by}"
    has_gaps = any(check.skipped for check in checks) or not decisions or bool(losses) or seed is None
    differs = any(check.differing for check in checks)
    report = VerifyReport(
        bag=printable(str(options.bag)),
        result="differs" if differs else "verified in part" if has_gaps else "verified",
        namespace=namespace,
        scenario=scenario.name,
        fingerprint=scenario.fingerprint,
        policy=agent.name if agent else None,
        policy_sha256=agent.sha256 if agent else None,
        objective_weight=weight if agent and agent.weighs else None,
        search=agent.search if agent else 0,
        searches_out_of_time=decisions.timed_out if decisions else 0,
        decisions_missing=missing_policy,
        recorded_by=about.get("version"),
        verified_by=__version__,
        missions=n_missions,
        steps=n_steps,
        checks=[
            CheckReport(
                title=check.title,
                recomputed=check.compared,
                differing=check.differing,
                within_tolerance=check.within,
                not_recomputed=dict(check.skipped),
                first_difference=check.first and check.first.text,
            )
            for check in checks
        ],
        losses=losses,
        service=service.means(),
        other_policy=(other.differing, other.compared) if other else None,
    )
    return Verified(report, [flown, *lines, *losses, *(other.lines() if other else [])])


def _check_topics(reader: BagReader, namespace: str) -> None:
    """Raises BagError for a bag without a needed topic."""
    # A real vehicle's mission that ends before takeoff has no users and no rates.
    needed = NEEDED if step_reader.vehicle(reader, namespace) == SIMULATED else ("mission",)
    counts = {name.removeprefix(f"{namespace}/"): topic.count for name, topic in reader.topics.items()}
    missing = [f"{namespace}/{name}" for name in needed if not counts.get(name)]
    if missing:
        raise BagError(
            f"bag {reader.path} holds nothing on {', '.join(missing)}; expected {', '.join(needed)}, from "
            f"which missions are recomputed; its topics are {', '.join(sorted(reader.topics))}"
        )


def _title(agent: Agent, weight: float) -> str:
    sha256, weighed = agent.sha256, f"w = {weight:.6g}" if agent.weighs else ""
    searched = f"search {agent.search}" if agent.search else ""
    details = ", ".join(filter(None, (sha256 and f"sha256 {sha256[:12]}", searched, weighed)))
    return f"{'policy' if sha256 else 'planner'} {agent.name!r}" + (f" ({details})" if details else "")


def _weight(reader: BagReader) -> float:
    """The weight of the objective in the bag; raises BagError if it is none."""
    text = reader.about.get("objective_weight")
    try:
        return DEFAULT_WEIGHT if text is None else check_weight(float(text), "objective_weight")
    except (ValueError, UavDcError):
        raise BagError(
            f"bag {reader.path}: objective_weight {text!r}; expected a number from 0 to 1"
        ) from None


def _search(reader: BagReader) -> int:
    """The missions of a search in the bag, 0 for none; raises BagError if it is no such number."""
    text = reader.about.get("search", "0")
    if not (text.isascii() and text.isdecimal() and int(text) <= SEARCH_MAX):
        raise BagError(f"bag {reader.path}: search {text!r}; expected a whole number from 0 to {SEARCH_MAX}")
    return int(text)


def _agent(
    about: dict[str, str], scenario: Scenario, folder: Path | None, search: int
) -> tuple[Agent | None, str]:
    """The policy that flew, by the hash in the bag, or the planner; or why there is none."""
    if folder is not None and not folder.is_dir():
        raise ParameterError(f"--policy-dir {folder}: no such folder")
    name, sha256 = about.get("policy"), about.get("policy_sha256")
    if name in PLANNERS and sha256 is None:
        return Agent(name, PLANNERS[name], search), ""
    if name is None or sha256 is None:
        return None, "the bag does not name the policy that flew; --policy NAME|DIR compares with one"
    candidates: list[str | Path] = [name, *policies.names()]
    if folder is not None:
        candidates = [folder, *sorted(path.parent for path in folder.glob(f"*/{CONFIG}")), *candidates]
    other = ""
    for candidate in candidates:
        try:
            policy = policies.load(candidate)
        except PolicyError:
            continue
        if policy.sha256 == sha256:
            policy.check(scenario)
            return Agent(policy.name, policy, search), ""
        if policy.name == name and not other:
            other = f"; {str(candidate)!r} is another one (sha256 {policy.sha256[:12]})"
    missing = f"policy {name!r} (sha256 {sha256[:12]}) is missing{other}"
    return None, f"{missing}; expected it from --policy-dir DIR"
