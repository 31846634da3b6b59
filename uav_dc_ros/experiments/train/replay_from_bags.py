"""Recorded flights in the replay buffers of a training that begins."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import TrainingError

if TYPE_CHECKING:  # most trainings begin without bags: what reads them is imported when it is needed
    from uav_dc_ros.experiments.train.training import Training
    from uav_dc_ros.recordings.recorded_step import RecordedStep
    from uav_dc_ros.recordings.step_reader import Steps


class Remembered(msgspec.Struct, frozen=True, kw_only=True):
    """What a training began with.

    Attributes:
        bags: as they were given.
        missions, transitions: in them.
        held: transitions in each run's replay buffer: the latest, if they do not all fit.
    """

    bags: tuple[str, ...]
    missions: int
    transitions: int
    held: int

    def __str__(self) -> str:
        """In words."""
        bags = ", ".join(Path(bag).name for bag in self.bags)
        held = "" if self.held == self.transitions else f", of which the latest {self.held} fit into it"
        return f"{self.transitions} transitions of {self.missions} recorded missions ({bags}){held}"


def remember(training: "Training", bags: Sequence[Path]) -> Remembered:
    """Put the transitions of every mission in the bags into the replay buffer of every run.

    Observations are those of this training, and rewards are what it pays; bags hold neither. The bags are
    read in the order given, and each of its namespaces in the order of their names.

    Args:
        training: before its first episode.
        bags: folders of bags, or MCAP files.

    Raises:
        TrainingError: a bag holds no transition, or missions in another world; the runs are paid differently.
        BagError: a bag cannot be read.
    """
    from uav_dc_ros.bags.read import BagReader
    from uav_dc_ros.recordings import step_reader
    from uav_dc_ros.recordings.transitions import Transitions

    population = training.population
    paid = {run.reward for run in population.runs}
    if len(paid) > 1:
        raise TrainingError(
            f"the runs of the population are paid in {len(paid)} ways; expected one, for recorded flights"
        )
    scenario = msgspec.structs.replace(population.scenario, reward=paid.pop())
    missions: set[tuple[int, str, int, int]] = set()
    n = 0
    for i, bag in enumerate(bags):
        n_before, unreadable = n, list[str]()
        with BagReader(bag) as reader:
            for namespace in step_reader.namespaces(reader):
                recorded = step_reader.Steps(reader, namespace, scenario.step_ns)
                ours = Transitions(_checked(recorded, scenario, bag), scenario, population.observation)
                for transition in ours:
                    training.remember(transition)
                    missions.add((i, namespace, transition.flight, transition.mission))
                    n += 1
                unreadable += recorded.rejected.lines()
        if n == n_before:
            why = "; ".join(unreadable) or "expected missions with `mission` and `rates`"
            raise TrainingError(f"bag {bag} holds no transition; {why}")
    return Remembered(
        bags=tuple(map(str, bags)), missions=len(missions), transitions=n, held=training.n_remembered
    )


def _checked(recorded: "Steps", scenario: Scenario, bag: Path) -> "Iterator[RecordedStep]":
    for step in recorded:
        if step.status is not None and step.status.fingerprint != scenario.fingerprint:
            raise TrainingError(
                f"bag {bag}: {step.name} is flown in {step.status.scenario!r} ({step.status.fingerprint}); "
                f"expected the training's {scenario.name!r} ({scenario.fingerprint})"
            )
        yield step


def check_remembered(saved: Path, remembered: dict[str, Any] | None, bags: Sequence[Path] | None) -> None:
    """Compare what a saved training began with to what is wanted now; no bag is read again.

    Args:
        saved: its file.
        remembered: a `Remembered` in plain values, or None.
        bags: those of this command, if any.

    Raises:
        TrainingError: it began with other bags.
    """
    before = list(remembered["bags"]) if remembered else None
    now = [str(bag) for bag in bags] if bags else None
    if before != now:
        raise TrainingError(
            f"{saved} is the state of a training with from_bags = {before}; "
            f"expected {now}, as in this command"
        )
