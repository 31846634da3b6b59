"""The bridge's node in this process, beside a vehicle whose telemetry a test says."""

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger

from tests.conftest import Ros
from tests.support.fake_autopilot.mavros_flight import node_in
from uav_dc_ros import cdr, messages
from uav_dc_ros.core.grid import Action
from uav_dc_ros.errors import VehicleError
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes import bridge, vehicles
from uav_dc_ros.nodes.bridge import AutopilotBridge
from uav_dc_ros.nodes.framework.journal import Journal
from uav_dc_ros.offboard import datums
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.offboard.ground_station import Severity, StatusText
from uav_dc_ros.offboard.mavlink.connection import Address
from uav_dc_ros.offboard.mavlink.vehicle import MavlinkVehicle
from uav_dc_ros.offboard.mission.controller import MissionController
from uav_dc_ros.offboard.vehicle import Command, Mode, SetMode, Telemetry

DATUM = Geodetic(latitude_deg=47.4, longitude_deg=8.5, altitude_m=400.0)
FLIES = Telemetry(
    position=Enu(0.0, 0.0, 100.0),
    estimate_ok=True,
    armed=True,
    on_ground=False,
    mode=Mode.COMMANDED,
    mode_name="GUIDED",
)


class Stub:
    """A vehicle without a link."""

    def __init__(self) -> None:
        self.known, self.datum = FLIES, None
        self.asked: list[Command] = []
        self.setpoints: list[Enu | None] = []
        self.opened = self.closed = 0
        self.broken = ""

    def open(self) -> None:
        self.opened += 1
        if self.broken == "open":
            raise VehicleError("no such link")

    def telemetry(self) -> Telemetry:
        if self.broken == "telemetry":
            raise VehicleError("the link is gone for good")
        now_s = time.monotonic()
        grid = {"datum": self.datum, "grid_origin": str(self.datum or "")}
        return replace(self.known, heartbeat_s=now_s, position_s=now_s, **grid)  # type: ignore[arg-type]

    def set_setpoint(self, setpoint: Enu | None) -> None:
        self.setpoints.append(setpoint)

    def send_command(self, command: Command) -> None:
        self.asked.append(command)

    def close(self) -> None:
        self.closed += 1


class Made:
    """The node, its vehicle, and what it publishes as `mission`."""

    def __init__(self, node: AutopilotBridge, vehicle: Stub) -> None:
        self.node, self.vehicle = node, vehicle

    def until(self, done: Callable[[], object]) -> None:
        for _ in range(2000):
            if done():
                return
            self.node.spin_once(0.005)
        raise AssertionError("this never came to be")

    @property
    def values(self) -> dict[str, str]:
        """Its diagnostics."""
        return self.node.diagnose()[1]


@pytest.fixture
def made(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> Iterator[Made]:
    """A bridge that waits for a lifecycle manager, with nobody else to wait for."""
    vehicle = Stub()
    monkeypatch.setattr(vehicles, "make", lambda *_: vehicle)
    monkeypatch.setattr(bridge, "use_realtime_priority", lambda: None)
    monkeypatch.setenv("XDG_STATE_HOME", str(ros.folder / "state"))
    with node_in(ros, "-p", "connect:=tcp:127.0.0.1:1", "-p", "peers:=[bridge]") as (_, executor):
        node = AutopilotBridge()
        node.spin_once = executor.spin_once
        executor.add_node(node)
        yield Made(node, vehicle)
        if node.state != "finalized":
            node.trigger_shutdown()
        node.destroy_node()


def kill(node: AutopilotBridge) -> None:
    """As SIGKILL: nothing is saved or published any more."""
    node._until_inactive.close()
    time.sleep(0.01)  # the executor reads the node's subscriptions anew after 3 ms


def activate(made: Made) -> None:
    """Bring it up."""
    made.node.trigger_configure()
    made.node.trigger_activate()
    assert made.node.state == "active"


def test_the_vehicle_is_seen_obeying_while_the_bridge_stops(made: Made) -> None:
    """The mode comes as a message, which somebody has to take meanwhile: as with MAVROS and PX4."""
    node, vehicle = made.node, made.vehicle
    vehicle.datum = DATUM
    activate(made)
    made.until(lambda: node._started)
    node.bridge.phase = Phase.READY
    publisher = node.create_publisher(String, "mode", 1)

    def obey(message: String) -> None:
        vehicle.known = replace(FLIES, mode=Mode(message.data))

    node.create_subscription(String, "mode", obey, 1)
    made.until(lambda: publisher.get_subscription_count() == 1)
    made.vehicle.send_command = lambda command: publisher.publish(String(data=command.mode))  # type: ignore[method-assign]
    node.trigger_deactivate()
    assert node._telemetry.mode is Mode.RETURN
    assert node.bridge.can_be_released(node._telemetry)
    assert vehicle.closed == 1


@pytest.mark.parametrize("broken", ["", "telemetry"])
def test_what_was_opened_is_closed_once(made: Made, broken: str) -> None:
    activate(made)
    made.until(lambda: made.node._started)
    made.vehicle.broken = broken
    made.node.trigger_deactivate()
    assert (made.node.state, made.vehicle.opened, made.vehicle.closed) == ("inactive", 1, 1)
    made.node.trigger_shutdown()
    assert made.vehicle.closed == 1


def test_what_fails_to_start_is_closed(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    made.vehicle.broken = "open"
    made.node.trigger_configure()
    made.node.trigger_activate()
    assert (made.node.state, made.vehicle.closed) == ("inactive", 1)
    made.vehicle.broken = ""

    def refuse(*_: Any) -> None:
        raise VehicleError("after it was opened")

    with monkeypatch.context() as patch:
        patch.setattr(made.node, "_reject_unknown", refuse)
        made.node.trigger_activate()
    assert (made.node.state, made.vehicle.opened, made.vehicle.closed) == ("inactive", 2, 2)
    made.node.trigger_activate()
    assert (made.node.state, made.vehicle.opened, made.vehicle.closed) == ("active", 3, 2)


def test_who_else_is_there_and_what_was_ignored_is_in_the_diagnostics(made: Made) -> None:
    made.vehicle.known = Telemetry(
        system="system 7", other_controller="system 255 sends setpoints", discarded={"late": 2, "repeated": 1}
    )
    activate(made)
    made.until(lambda: made.node.bridge.is_over)
    warnings, values = made.node.diagnose()
    assert "another system commands this vehicle: system 255 sends setpoints" in warnings
    expected = {
        "system": "system 7",
        "other controller": "system 255 sends setpoints",
        "discarded: late": "2",
        "discarded: repeated": "1",
    }
    assert expected.items() <= values.items()


def test_where_the_grid_lies_is_logged_and_kept_when_the_vehicle_takes_off(made: Made) -> None:
    activate(made)
    made.vehicle.known = Telemetry()
    made.until(lambda: made.node._started)
    assert made.values["grid"] == ""
    made.vehicle.datum = DATUM
    made.until(lambda: made.values["grid"] == str(DATUM))
    assert datums.last(made.node.scenario) is None, "nothing has flown yet"
    made.node.bridge.phase = Phase.TAKEOFF
    made.node._on_change()
    kept = datums.last(made.node.scenario)
    assert kept is not None
    assert (kept.datum, kept.vehicle) == (str(DATUM), "mavlink")


@pytest.mark.parametrize("flies", [False, True])
def test_the_journal_keeps_which_vehicle_flies(
    made: Made, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, flies: bool
) -> None:
    """One that was only met, on the ground, need not be the one that is meant."""
    given: list[Any] = []

    def make(*values: Any) -> Stub:
        given.append(values[5])
        return made.vehicle

    monkeypatch.setattr(vehicles, "make", make)
    node, made.vehicle.datum = made.node, DATUM
    made.vehicle.known = replace(FLIES, system_id=7, armed=flies)
    node.trigger_configure()
    node.journal = Journal(str(tmp_path / "journal"))
    node.trigger_activate()
    made.until(lambda: node._started)
    node.bridge.phase = Phase.READY if flies else Phase.PREFLIGHT
    node._on_change()
    kill(node)
    node.bridge.phase = Phase.ABORTED
    node.trigger_deactivate()
    node.trigger_activate()
    assert given == [None, 7 if flies else None]


def test_a_bridge_that_was_killed_before_it_knew_where_the_grid_lies_goes_by_the_datum_that_was_given(
    made: Made, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Behind MAVROS that takes a fix; the grid must not lie under the vehicle because of a restart."""
    given: list[Any] = []
    restarted: list[bool] = []

    def make(*values: Any) -> Stub:
        given.append(values[3:5])
        restarted.append(values[6])
        return made.vehicle

    monkeypatch.setattr(vehicles, "make", make)
    node, made.vehicle.known = made.node, Telemetry()
    node.trigger_configure()
    node.journal, node.values["datum"] = Journal(str(tmp_path / "journal")), str(DATUM)
    node.trigger_activate()
    made.until(lambda: node._started)
    assert made.values["phase"] == "connecting"
    for _ in range(2):
        kill(node)
        node.bridge.phase = Phase.ABORTED
        node.trigger_deactivate()
        node.trigger_activate()
        made.vehicle.datum = DATUM  # by the next time, it has taken off
        made.until(lambda: node._telemetry.datum == DATUM)
        node._on_change()
    assert given == [(DATUM, ""), (DATUM, ""), (None, str(DATUM))]
    assert restarted == [False, True, True], "the graph still tells of the one that was killed"


def test_a_position_that_cannot_be_true_is_not_published(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """The users' data would be that of a place where the vehicle was not."""
    activate(made)
    said: list[float] = []
    publish = made.node.publish

    def note(name: str, message: Any) -> None:
        if name == "pose":
            said.append(float(cdr.Pose(message).position_m[0]))
        publish(name, message)

    monkeypatch.setattr(made.node, "publish", note)
    made.until(lambda: len(said) > 3)
    made.vehicle.known = replace(FLIES, position=Enu(400.0, 0.0, 100.0))
    made.until(lambda: made.node.bridge.detector.discarded.get("impossible position", 0) > 3)
    made.vehicle.known = replace(FLIES, position=Enu(1.0, 0.0, 100.0))
    made.until(lambda: said[-1] == 1.0)
    assert set(said) == {0.0, 1.0}


def test_steps_that_were_not_reached_are_told(made: Made) -> None:
    activate(made)
    made.node.bridge.progress.steps_not_reached = 3
    made.node._publish_mission()
    assert isinstance(made.node._status, messages.Mission)
    assert made.node._status.steps_not_reached == 3


def open_files() -> set[str]:
    """What this process has open, but for what the middleware opens and closes by itself."""
    links = (os.readlink(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd") if _is_open(name))
    return {link for link in links if link.startswith("pipe:")}


def _is_open(name: str) -> bool:
    return os.path.islink(f"/proc/self/fd/{name}")


def test_a_transport_is_closed_whatever_became_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before it was opened, after the link could not be opened at all, and a second time."""
    before = open_files()
    for opened in (False, True):
        vehicle = MavlinkVehicle("tcp:127.0.0.1:1")
        with monkeypatch.context() as patch:
            if opened:
                patch.setattr(Address, "open", refuse_link)
                vehicle.open()
                vehicle._thread.join()
                with pytest.raises(VehicleError, match="no such device"):
                    vehicle.telemetry()
            vehicle.close()
            vehicle.close()
    assert open_files() == before


def refuse_link(address: Address) -> None:
    raise VehicleError("no such device")


def call(made: Made, service: str) -> tuple[bool, str]:
    """Call a service over ROS."""
    client = made.node.create_client(Trigger, service)
    made.until(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    made.until(future.done)
    made.node.destroy_client(client)
    return future.result().success, future.result().message


@pytest.mark.parametrize("service", ["stop", "abort"])
def test_a_service_ends_the_mission_as_ctrl_c_does_and_the_landing_is_monitored(
    made: Made, service: str
) -> None:
    activate(made)
    made.until(lambda: made.node._started)
    assert call(made, service) == (
        True,
        f"landing: {'stopped' if service == 'stop' else 'aborted'} by a service call",
    )
    made.until(lambda: SetMode(Mode.RETURN) in made.vehicle.asked)
    assert call(made, service)[0], "once more changes nothing"
    made.vehicle.known = replace(FLIES, mode=Mode.RETURN, mode_name="RTL")
    made.until(lambda: made.node.bridge.can_be_released(made.node._telemetry))
    made.vehicle.known = replace(FLIES, mode=Mode.RETURN, armed=False, on_ground=True)
    made.until(lambda: made.node.bridge.phase is Phase.ABORTED)
    success, text = call(made, service)
    assert not success
    assert text.startswith("the mission is over (aborted: ")


def test_a_pilot_s_vehicle_is_left_alone_by_the_services(made: Made) -> None:
    made.vehicle.known = replace(FLIES, mode=Mode.OTHER, mode_name="LOITER")
    activate(made)
    assert call(made, "abort") == (True, "aborted: aborted by a service call")
    made.until(lambda: made.vehicle.setpoints)
    assert made.vehicle.asked == []
    assert set(made.vehicle.setpoints) == {None}


def test_stop_completes_the_move_in_progress_also_after_a_restart(made: Made, tmp_path: Path) -> None:
    made.node.set_parameters([Parameter("journal", value=str(tmp_path / "journal"))])
    activate(made)
    made.until(lambda: made.node.bridge.phase is Phase.TAKEOFF)
    bridge = made.node.bridge
    bridge.phase = Phase.READY
    assert bridge.move(0, Action.RIGHT) is None
    assert call(made, "stop") == (True, f"moving: {bridge.reason}")
    assert made.vehicle.asked == []
    checkpoint = bridge.checkpoint
    assert checkpoint.stop_reason == "stopped by a service call"
    again = MissionController(made.node.scenario, made.node.settings, checkpoint=checkpoint)
    assert again.checkpoint.stop_reason == checkpoint.stop_reason
    for controller in (bridge, again):
        controller.phase = Phase.READY
        assert "the mission ends" in str(controller.move(controller.step, Action.HOVER))
        controller.tick(time.monotonic(), made.vehicle.telemetry())
        assert (controller.phase, controller.reason) == (Phase.LANDING, "stopped by a service call")


def test_a_mission_waits_for_the_service_start(made: Made) -> None:
    made.node.set_parameters([Parameter("wait_for_start", value=True)])
    activate(made)
    made.until(lambda: made.node.all_ready)
    made.until(lambda: "the service start" in made.node._status.reason)
    assert made.node.bridge.phase is Phase.IDLE
    assert call(made, "start") == (True, "the mission begins")
    made.until(lambda: made.node.bridge.phase is not Phase.IDLE)
    assert not call(made, "start")[0]


def test_ground_stations_are_shown_the_mission_and_its_rates(made: Made) -> None:
    texts: list[StatusText] = []
    values: list[Any] = []
    made.vehicle.report_text = texts.append  # type: ignore[attr-defined]
    made.vehicle.report_values = values.append  # type: ignore[attr-defined]
    activate(made)
    made.until(lambda: made.node.bridge.phase is Phase.TAKEOFF)
    assert texts[-1].severity is Severity.NOTICE
    assert texts[-1].text.startswith("uav_dc takeoff: in the air when the bridge started")
    n = made.node.scenario.n_users
    columns = {name: [0.0] * n for name in ("sinr", "rate_bps", "data_bits")}
    collected = [True] * 3 + [False] * (n - 3)
    rates = messages.Rates(
        mission=0, step=0, sum_rate_bps=2.5e6, served=[True] * n, collected=collected, **columns
    )
    made.node.on_rates(rates)
    assert values == [{"collected": 3.0, "rate_mbps": 2.5}]
