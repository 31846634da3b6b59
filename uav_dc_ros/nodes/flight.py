"""One run of run_all: check everything, start the nodes, follow the missions, stop, tell."""

import argparse
import os
import signal
import time
from datetime import datetime
from pathlib import Path

import msgspec
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from uav_dc_ros import cli, scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core import pace
from uav_dc_ros.errors import BagError, NodeError, ParameterError
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes import observer
from uav_dc_ros.nodes.display import Display
from uav_dc_ros.nodes.launcher import Launcher
from uav_dc_ros.nodes.table import NODES

SILENCE_S = 30.0  # longest wait for the nodes to appear, and for a step that is due
CHECK_PERIOD_S = 0.05


class Flight:
    """A run of missions, from the command line's options (see run_all).

    Raises:
        UavDcError: an option that cannot be flown; nothing was started or written yet.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.scenario = scenarios.load(options.scenario)
        self.policy = policies.load(options.policy or f"{self.scenario.name}_dueling")
        self.policy.check(self.scenario)
        pace.check(self.scenario, options.pace, options.missions)
        self.bag = None if options.no_record else _new_bag(options.bag)
        if options.summary is not None:
            _check_writable(options.summary, self.bag)
        self.display = Display(self.scenario, options.missions)
        if self.policy.scenario.fingerprint != self.scenario.fingerprint:
            self.display.note(
                f"policy {self.policy.name} learnt in another world ({self.policy.scenario.name} "
                f"{self.policy.scenario.fingerprint}) than it flies in ({self.scenario.name} "
                f"{self.scenario.fingerprint})"
            )
        self.summaries: list[observer.Summary] = []
        self._interrupted = False
        self._step_s = 0.0  # when the last step came, monotonic clock

    def run(self) -> int:
        """Fly; returns the exit status of the command."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._interrupt)
        status = 0
        parameters = self._parameters()
        with Launcher(self.display.node_line) as launcher, self.display:
            rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
            node = observer.Observer(
                self.scenario, self.options.seed, list(parameters), self._on_step, self._on_end
            )
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            try:
                for name, values in parameters.items():
                    launcher.start(name, values)
                self._follow(launcher, node, executor)
            except NodeError as error:
                self.display.error(str(error))
                status = 1
            status = max(status, self._stopped(launcher.stop()))
            if (flown := len(self.summaries)) < self.options.missions:
                not_begun = observer.MissionSoFar(mission=flown, seed=self.options.seed + flown)
                now = node.mission or not_begun
                self._on_end(now if now.mission == flown else not_begun, Phase.ABORTED)
            node.destroy_node()
            rclpy.try_shutdown()
        self._tell()
        return cli.INTERRUPTED if self._interrupted else status

    def _stopped(self, statuses: dict[str, int]) -> int:
        """Tell which nodes did not end as they should; 1 if that spoilt anything: the recorder's bag."""
        odd = {name: code for name, code in statuses.items() if code not in (0, -signal.SIGTERM)}
        for name, code in odd.items():
            self.display.error(f"node {name} ended with {code} when it was asked to stop")
        return int("recorder" in odd)

    def _follow(self, launcher: Launcher, node: observer.Observer, executor: SingleThreadedExecutor) -> None:
        """Spin until all missions are over, or Ctrl-C.

        Raises:
            NodeError: a node ended, or no step came for too long.
        """
        patience_s = SILENCE_S + pace.period_s(self.scenario, self.options.pace)
        self._step_s = time.monotonic()
        check_s = 0.0
        while len(self.summaries) < self.options.missions and not self._interrupted:
            executor.spin_once(timeout_sec=CHECK_PERIOD_S)
            now_s = time.monotonic()
            if now_s < check_s:
                continue
            check_s = now_s + CHECK_PERIOD_S
            launcher.check()
            if now_s - self._step_s > patience_s:
                silent = "no step came" if node.mission else "the nodes did not find each other"
                raise NodeError(f"{silent} within {patience_s:.0f} s")

    def _parameters(self) -> dict[str, dict[str, object]]:
        """ROS parameters of the nodes to start."""
        options = self.options
        names = [row.name for row in NODES.values() if row.process]
        if self.bag is None:
            names.remove("recorder")
        scenario = options.scenario
        if scenario not in scenarios.names():
            scenario = str(Path(scenario).absolute())
        shared: dict[str, object] = {"scenario": scenario, "peers": [*names, "observer"]}
        course = {"seed": options.seed, "missions": options.missions, "pace": pace.text(options.pace)}
        policy = {"policy": str(self.policy.folder.absolute())}
        own: dict[str, dict[str, object]] = {
            "world": {**course},
            "channel_monitor": {},
            "policy": {**policy},
            "recorder": {"bag": str(self.bag), **course, **policy},
        }
        return {name: shared | own[name] for name in names}

    def _interrupt(self, *_: object) -> None:
        self._interrupted = True

    def _on_step(self, mission: observer.MissionSoFar) -> None:
        self._step_s = time.monotonic()
        self.display.step(mission)

    def _on_end(self, mission: observer.MissionSoFar, outcome: Phase) -> None:
        bag = None if self.bag is None else str(self.bag)
        self.summaries.append(observer.summary(mission, outcome, self.scenario, self.policy.name, bag))

    def _tell(self) -> None:
        """Write the summary where it was asked for, and print it."""
        if self.bag is not None and not self.bag.is_dir():  # the recorder never came so far
            self.summaries = [msgspec.structs.replace(mission, bag=None) for mission in self.summaries]
        if self.options.summary is not None:
            told = self.summaries[0] if self.options.missions == 1 else self.summaries
            text = msgspec.json.format(msgspec.json.encode(told), indent=2)
            cli.write_whole(self.options.summary, text + b"\n")
        self.display.summary(self.summaries)


def _check_writable(summary: Path, bag: Path | None) -> None:
    folder = summary.absolute().parent
    taken = summary.is_dir() or summary.absolute() == bag
    if taken or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise ParameterError(
            f"--summary {summary}: expected a file in an existing folder that can be written"
        )


def _new_bag(wanted: Path | None) -> Path:
    """Folder of the new bag: the one wanted, or a dated one.

    Raises:
        BagError: it exists, or cannot be made.
    """
    if wanted is None:
        dated = Path("bags") / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
        wanted = dated
        again = 2
        while wanted.exists():
            wanted, again = dated.with_name(f"{dated.name}_{again}"), again + 1
    elif wanted.exists():
        raise BagError(
            f"--bag {wanted}: it exists already, and no bag is ever overwritten; expected a new folder"
        )
    wanted = wanted.absolute()
    above = next(parent for parent in wanted.parents if parent.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise BagError(f"--bag {wanted}: {above} is not a folder that can be written; expected one")
    return wanted
