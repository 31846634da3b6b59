"""The MAVROS transport, with standard messages over DDS: a fake MAVROS in a process of its own."""

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import rclpy

from tests.conftest import Ros
from tests.nodes.mavros_flight import SCENARIO, START, Flight, fake, node_in, spin
from uav_dc_ros.autopilot.frames import Enu
from uav_dc_ros.autopilot.vehicle import Mode, SetMode, Telemetry
from uav_dc_ros.autopilot.watch import Settings
from uav_dc_ros.errors import VehicleError
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.executor import DirectExecutor
from uav_dc_ros.nodes.mavros import Mavros

STANDS = "-7,11,3"  # where the copter stands in MAVROS's frame: east, north, up


def test_px4_flies_a_mission_that_a_pilot_starts_and_lands(ros: Ros) -> None:
    with fake(ros, "px4", "--speed", "5", "--stands=" + STANDS) as mavros, node_in(ros) as (node, executor):
        vehicle = Mavros(node, place=START)
        vehicle.open()
        flight = Flight(executor, vehicle, mavros, Settings())
        bridge = flight.bridge
        flight.until(lambda: bridge.phase is Phase.PREFLIGHT)
        assert vehicle.kind == "PX4"
        assert vehicle.anchor == "27.0,-11.0,-3.0"
        mavros.do("arm")
        flight.until(lambda: vehicle.telemetry().armed)
        flight.until(lambda: bridge.reason == "a pilot flies: mode POSCTL")
        flight.pilot_sets("OFFBOARD")
        flight.until(lambda: bridge.phase is Phase.LANDING)
        assert flight.cells == [(2, 0, 0), (2, 1, 0), (2, 1, 0)]
        assert mavros.report()["enu"] == pytest.approx((13.0, 31.0, 13.0), abs=2.0), "the dock, in its frame"
        flight.until(lambda: vehicle.telemetry().refusal is not None)
        assert "a pilot has to set AUTO.LAND" in str(vehicle.telemetry().refusal)
        mavros.do("mode AUTO.LAND")
        flight.until(lambda: bridge.is_over)
        assert bridge.phase is Phase.LANDED
        report = mavros.report()
        assert (report["landed"], report["armed"]) == (True, False)
        vehicle.close()
    print(flight.log)
