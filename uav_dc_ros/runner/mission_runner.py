"""One run of run_all: check everything, start the nodes, follow the missions, stop, tell."""

import gc
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, cast

import msgspec
from rclpy.context import Context

from uav_dc_ros import cli, files, scenarios
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.core import pace
from uav_dc_ros.errors import BagError, NodeError
from uav_dc_ros.messages import Mission, Phase, new_run
from uav_dc_ros.mission_summary import Summary
from uav_dc_ros.nodes.framework.node_table import mission_rows
from uav_dc_ros.nodes.framework.other_publishers import AnotherMissionError
from uav_dc_ros.nodes.framework.parameters import ADDRESS, EXTERNAL
from uav_dc_ros.nodes.ros.executor import DirectExecutor
from uav_dc_ros.run_config import RunConfig
from uav_dc_ros.runner import node_locks, run_options
from uav_dc_ros.runner.monitor import MissionMonitor, MissionProgress, summary
from uav_dc_ros.runner.supervisor import Supervisor
from uav_dc_ros.topics import SIMULATED, TOPICS

if TYPE_CHECKING:
    from uav_dc_ros.runner.console import MissionConsole

SILENCE_S = 30.0  # longest wait for the nodes to appear, and for a step that is due
LAST_RATES_S = 5.0  # longest wait for the rates of a mission's last step: their node may be starting again
REST_S, REST_QUIET_S = 2.0, 0.2  # longest time for what the nodes said last, and after which all of it came
TICK_S = 0.02  # from one look at the nodes to the next
BRING_UP_TICK_S = 0.004  # the same until all are active: each transition waits for such a look
LEAVE_S = 3.0  # for the middleware to close, which was seen to hang


class Network:
    """Context, node and executor of the mission monitor.

    Args:
        namespace: of the mission.
        make: makes the node in a context.
    """

    def __init__(self, namespace: str, make: Callable[[Context], MissionMonitor]) -> None:
        self._context = Context()
        self._context.init(["--ros-args", "-r", f"__ns:={namespace}", "-r", "/clock:=clock"])
        self.node = make(self._context)
        self.executor = DirectExecutor(self.node.pause_s, self._context)
        self.executor.add_node(self.node)
        self._has_left = False

    def leave(self) -> None:
        """Leave the network, once: others would wait for a node that only ends with the process."""
        if not self._has_left:
            self._has_left = True
            self.node.trigger_shutdown()
            self.node.destroy_node()
            del self.node, self.executor
            leaving = threading.Thread(target=self._leave, daemon=True)
            leaving.start()
            leaving.join(LEAVE_S)

    def _leave(self) -> None:
        gc.collect()  # the middleware's part of a node ends with the last reference to it, and not before
        self._context.try_shutdown()
        self._context.destroy()


class MissionRunner:
    """A run of missions.

    Args:
        config: what is flown.
        show: are progress and summary printed?

    Raises:
        UavDcError: a value that cannot be flown; nothing was started or written yet.

    Attributes:
        summaries: one for each mission that is over.
        errors: what went wrong, in words.
        interrupted: was it asked to stop?
    """

    def __init__(self, config: RunConfig, *, show: bool = True) -> None:
        self.config = config
        self.scenario = scenarios.load(config.scenario)
        self.policy = policies.load(config.policy or f"{self.scenario.name}_dueling")
        self.policy.check(self.scenario)
        self.is_simulated = config.vehicle == SIMULATED
        if self.is_simulated:
            pace.check(self.scenario, config.factor, config.missions)
        self.rows = mission_rows(() if self.is_simulated else ("bridge",))
        self.nodes = run_options.nodes(config)
        # Whoever starts the vehicle draws the run's identity; a run_all on another host adopts it.
        self.run_id = new_run() if ("world" if self.is_simulated else "bridge") in self.nodes else ""
        self.composed = run_options.composed(config, self.nodes)
        self._settings = run_options.settings(config, self.nodes)
        run_options.check_vehicle(config, self.nodes, self.scenario)
        if config.live is not None:
            from uav_dc_ros.nodes.view import foxglove_server  # brings rosbags, which only few need

            foxglove_server.check(address=str(ADDRESS.default), port=config.live)
        bag = None if config.bag is None else Path(config.bag)
        self.bag = run_options.new_bag(bag) if "recorder" in self.nodes else None
        if config.summary is not None:
            run_options.check_summary(Path(config.summary), self.bag)
        self._show, self._display, self._making = show, cast("MissionConsole | None", None), threading.Lock()
        self.summaries: list[Summary] = []
        self.errors: list[str] = []
        self.interrupted = self._aborted = False
        self._why = ""  # this run ended before its missions
        self._step_s = 0.0  # when the last step came, monotonic clock
        self._status: Mission | None = None  # of the vehicle, its last word

    @property
    def display(self) -> "MissionConsole":
        """What the user sees; made when it is first needed, since the nodes can start meanwhile."""
        with self._making:
            if self._display is None:
                from uav_dc_ros.runner.console import MissionConsole

                self._display = MissionConsole(self.scenario, self.config.missions, show=self._show)
            return self._display

    def run(self) -> int:
        """Fly; returns the exit status of the command.

        It has a ROS context of its own, so that a caller's is as it was, and touches no signal handler.
        """
        status = 0
        with tempfile.TemporaryDirectory(prefix="uav_dc_ros_") as temporary, ExitStack() as stack:
            folder = Path(temporary)
            network = Network(self.config.namespace, self._observer)
            stack.callback(network.leave)
            namespace, parameters = network.node.get_namespace(), self._parameters(folder)
            network.node.trigger_configure()
            network.node.trigger_activate()  # it looks for other missions while all else starts
            on_line: Callable[[str, str], None] = lambda node, line: self.display.node_line(node, line)  # noqa: E731
            supervisor = Supervisor(namespace, parameters, self.composed, folder, on_line, self._note)
            stack.enter_context(supervisor)
            stack.enter_context(self.display)
            try:
                stack.enter_context(self._locks(network.node))
                self._tell_of_world()
                self._follow(supervisor, network.node, network.executor)
            except NodeError as error:
                self._why = str(error)
                self._error(self._why)
                status = 1
                if isinstance(error, AnotherMissionError):  # what was received may be its
                    self.summaries.clear()
                    network.node.mission = self._status = None
            is_complete = len(self.summaries) >= self.config.missions
            status = max(
                status, self._stopped(supervisor.stop(network.leave if is_complete else lambda: None))
            )
            if not is_complete:
                self._hear_the_rest(network.executor)
                self._account_for_all(network.node)
        status = max(status, self._mend_bag(), int(self._aborted))
        self._tell()
        return cli.INTERRUPTED if self.interrupted else status

    def _observer(self, context: Context) -> MissionMonitor:
        """The node that follows the missions."""
        seed = self.config.seed if "world" in self.nodes else None
        return MissionMonitor(
            *(self.scenario, seed, self.run_id, self._peers(), self.nodes),
            *(self._on_status, self._on_step, self._on_end, self._note, context),
        )

    def _locks(self, node: MissionMonitor) -> AbstractContextManager[None]:
        """Locks of the nodes that publish exclusive topics."""
        exclusive = {topic.name for topic in TOPICS.values() if topic.exclusive}
        publish = [name for name in self.nodes if exclusive & set(self.rows[name].publishes)]
        namespace = node.get_namespace().rstrip("/")
        return node_locks.held(
            node.context.get_domain_id(), [f"{namespace}/{name}" for name in publish], self.run_id
        )

    def _tell_of_world(self) -> None:
        """Note that the policy learnt in another world."""
        learnt, flown = self.policy.scenario, self.scenario
        if learnt.fingerprint != flown.fingerprint:
            self._note(
                f"policy {self.policy.name} learnt in another world ({learnt.name} {learnt.fingerprint}) "
                f"than it flies in ({flown.name} {flown.fingerprint})"
            )

    def _follow(self, supervisor: Supervisor, node: MissionMonitor, executor: DirectExecutor) -> None:
        """Spin until all missions are over, or Ctrl-C.

        Raises:
            NodeError: a node gave up, no step came for too long, or somebody else's mission is flown here.
        """
        self._step_s = time.monotonic()
        check_s = 0.0
        while not (self.interrupted or (node.is_alone and len(self.summaries) >= self.config.missions)):
            tick_s = TICK_S if supervisor.brought_up else BRING_UP_TICK_S
            executor.spin_once(tick_s)
            now_s = time.monotonic()
            if now_s >= check_s:
                check_s = now_s + tick_s
                node.look(supervisor.have_started)
                supervisor.tick(node.is_alone)
                if not node.is_alone:  # patience begins when the mission may
                    self._step_s = now_s
                if node.restarts_of != supervisor.restarts:  # the mission waits for a node that starts again
                    node.restarts_of, self._step_s = supervisor.restarts, now_s
                node.close(LAST_RATES_S)
                self._check_patience(node, now_s)
            time.sleep(min(node.pause_s, tick_s))

    def _check_patience(self, node: MissionMonitor, now_s: float) -> None:
        """Wait for steps that are due, and for nodes that are started here; others may take their time."""
        if not self.is_simulated and self._status is not None:
            return  # the bridge itself sees to it that the mission ends; a pilot may take his time
        patience_s = SILENCE_S + pace.period_s(self.scenario, self.config.factor)
        if now_s - self._step_s <= patience_s:
            return
        if node.mission is not None:
            raise NodeError(f"no step came within {patience_s:.0f} s")
        elsewhere = [name for name in self._peers() if name not in (*self.nodes, "mission_monitor")]
        if not elsewhere:
            raise NodeError(f"the nodes did not find each other within {patience_s:.0f} s")
        self.display.note(f"still waiting for {', '.join(elsewhere)} of another run of run_all")
        self._step_s = now_s

    def _stopped(self, statuses: dict[str, int]) -> int:
        """Tell which nodes did not end as they should; 1 if that spoilt anything: the recorder's bag."""
        odd = {name: code for name, code in statuses.items() if code not in (0, -signal.SIGTERM)}
        for name, code in odd.items():
            self._error(f"node {name} ended with {code} when it was asked to stop")
        return int("recorder" in odd)

    def _hear_the_rest(self, executor: DirectExecutor) -> None:
        """Handle what the nodes said while they were stopped: how a mission ends that was broken off."""
        if len(self.summaries) < self.config.missions:
            deadline_s = time.monotonic() + REST_S
            try:
                executor.spin(lambda: time.monotonic() > deadline_s, REST_QUIET_S)
            except NodeError as error:
                self._error(str(error))

    def _account_for_all(self, node: MissionMonitor) -> None:
        """Every mission that was to be flown has its end: those without one were aborted."""
        node.close()
        flown = len(self.summaries)
        if flown < self.config.missions:
            not_begun = MissionProgress(scenario=self.scenario, mission=flown, seed=self.config.seed + flown)
            now = node.mission or not_begun
            now = now if now.mission == flown else not_begun
            status = self._status
            if status is not None and status.mission == flown:
                now.hear(status)
            if self._why or not now.reason:
                now.reason = self._why or "run_all was interrupted"
            self._on_end(now, Phase.ABORTED)

    def _mend_bag(self) -> int:
        """Make a whole bag of one whose recorder did not close it; 1 if that cannot be."""
        if self.bag is None or not self.bag.is_dir() or (self.bag / "metadata.yaml").is_file():
            return 0
        from uav_dc_ros.bags.salvage.repair import (
            repair,  # slow to import, and rarely needed
        )

        try:
            repaired = repair(self.bag)
        except BagError as error:
            self._error(str(error))
            return 1
        self.display.note(f"the recorder did not close its bag: {repaired}")
        return 0

    def _peers(self) -> list[str]:
        """Nodes that a mission waits for, on whichever host they run."""
        peers = [row.name for row in self.rows.values() if row.needed]
        if not self.config.record:
            peers.remove("recorder")
        if self.is_simulated:
            peers.remove("bridge")
        return peers

    def _parameters(self, folder: Path) -> dict[str, dict[str, object]]:
        """ROS parameters of the nodes to start."""
        config = self.config
        scenario = str(config.scenario)
        if scenario not in scenarios.names():
            scenario = str(Path(scenario).absolute())
        given: dict[str, object] = {
            "scenario": scenario,
            "policy": str(self.policy.folder.absolute()),
            "seed": config.seed,
            "missions": config.missions,
            "pace": pace.text(config.factor),
            "bag": str(self.bag),
            "vehicle": config.vehicle,
            "connect": config.connect or "",
            "system": config.system or 0,
            "arm": config.arm,
            "datum": config.datum or "",
            **({} if config.live is None else {"port": config.live}),
        }
        started = {}
        for name in self.nodes:
            row = self.rows[name]
            values = given | {"journal": str(folder / name)}
            if name == "world" and not self.is_simulated:
                values["vehicle"] = EXTERNAL
            started[name] = {
                "peers": self._peers(),
                "run": self.run_id,
                # A real vehicle's time is that of this machine: nobody publishes another.
                "use_sim_time": self.is_simulated and "clock" not in row.publishes,
                **{one.name: values[one.name] for one in row.parameters if one.name in values},
                **self._settings.get(name, {}),
            }
        return started

    def interrupt(self, *_: object) -> None:
        """Have the run end soon; a signal handler, too."""
        self.interrupted = True

    def _note(self, text: str) -> None:
        self.display.note(text)

    def _error(self, text: str) -> None:
        self.errors.append(text)
        self.display.error(text)

    def _on_status(self, status: Mission) -> None:
        self._status = status
        self.display.vehicle(status)

    def _on_step(self, mission: MissionProgress) -> None:
        self._step_s = time.monotonic()
        self.display.step(mission)

    def _on_end(self, mission: MissionProgress, outcome: Phase) -> None:
        bag = None if self.bag is None else str(self.bag)
        self._aborted |= outcome is Phase.ABORTED
        if outcome is Phase.ABORTED and not (self._why or self.interrupted):
            why = mission.reason or "the vehicle gave no reason"
            self._error(f"mission {mission.mission} was aborted at step {mission.step}: {why}")
        self.summaries.append(summary(mission, outcome, self.scenario, self.policy.name, bag))

    def _tell(self) -> None:
        """Write the summary where it was asked for, and print it."""
        if self.bag is not None and not self.bag.is_dir():  # the recorder never came so far
            self.summaries = [msgspec.structs.replace(mission, bag=None) for mission in self.summaries]
        if self.config.summary is not None:
            told = self.summaries[0] if self.config.missions == 1 else self.summaries
            text = msgspec.json.format(msgspec.json.encode(told), indent=2)
            files.write(Path(self.config.summary), text + b"\n")
        self.display.summary(self.summaries)
