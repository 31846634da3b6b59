"""Verify a bag: recompute its missions, and compare to the last bit."""

import argparse
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import numpy as np

from uav_dc_ros import __version__, cli
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.agents.policy import CONFIG, Policy
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core import pace
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagError, ParameterError, PolicyError
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.recorded_step import RecordedStep, mission_name
from uav_dc_ros.recordings.step_reader import Steps
from uav_dc_ros.recordings.verify.recompute import ChannelCheck, Check, DecisionCheck, WorldCheck
from uav_dc_ros.recordings.verify.service import ServiceSummary
from uav_dc_ros.recordings.verify.vehicle_flights import VehicleCheck
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
    add("--policy", metavar="NAME|DIR", help="also show where this policy decides differently")
    add("--policy-dir", type=Path, metavar="DIR", help="folder of the policy that flew, or of policies")
    add("--scenario", metavar="NAME|FILE", help="the world, for a bag without one")
    add("--namespace", metavar="NAME", help="of the mission, for a bag with several")
    tolerance = cli.number(0.0, 1e-3, "a number from 0 to 0.001")
    what = "relative, of numbers; 0: to the last bit"
    add("--tolerance", type=tolerance, default=0.0, metavar="X", help=what)
    add("--complete", action="store_true", help="exit status 1 also for what could not be recomputed")


def run(options: argparse.Namespace) -> int:
    """Verify; the exit status. Raises BagError if nothing in the bag can be recomputed."""
    with BagReader(options.bag) as reader:
        namespace = step_reader.namespace(reader, options.namespace)
        _check_topics(reader, namespace)
        scenario = step_reader.scenario(reader, namespace, options.scenario)
        lines, differs, has_gaps = _verify(reader, namespace, scenario, options)
        print(f"{options.bag}: {lines[0]}", *lines[1:], sep="\n")
        if reader.about.get("version", __version__) != __version__ and differs:
            print(f"  (recorded by version {reader.about['version']}; this is {__version__})")
    if differs:
        print("differs")
    else:
        print("verified in part" if has_gaps else "verified")
    return DIFFERS if differs or (options.complete and has_gaps) else 0


class OtherPolicy(DecisionCheck):
    """Decisions of another policy than the one that flew."""

    def __init__(self, scenario: Scenario, policy: Policy) -> None:
        super().__init__(scenario, policy)
        self._details: list[str] = []
        self._missions = 0  # with different decisions
        self._before = 0, 0  # steps compared and differing before the mission

    def add(self, step: RecordedStep) -> Array | None:
        """Compare the decision of a step."""
        q_values = super().add(step)
        if q_values is not None and self.differing <= SHOWN and step.move is not None:
            best, recorded = int(np.argmax(q_values)), ACTION_LABELS.index(step.move.action)
            self._details.append(
                f"  {step.name}: {ACTION_LABELS[best]} (Q {q_values[best]:.6g}), "
                f"recorded {step.move.action} (Q {q_values[recorded]:.6g})"
            )
        return q_values

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
        summary = f"{self.policy.name!r} decides differently in {self.differing} of {self.compared} steps"
        return [summary, *self._details, *more]


def _verify(
    reader: BagReader, namespace: str, scenario: Scenario, options: argparse.Namespace
) -> tuple[list[str], bool, bool]:
    """Recompute the missions in a namespace; raises BagError if nothing can be recomputed.

    Returns the result as text, whether a recorded value differs from the recomputed one, and whether
    something could not be recomputed.
    """
    other = OtherPolicy(scenario, policies.load(options.policy)) if options.policy else None
    about, tolerance = reader.about, options.tolerance
    vehicle = step_reader.vehicle(reader, namespace)
    seed, lockstep, real = about.get("seed"), about.get("pace") == pace.LOCKSTEP, vehicle != SIMULATED
    policy, missing_policy = _policy(about, scenario, options.policy_dir)
    channel = ChannelCheck(scenario, tolerance)
    world = WorldCheck(scenario, seed=seed, lockstep=lockstep, real=real, tolerance=tolerance)
    flights = VehicleCheck(scenario, vehicle) if real else None
    decisions = DecisionCheck(scenario, policy) if policy else None
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
    by = "" if policy is None else f", policy {policy.name!r} (sha256 {policy.sha256[:12]})"
    flown = f"{missions}, {n_steps} steps in scenario {scenario.name!r}{by}"
    has_gaps = any(check.skipped for check in checks) or not decisions or bool(losses) or seed is None
    lines = [flown, *lines, *losses, *(other.lines() if other else [])]
    return lines, any(check.differing for check in checks), has_gaps


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


def _policy(about: dict[str, str], scenario: Scenario, folder: Path | None) -> tuple[Policy | None, str]:
    """The policy that flew, by the hash in the bag, or why there is none."""
    if folder is not None and not folder.is_dir():
        raise ParameterError(f"--policy-dir {folder}: no such folder")
    name, sha256 = about.get("policy"), about.get("policy_sha256")
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
            return policy, ""
        if policy.name == name and not other:
            other = f"; {str(candidate)!r} is another one (sha256 {policy.sha256[:12]})"
    missing = f"policy {name!r} (sha256 {sha256[:12]}) is missing{other}"
    return None, f"{missing}; expected it from --policy-dir DIR"
