"""When a battery is low: what is counted, what its voltage is, what the autopilot reports."""

import pytest

from uav_dc_ros.offboard.mission.battery import BatteryMonitor
from uav_dc_ros.offboard.vehicle import Telemetry

MIN_CHARGE = 0.2
REST_V = 12.6


def reported(
    charge: float | None, volts: float | None, at_s: float = 100.0, armed: bool = True, fails: bool = False
) -> Telemetry:
    return Telemetry(
        battery=charge, battery_v=volts, battery_fails=fails, armed=armed, vehicle_s=at_s, on_ground=not armed
    )


def in_the_air() -> BatteryMonitor:
    """A battery that was seen at rest, full."""
    battery = BatteryMonitor(MIN_CHARGE)
    assert battery.fault(reported(1.0, REST_V, 0.0, armed=False)) is None
    return battery


def test_a_charge_under_the_minimum_is_low() -> None:
    battery = in_the_air()
    assert battery.fault(reported(0.2, 10.6, 100.0)) is None
    assert battery.fault(reported(0.19, 10.6, 200.0)) == "battery 19% at 10.6 V; expected at least 20%"


def test_one_that_is_counted_empty_at_the_voltage_of_a_full_one_is_not() -> None:
    """As ArduCopter's simulator reports it: 29 A of 3.3 Ah for 18 minutes, 12.3 V all the time."""
    battery = in_the_air()
    for at_s in range(1, 1080):
        assert battery.fault(reported(max(0.0, 1 - at_s * 29.3 / 3600 / 3.3), 12.3, float(at_s))) is None


@pytest.mark.parametrize("cells", [3, 4, 6, 12])
def test_a_real_one_that_is_nearly_empty_is_found_at_any_number_of_cells(cells: int) -> None:
    battery = BatteryMonitor(MIN_CHARGE)
    battery.fault(reported(1.0, 4.15 * cells, 0.0, armed=False))
    for at_s in range(1, 600):  # from 4.0 V to 3.55 V a cell, under load
        share = at_s / 600
        low = battery.fault(reported(1.0 - share, (4.0 - 0.45 * share) * cells, float(at_s)))
        assert (low is None) == (1.0 - share >= MIN_CHARGE), at_s


def test_a_dip_of_the_voltage_is_not_the_end() -> None:
    battery = in_the_air()
    for tenth in range(600):
        volts = 10.9 if 300 <= tenth < 305 else 12.3
        assert battery.fault(reported(0.1, volts, 1.0 + tenth / 10)) is None


def test_without_a_voltage_at_rest_the_charge_decides() -> None:
    assert (
        BatteryMonitor(MIN_CHARGE).fault(reported(0.1, 12.3))
        == "battery 10% at 12.3 V; expected at least 20%"
    )


def test_no_take_off_with_one_that_is_counted_empty() -> None:
    assert "battery 10%" in str(in_the_air().fault(reported(0.1, REST_V, armed=False)))


def test_the_autopilot_is_believed_where_it_counts_nothing_or_agrees() -> None:
    battery = in_the_air()
    assert battery.fault(reported(None, 12.3)) is None
    assert "battery 10%" in str(battery.fault(reported(0.1, 12.3, fails=True)))
    assert "battery 10%" in str(BatteryMonitor(MIN_CHARGE).fault(reported(0.1, None)))


@pytest.mark.parametrize(("charge", "counted"), [(0.9, "battery 90%"), (None, "battery")])
def test_one_that_the_autopilot_finds_low_or_broken_is_low_whatever_is_counted(
    charge: float | None, counted: str
) -> None:
    battery = in_the_air()
    for tenth in range(50):
        assert battery.fault(reported(charge, 11.0, 100.0 + tenth / 10, fails=True)) is None, "not at once"
    why = f"{counted} at 11.0 V, 12.6 V at rest: the autopilot reports it low or broken"
    assert battery.fault(reported(charge, 11.0, 105.0, fails=True)) == why
    assert battery.fault(reported(charge, 11.0, 106.0)) is None
    assert battery.fault(reported(charge, 11.0, 107.0, fails=True)) is None, "again not at once"


def test_low_voltage_under_load_is_low_whatever_is_counted() -> None:
    """As ArduCopter was flown: 9.0 V of 12.6 V at rest, with 60 % counted."""
    battery = in_the_air()
    assert battery.fault(reported(0.6, 12.3, 100.0)) is None
    found = {at_s: battery.fault(reported(0.6, 9.0, float(at_s))) for at_s in range(101, 140)}
    assert found[103] is None, "a sag"
    first = next(at_s for at_s, why in found.items() if why is not None)
    assert first < 115
    assert found[139] == "battery 60% at 9.1 V under load, 12.6 V at rest; expected 80% of that"


@pytest.mark.parametrize("long_s", [1, 3, 6])
def test_a_sag_of_the_voltage_is_not_the_end_whatever_is_counted(long_s: int) -> None:
    battery = in_the_air()
    for tenth in range(600):
        volts = 9.5 if 300 <= tenth < 300 + 10 * long_s else 12.0
        assert battery.fault(reported(0.8, volts, 1.0 + tenth / 10)) is None


def test_one_wrong_measurement_on_the_ground_is_not_what_it_has_at_rest() -> None:
    battery = in_the_air()
    battery.fault(reported(1.0, 30.0, 10.0, armed=False))
    for tenth in range(1, 600):
        battery.fault(reported(1.0, REST_V, 10.0 + tenth / 10, armed=False))
    assert battery.at_rest_v == pytest.approx(REST_V, abs=0.1)
