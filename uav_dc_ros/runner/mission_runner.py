"""One run of run_all: check the options, start the nodes, follow the missions, stop the nodes, report."""

import signal
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, cast

import msgspec
from rclpy.context import Context

from uav_dc_ros import cli, files, scenarios
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.core import pace
from uav_dc_ros.errors import BagError, NodeError
from uav_dc_ros.messages import Mission, Phase, new_run
from uav_dc_ros.mission_summary import Summary
from uav_dc_ros.nodes.framework.node_table import mission_rows
from uav_dc_ros.nodes.framework.other_publishers import AnotherMissionError
from uav_dc_ros.nodes.framework.parameters import ADDRESS, EXTERNAL
from uav_dc_ros.nodes.ros.executor import DirectExecutor, shut_down
from uav_dc_ros.run_config import RunConfig
from uav_dc_ros.runner import node_locks, run_options, web_page
from uav_dc_ros.runner.monitor import MissionMonitor, MonitoredMission
from uav_dc_ros.runner.supervisor import Supervisor
from uav_dc_ros.runner.web_page import WebPage
from uav_dc_ros.runner.working_folder import working_folder
from uav_dc_ros.topics import SIMULATED, TOPICS

if TYPE_CHECKING:
    from uav_dc_ros.runner.console import MissionConsole

RECORDER = "recorder"
STEP_TIMEOUT_S = 30.0  # for the discovery of the nodes, and for a due step
LAST_RATES_S = 5.0  # longest wait for the rates of a mission's last step: their node may be restarting
# Longest wait at the end for a recorder that is being restarted: on a busy computer it takes half a minute.
RECORDER_S = 60.0
FINAL_S, FINAL_QUIET_S = 2.0, 0.2  # longest wait for the nodes' last messages, and for the next one
RESEND_S = 1.0  # for lost messages from other hosts, which are sent again ten times a second
TICK_S = 0.02  # period of checks of the nodes
BRING_UP_TICK_S = 0.004  # until all are active: each transition takes a check
SHUTDOWN_S = 3.0  # for the middleware


class Network:
    """Context, node and executor of the mission monitor; `create` makes the node."""

    def __init__(self, namespace: str, create: Callable[[Context], MissionMonitor]) -> None:
        self._context = Context()
        self._context.init(["--ros-args", "-r", f"__ns:={namespace}", "-r", "/clock:=clock"])
        self.node = create(self._context)
        self.executor = DirectExecutor(self.node.pause_s, self._context)
        self.executor.add_node(self.node)
        self._has_left = False

    def leave(self) -> None:
        """Leave the network, once, so that other nodes do not wait for this one."""
        if not self._has_left:
            self._has_left = True
            self.node.trigger_shutdown()
            nodes = [self.node]
            del self.node, self.executor
            shut_down(self._context, SHUTDOWN_S, nodes)


class MissionRunner:
    """A run of missions. Raises UavDcError before anything is started or written if it cannot be flown."""

    def __init__(self, config: RunConfig, *, show: bool = True) -> None:
        self.config = config
        self.scenario = scenarios.load(config.scenario)
        self.agent = agents.load(config.policy or f"{self.scenario.name}_dueling", config.search)
        self.weight = run_options.weight(config, self.agent)
        self.search_time_limit_s = run_options.search_time_limit_s(config, self.scenario)
        self.agent.act_in(self.scenario, self.weight)  # raises UavDcError where it does not fit
        self.is_simulated = config.vehicle == SIMULATED
        if self.is_simulated:
            pace.check(self.scenario, config.factor, config.missions)
        self.rows = mission_rows(() if self.is_simulated else ("bridge",))
        self.nodes = run_options.nodes(config)
        # The host of the vehicle creates the run's identity; a run_all on another host adopts it.
        self.run_id = new_run() if ("world" if self.is_simulated else "bridge") in self.nodes else ""
        self.composed = run_options.composed(config, self.nodes)
        self._settings = run_options.settings(config, self.nodes)
        run_options.check_vehicle(config, self.nodes, self.scenario)
        if config.live is not None:
            from uav_dc_ros.nodes.view import foxglove_server  # imports rosbags

            foxglove_server.check(address=str(ADDRESS.default), port=config.live)
        self._page: WebPage | None = None
        if config.view is not None:
            self._page = WebPage(config.view, self._settings.get(web_page.NODE, {}))
        bag = None if config.bag is None else Path(config.bag)
        self.bag = run_options.new_bag(bag) if "recorder" in self.nodes else None
        if config.summary is not None:
            run_options.check_summary(Path(config.summary), self.bag)
        self._show, self._console = show, cast("MissionConsole | None", None)
        self._console_lock = threading.Lock()
        self.summaries: list[Summary] = []  # of the missions that are over
        self.errors: list[str] = []  # that were printed
        self.interrupted = self._aborted = False
        self._abort_reason = ""  # of the whole run
        self._recorder_is_behind = False  # at the end: the bag lacks messages
        self.bag_lacks = ""  # which; empty: none that is known
        self._step_s = 0.0  # time of the last step, monotonic clock
        self._status: Mission | None = None  # last message of the vehicle

    @property
    def console(self) -> "MissionConsole":
        """The display; created on first use, while the nodes start."""
        with self._console_lock:
            if self._console is None:
                from uav_dc_ros.runner.console import MissionConsole

                self._console = MissionConsole(self.scenario, self.config.missions, show=self._show)
            return self._console

    def run(self) -> int:
        """Fly, in a ROS context of its own and without signal handlers; returns the command's exit status."""
        status, view = 0, None
        with working_folder() as folder, ExitStack() as stack:
            network = Network(self.config.namespace, self._create_monitor)
            stack.callback(network.leave)
            namespace, parameters = network.node.get_namespace(), self._parameters(folder)
            network.node.trigger_configure()
            network.node.trigger_activate()  # discovery runs while the nodes start
            on_line: Callable[[str, str], None] = lambda node, line: self.console.line(node, line)  # noqa: E731
            supervisor = Supervisor(namespace, parameters, self.composed, folder, on_line, self._note)
            stack.enter_context(supervisor)
            stack.enter_context(self.console)
            try:
                stack.enter_context(self._locks(network.node))
                self._note_other_world()
                self._follow(supervisor, network.node, network.executor)
                self._wait_for_recorder(supervisor, network.executor)
            except NodeError as error:
                self._abort_reason = str(error)
                self._error(self._abort_reason)
                status = 1
                if isinstance(error, AnotherMissionError):  # received messages may belong to it
                    self.summaries.clear()
                    network.node.mission = self._status = None
            is_complete = self._is_complete
            if is_complete and self._elsewhere():
                time.sleep(RESEND_S)  # what the monitor has received, the recorder may not yet have
            if self._page is not None and web_page.is_attended() and self._show and not self.interrupted:
                view = supervisor.release(web_page.NODE)
            # An error that ended the run may be the recorder's own, and is printed already.
            self._recorder_is_behind = not self._abort_reason and supervisor.is_catching_up(RECORDER)
            exits = supervisor.stop(network.leave if is_complete else lambda: None)
            status = max(status, self._check_exits(exits))
            if not is_complete:
                self._complete_summaries(network.node, network.executor)
        status = max(status, self._repair_bag(), int(self._aborted))
        if self._recorder_is_behind:
            status = max(status, self._report_lacking_bag())
        self._write_summary()
        status = cli.INTERRUPTED if self.interrupted else status
        if self._page is not None and view is not None:
            self._note(f"the page stays at {self._page.url} until Ctrl-C")
            self._page.keep(view, lambda: self.interrupted)
        return status

    def _create_monitor(self, context: Context) -> MissionMonitor:
        seed = self.config.seed if "world" in self.nodes else None
        return MissionMonitor(
            *(self.scenario, seed, self.run_id, self._peers(), self.nodes),
            *(self._on_status, self._on_step, self._on_end, self._note, context),
        )

    def _locks(self, node: MissionMonitor) -> AbstractContextManager[None]:
        """Locks of the nodes that publish exclusive topics."""
        exclusive = {topic.name for topic in TOPICS.values() if topic.exclusive}
        namespace = node.get_namespace().rstrip("/")
        names = [f"{namespace}/{name}" for name in self.nodes if exclusive & set(self.rows[name].publishes)]
        return node_locks.held(node.context.get_domain_id(), names, self.run_id)

    def _note_other_world(self) -> None:
        trained, flown = self.agent.home, self.scenario
        if self.agent.for_any_field or trained is None:
            return
        if trained.fingerprint != flown.fingerprint:
            self._note(
                f"policy {self.agent.name} was trained in another world ({trained.name} "
                f"{trained.fingerprint}) than it flies in ({flown.name} {flown.fingerprint})"
            )

    def _follow(self, supervisor: Supervisor, node: MissionMonitor, executor: DirectExecutor) -> None:
        """Spin until all missions are over, or the run is interrupted."""
        self._step_s = time.monotonic()
        check_s, is_page_open = 0.0, False
        while not (self.interrupted or (node.is_alone and self._is_complete)):
            tick_s = TICK_S if supervisor.brought_up else BRING_UP_TICK_S
            executor.spin_once(tick_s)
            now_s = time.monotonic()
            if now_s >= check_s:
                check_s = now_s + tick_s
                node.check_publishers(supervisor.have_started)
                supervisor.tick(node.is_alone)
                if supervisor.brought_up and self._page is not None and not is_page_open:
                    is_page_open = True
                    self._page.open_browser()
                # The timeout of a step starts when the mission may begin, and with each restart of a node.
                if not node.is_alone or node.restarts_of != supervisor.restarts:
                    node.restarts_of, self._step_s = supervisor.restarts, now_s
                node.report_ends(LAST_RATES_S)
                self._check_timeout(node, now_s)
            time.sleep(min(node.pause_s, tick_s))

    def _wait_for_recorder(self, supervisor: Supervisor, executor: DirectExecutor) -> None:
        """Let a recorder that is being restarted receive the end of the missions: the nodes latch it."""
        deadline_s = time.monotonic() + RECORDER_S
        while supervisor.is_catching_up(RECORDER) and not self.interrupted:
            if time.monotonic() > deadline_s:
                return
            executor.spin_once(TICK_S)
            supervisor.tick(may_bring_up=True)
            time.sleep(TICK_S)

    @property
    def _is_complete(self) -> bool:
        """Whether no mission follows: all are over, or one was aborted, by a service call for example."""
        return self._aborted or len(self.summaries) >= self.config.missions

    def _check_timeout(self, node: MissionMonitor, now_s: float) -> None:
        """Check the time since the last step; nodes of another run_all have no timeout."""
        if not self.is_simulated and self._status is not None:
            return  # the bridge has its own timeouts, and a pilot none
        if node.mission is None and self._settings.get("world", {}).get("wait_for_start"):
            return  # for the service
        timeout_s = STEP_TIMEOUT_S + pace.period_s(self.scenario, self.config.factor)
        if now_s - self._step_s <= timeout_s:
            return
        if node.mission is not None:
            raise NodeError(f"no step came within {timeout_s:.0f} s")
        elsewhere = self._elsewhere()
        if not elsewhere:
            raise NodeError(f"the nodes did not find each other within {timeout_s:.0f} s")
        self._note(f"still waiting for {', '.join(elsewhere)} of another run of run_all")
        self._step_s = now_s

    def _check_exits(self, statuses: dict[str, int]) -> int:
        """Report nodes that did not stop as requested; returns 1 if the recorder is one of them."""
        failed = {name: code for name, code in statuses.items() if code not in (0, -signal.SIGTERM)}
        for name, code in failed.items():
            self._error(f"node {name} ended with {code} when it was stopped")
        return int("recorder" in failed)

    def _complete_summaries(self, node: MissionMonitor, executor: DirectExecutor) -> None:
        """Report the end of the current mission; without one it was aborted."""
        deadline_s = time.monotonic() + FINAL_S
        try:  # the nodes may have published it while they were stopped
            executor.spin(lambda: time.monotonic() > deadline_s, FINAL_QUIET_S)
        except NodeError as error:
            self._error(str(error))
        node.report_ends()
        index = len(self.summaries)
        if index >= self.config.missions:
            return
        mission = node.mission
        if mission is None or mission.index != index:
            mission = MonitoredMission(index=index, seed=self.config.seed + index)
        if self._status is not None and self._status.mission == index:
            mission.add_without_rates(self._status)
        if self._abort_reason or not mission.reason:
            mission.reason = self._abort_reason or "run_all was interrupted"
        mission.outcome = Phase.ABORTED.value
        self._on_end(mission)

    def _repair_bag(self) -> int:
        """Repair a bag that the recorder did not close; returns 1 if that fails."""
        if self.bag is None or not self.bag.is_dir() or (self.bag / "metadata.yaml").is_file():
            return 0
        from uav_dc_ros.bags.salvage.repair import repair  # slow to import, and rarely needed

        try:
            repaired = repair(self.bag)
        except BagError as error:
            self._error(str(error))
            return 1
        self._note(f"the recorder did not close its bag: {repaired}")
        return 0

    def _report_lacking_bag(self) -> int:
        """Report what the bag lacks, since its recorder was still being restarted; returns 1."""
        assert self.bag is not None
        from uav_dc_ros.runner.last_recorded import last_recorded  # slow to import, and rarely needed

        try:
            last = last_recorded(self.bag, self.config.namespace)
        except BagError as error:
            self._error(str(error))
            last = "an unknown step"
        why = "when it was interrupted" if self.interrupted else f"after {RECORDER_S:g} s"
        self.bag_lacks = f"the messages after {last}: the recorder had not caught up {why}"
        self._error(f"the bag {self.bag} lacks {self.bag_lacks}")
        return 1

    def _elsewhere(self) -> list[str]:
        """Peers that are started elsewhere."""
        return [name for name in self._peers() if name not in (*self.nodes, "mission_monitor")]

    def _peers(self) -> list[str]:
        """Nodes that a mission requires, on any host."""
        peers = [row.name for row in self.rows.values() if row.needed]
        if not self.config.record:
            peers.remove("recorder")
        if self.is_simulated:
            peers.remove("bridge")
        return peers

    def _parameters(self, folder: Path) -> dict[str, dict[str, object]]:
        """ROS parameters of the nodes to start."""
        config = self.config
        values: dict[str, object] = {
            "scenario": scenarios.from_anywhere(config.scenario),
            "policy": self.agent.argument,
            "objective_weight": self.weight,
            "search": config.search,
            "search_time_limit_s": self.search_time_limit_s,
            "seed": config.seed,
            "missions": config.missions,
            "pace": pace.text(config.factor),
            "bag": str(self.bag),
            "vehicle": config.vehicle,
            "connect": config.connect or "",
            "system": config.system or 0,
            "arm": config.arm,
            "datum": config.datum or "",
            "upload_fence": config.upload_fence,
        }
        if config.live is not None:
            values["port"] = config.live
        parameters = {}
        for name in self.nodes:
            row = self.rows[name]
            given = values | {"journal": str(folder / name)}
            own = {one.name: given[one.name] for one in row.parameters if one.name in given}
            if name == "world" and not self.is_simulated:
                own["vehicle"] = EXTERNAL
            parameters[name] = {
                "peers": self._peers(),
                "run": self.run_id,
                # No node publishes a clock beside a real vehicle.
                "use_sim_time": self.is_simulated and "clock" not in row.publishes,
                **own,
                **self._settings.get(name, {}),
                **(self._page.parameters if self._page is not None and name == web_page.NODE else {}),
            }
        return parameters

    def interrupt(self, *_: object) -> None:
        """Stop the run soon; also a signal handler."""
        self.interrupted = True

    def _note(self, text: str) -> None:
        self.console.line("note", text)

    def _error(self, text: str) -> None:
        self.errors.append(text)
        self.console.error(text)

    def _on_status(self, status: Mission) -> None:
        self._status = status
        self.console.vehicle(status)

    def _on_step(self, mission: MonitoredMission) -> None:
        self._step_s = time.monotonic()
        self.console.step(mission)

    def _on_end(self, mission: MonitoredMission) -> None:
        bag = None if self.bag is None else str(self.bag)
        if mission.outcome == Phase.ABORTED.value:
            self._aborted = True
            if not (self._abort_reason or self.interrupted):
                reason = mission.reason or "the vehicle gave no reason"
                self._error(f"mission {mission.index} was aborted at step {mission.steps}: {reason}")
        self.summaries.append(mission.summary(self.scenario, self.agent.name, bag))

    def _write_summary(self) -> None:
        """Write the summary to its file, if there is one, and print it."""
        if self.bag is not None and not self.bag.is_dir():  # the recorder did not create it
            self.summaries = [msgspec.structs.replace(mission, bag=None) for mission in self.summaries]
        if self.bag_lacks:
            self.summaries = [
                msgspec.structs.replace(mission, bag_lacks=self.bag_lacks) for mission in self.summaries
            ]
        if self.config.summary is not None:
            content = self.summaries[0] if self.config.missions == 1 else self.summaries
            text = msgspec.json.format(msgspec.json.encode(content), indent=2)
            files.write(Path(self.config.summary), text + b"\n")
        self.console.summary(self.summaries)
