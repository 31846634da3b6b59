"""Prefills the replay buffers of a new training with recorded flights."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import TrainingError

if TYPE_CHECKING:  # the modules that read bags are imported only when bags are given
    from uav_dc_ros.experiments.train.training import Training
    from uav_dc_ros.recordings.recorded_step import RecordedStep
    from uav_dc_ros.recordings.step_reader import Steps


class PrefilledReplay(msgspec.Struct, frozen=True, kw_only=True):
    """The recorded flights in the replay buffers."""

    bags: tuple[str, ...]  # paths as given
    missions: int
    transitions: int
    held: int  # transitions in each run's replay buffer: the latest, if not all fit

    def __str__(self) -> str:
        bags = ", ".join(Path(bag).name for bag in self.bags)
        held = "" if self.held == self.transitions else f", of which the latest {self.held} fit into it"
        return f"{self.transitions} transitions of {self.missions} recorded missions ({bags}){held}"


def prefill_replay(training: "Training", bags: Sequence[Path]) -> PrefilledReplay:
    """Puts every recorded transition into the replay buffer of every run, before the first episode.

    Observations and rewards are those of this training; bags hold neither. The bags are read in the order
    given, and the namespaces of each in the order of their names. Raises TrainingError if a bag holds no
    transition or missions in another world, or if rewards of the runs differ; BagError if one cannot be read.
    """
    from uav_dc_ros.bags.read import BagReader
    from uav_dc_ros.recordings import step_reader
    from uav_dc_ros.recordings.transitions import RecordedTransitions

    population = training.population
    rewards = {run.reward for run in population.runs}
    if len(rewards) > 1:
        raise TrainingError(
            f"the runs of the population have {len(rewards)} rewards; expected one, for recorded flights"
        )
    scenario = msgspec.structs.replace(population.scenario, reward=rewards.pop())
    missions: set[tuple[int, str, int, int]] = set()
    n = 0
    for i, bag in enumerate(bags):
        n_before, rejected = n, list[str]()
        with BagReader(bag) as reader:
            for namespace in step_reader.namespaces(reader):
                steps = step_reader.Steps(reader, namespace, scenario.step_ns)
                recorded = _of_scenario(steps, scenario, bag)
                for transition in RecordedTransitions(recorded, scenario, population.observation):
                    training.add_recorded(transition)
                    missions.add((i, namespace, transition.flight, transition.mission))
                    n += 1
                rejected += steps.rejected.lines()
        if n == n_before:
            reason = "; ".join(rejected) or "expected missions with `mission` and `rates`"
            raise TrainingError(f"bag {bag} holds no transition; {reason}")
    return PrefilledReplay(
        bags=tuple(map(str, bags)), missions=len(missions), transitions=n, held=training.replay_size
    )


def _of_scenario(steps: "Steps", scenario: Scenario, bag: Path) -> "Iterator[RecordedStep]":
    """The steps; raises TrainingError for one of another scenario."""
    for step in steps:
        if step.status is not None and step.status.fingerprint != scenario.fingerprint:
            raise TrainingError(
                f"bag {bag}: {step.name} is flown in {step.status.scenario!r} ({step.status.fingerprint}); "
                f"expected the training's {scenario.name!r} ({scenario.fingerprint})"
            )
        yield step
