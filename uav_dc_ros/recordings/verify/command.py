"""Verify a bag: recompute everything that it tells of its missions, and compare to the last bit."""

import argparse
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from uav_dc_ros import __version__
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.agents.policy import CONFIG, Policy
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core import pace
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagError, ParameterError, PolicyError
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.recorded_step import RecordedStep
from uav_dc_ros.recordings.recorded_vehicle import is_real, vehicle
from uav_dc_ros.recordings.step_reader import Steps
from uav_dc_ros.recordings.verify.differences import Book
from uav_dc_ros.recordings.verify.recompute import Channel, Decisions, World
from uav_dc_ros.recordings.verify.vehicle_flights import Flights
from uav_dc_ros.topics import SIMULATED

NEEDED = ("pose", "users", "rates", "mission")  # topics without which nothing can be recomputed
SHOWN = 5  # decisions of another policy that are shown with their Q-values
LISTED = 100  # missions in which it decides otherwise
DIFFERS = 1  # exit status

EPILOG = """\
Exit status 0: nothing differs; 1: something does, or, with --complete, something could not be recomputed;
2: the bag cannot be verified at all.

What a bag lacks cannot be recomputed; it is counted with its reason, and the last line then says 'in part'.
Poses, and users from the seed, are recomputed for flights of this project's own world. Another machine's
mathematics may differ in the last digit: --tolerance 1e-12 lets that pass, and counts it.

A real vehicle's poses are what it measured itself. Its phases must follow each other as they may, no move may
be flown twice, and users have the time of a pose; its distance to the centres of its cells is reported and
is no difference: a step also ends when its time is over.
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.epilog, parser.formatter_class = EPILOG, argparse.RawDescriptionHelpFormatter
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    add("--policy", metavar="NAME|DIR", help="also show where this policy would have decided otherwise")
    add(
        "--policy-dir",
        type=Path,
        metavar="DIR",
        help="where the policy that flew lies: its folder, or theirs",
    )
    add("--scenario", metavar="NAME|FILE", help="the world, for a bag without one")
    add("--namespace", metavar="NAME", help="of the mission, for a bag with several")
    add(
        "--tolerance",
        type=_tolerance,
        default=0.0,
        metavar="X",
        help="relative, of numbers; 0: to the last bit",
    )
    add("--complete", action="store_true", help="exit status 1 also for what could not be recomputed")


def _tolerance(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 1e-3:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a number from 0 to 0.001")
    return value


def run(options: argparse.Namespace) -> int:
    """Verify; the exit status.

    Raises:
        BagError: nothing of the bag can be recomputed.
    """
    with BagReader(options.bag) as reader:
        namespace = step_reader.namespace(reader, options.namespace)
        _check_topics(reader, namespace, ("mission",) if is_real(reader, namespace) else NEEDED)
        scenario = step_reader.scenario(reader, namespace, options.scenario)
        other = Decisions(scenario, policies.load(options.policy)) if options.policy else None
        found = verify(reader, namespace, scenario, other, options.policy_dir, options.tolerance)
        print(f"{options.bag}: {found.flown}")
        for line in found.lines:
            print(line)
        if reader.about.get("version", __version__) != __version__ and found.differs:
            print(f"  (recorded by version {reader.about['version']}; this is {__version__})")
    if found.differs:
        print("differs")
    else:
        print("verified in part" if found.gaps else "verified")
    return DIFFERS if found.differs or (options.complete and found.gaps) else 0


class Verification(NamedTuple):
    """What a verification found.

    Attributes:
        flown: what was looked at, in words.
        lines: what was found, in words.
        differs: is a recorded value not the recomputed one.
        gaps: was there anything that could not be recomputed.
    """

    flown: str
    lines: list[str]
    differs: bool
    gaps: bool


def verify(
    reader: BagReader,
    namespace: str,
    scenario: Scenario,
    other: Decisions | None = None,
    policy_dir: Path | None = None,
    tolerance: float = 0.0,
) -> Verification:
    """Recompute the missions in a namespace.

    Args:
        reader: of the bag.
        namespace: as `steps.namespace` gives it.
        scenario: the world.
        other: with another policy, to tell where it would have decided otherwise.
        policy_dir: where the policy that flew may lie.
        tolerance: relative difference of numbers that counts as none.
    """
    about = reader.about
    lockstep = about.get("pace") == pace.LOCKSTEP
    seeded = "seed" in about  # our recorder tells it, of our world
    flew = vehicle(reader, namespace)
    real = flew != SIMULATED
    policy, without = _policy(about, scenario, policy_dir)
    channel = Channel(scenario, tolerance)
    world = World(scenario, seeded=seeded, lockstep=lockstep, real=real, tolerance=tolerance)
    flights = Flights(scenario) if real else None
    decisions = Decisions(scenario, policy) if policy else None
    recorded = Steps(reader, namespace, scenario.step_ns)
    otherwise: list[str] = []
    n_missions = n_steps = n_missions_other = 0
    for _, mission in groupby(recorded, lambda step: (step.flight, step.mission)):
        n_missions += 1
        n_other, n_before = 0, other.compared if other else 0
        for step in mission:
            n_steps += 1
            if step.is_measured or step.users is not None or step.rates is not None:
                channel.add(step)
            world.add(step)
            if flights:
                flights.add(step)
            if decisions:
                decisions.add(step)
            if other and (q_values := other.add(step)) is not None:
                n_other += 1
                if other.differing <= SHOWN:
                    otherwise.append(f"  {step.name}: {_told(step, q_values)}")
        if other and n_other:
            n_missions_other += 1
        if other and n_other and n_missions_other <= LISTED:
            otherwise.append(
                f"  {step.name.partition(',')[0]}: {n_other} of {other.compared - n_before} moves"
            )
    if not channel.compared and not world.compared:
        why = "; ".join(recorded.rejected.lines()) or _reasons(channel)
        raise BagError(f"bag {reader.path}: none of its {n_steps} steps can be recomputed: {why}")
    told = "" if policy is None else f", policy {policy.name!r} (sha256 {policy.sha256[:12]})"
    missions = f"{n_missions} mission{'s' * (n_missions != 1)}"
    flown = f"{missions}, {n_steps} steps in scenario {scenario.name!r}{told}"
    lines = [*_lines("channel", channel), *_channel_notes(channel), *_lines("world", world)]
    if world.hovered:
        lines.append(f"  {world.hovered} moves were not flown: they came too late, and the vehicle hovered")
    if seeded and any(str(seed) != about["seed"] for seed in world.seeds.values()):
        seeds = ", ".join(map(str, world.seeds.values()))
        lines.append(f"  flown with seed {seeds}, though the bag is said to be of seed {about['seed']}")
    if not seeded:
        what = "users" if real else "poses and users"
        lines.append(f"  not flown by our own world, as far as the bag tells: {what} are as recorded")
    if flights:
        lines += flights.lines(flew)
    lines += _lines("decisions", decisions) if decisions else [f"decisions: not verified: {without}"]
    unread = recorded.rejected + recorded.orphans
    lines += recorded.rejected.lines()
    for topic, n in sorted(recorded.orphans.items()):
        lines.append(f"{n} messages on {topic} came too late to be brought together with their step")
    if other:
        name, of = other.policy.name, f"{other.differing} of {other.compared} steps"
        lines.append(f"{name!r} would have decided otherwise in {of}")
        lines += otherwise
        if n_missions_other > LISTED:
            lines.append(f"  and in {n_missions_other - LISTED} missions more")
    books: list[Book] = [channel, world, *([flights] if flights else []), *([decisions] if decisions else [])]
    return Verification(
        flown,
        lines,
        differs=any(book.differing for book in books),
        gaps=any(book.skipped for book in books) or decisions is None or bool(unread) or not seeded,
    )


def _check_topics(reader: BagReader, namespace: str, needed: tuple[str, ...]) -> None:
    """Raises BagError for a bag that lacks a whole topic: nothing in it can be recomputed.

    A real vehicle whose mission ended before it left the ground has nobody measured.
    """
    missing = [
        f"{namespace}/{name}"
        for name in needed
        if f"{namespace}/{name}" not in reader.topics or not reader.topics[f"{namespace}/{name}"].count
    ]
    if missing:
        raise BagError(
            f"bag {reader.path} holds nothing on {', '.join(missing)}; expected {', '.join(needed)}, from "
            f"which missions are recomputed; its topics are {', '.join(sorted(reader.topics))}"
        )


def _policy(about: dict[str, str], scenario: Scenario, folder: Path | None) -> tuple[Policy | None, str]:
    """The policy that flew, by the hash in the bag; or why there is none.

    Raises:
        ParameterError: `folder` is none.
    """
    if folder is not None and not folder.is_dir():
        raise ParameterError(f"--policy-dir {folder}: no such folder")
    name, sha256 = about.get("policy"), about.get("policy_sha256")
    if name is None or sha256 is None:
        return None, "the bag does not tell which policy flew; --policy NAME|DIR compares with one"
    other = ""
    for candidate in _candidates(name, folder):
        try:
            policy = policies.load(candidate)
        except PolicyError:
            continue
        if policy.sha256 == sha256:
            policy.check(scenario)
            return policy, ""
        if policy.name == name and not other:
            other = f"; {str(candidate)!r} is another one (sha256 {policy.sha256[:12]})"
    return (
        None,
        f"policy {name!r} (sha256 {sha256[:12]}) is not here{other}; expected it from --policy-dir DIR",
    )


def _candidates(name: str, folder: Path | None) -> Iterator[str | Path]:
    if folder is not None:
        yield folder
        yield from sorted(path.parent for path in folder.glob(f"*/{CONFIG}"))
    yield name
    yield from policies.names()


def _lines(title: str, book: Book) -> list[str]:
    """A book in words."""
    total = book.compared + book.skipped.total()
    if not total:
        return [f"{title}: the bag has no step for it"]
    told = f"{title}: {book.compared} of {total} steps recomputed"
    if not book.differing:
        lines = [f"{told}, equal {'to the last bit' if not book.within else 'within the tolerance'}"]
    else:
        lines = [f"{told}, {book.differing} differ; first:", f"  {book.first}"]
    if book.within:
        lines.append(f"  {book.within} values are equal within the tolerance only")
    lines += [f"  {n} not recomputed: {reason}" for reason, n in book.skipped.most_common()]
    return lines


def _channel_notes(channel: Channel) -> list[str]:
    if not channel.later_poses:
        return []
    return [f"  {channel.later_poses} steps fit a later pose than the first one recorded"]


def _reasons(book: Book) -> str:
    return ", ".join(f"{reason} ({n})" for reason, n in book.skipped.most_common()) or "there are none"


def _told(step: RecordedStep, q_values: Array) -> str:
    """Another decision, with its Q-value and that of the one recorded."""
    assert step.move is not None, "it was compared"
    best = int(np.argmax(q_values))
    recorded = ACTION_LABELS.index(step.move.action)
    decided = f"{ACTION_LABELS[best]} (Q {q_values[best]:.6g})"
    return f"{decided}, recorded {step.move.action} (Q {q_values[recorded]:.6g})"
