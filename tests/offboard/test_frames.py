"""Frames, in numbers that were worked out by hand: a mistake in a sign fails here."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uav_dc_ros.errors import VehicleError
from uav_dc_ros.offboard.flight_stacks import ARDUCOPTER
from uav_dc_ros.offboard.frames import (
    Enu,
    Geodetic,
    LocalFrame,
    Ned,
    sphere_scale,
    to_enu,
    to_ned,
)

ZURICH = Geodetic(latitude_deg=47.397742, longitude_deg=8.545594, altitude_m=488.0)


def test_axes() -> None:
    assert to_ned(Enu(1.0, 2.0, 3.0)) == Ned(north_m=2.0, east_m=1.0, down_m=-3.0)
    assert to_enu(Ned(north_m=2.0, east_m=1.0, down_m=-3.0)) == Enu(1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("moved", "axis"),
    [
        ({"longitude_deg": 8.545594 + 0.001}, 0),
        ({"latitude_deg": 47.397742 + 0.001}, 1),
        ({"altitude_m": 489.0}, 2),
    ],
)
def test_farther_east_north_or_up_is_more(moved: dict[str, float], axis: int) -> None:
    there = {
        "latitude_deg": ZURICH.latitude_deg,
        "longitude_deg": ZURICH.longitude_deg,
        "altitude_m": ZURICH.altitude_m,
    }
    seen = Geodetic(**{**there, **moved}).enu_from(ZURICH)
    # A thousandth of a degree: 111.19 m of latitude here, 75.46 m of longitude (WGS84's radii at 47.4 degrees
    # north are 6 370 km along the meridian and 6 390 km across it, and they are 488 m longer up there).
    expected = [75.46, 111.19, 1.0][axis]
    assert seen[axis] == pytest.approx(expected, rel=1e-3)
    assert all(abs(value) < 0.01 for other, value in enumerate(seen) if other != axis)


@given(st.floats(-2000.0, 2000.0), st.floats(-2000.0, 2000.0), st.floats(-100.0, 500.0))
def test_a_datum_there_and_back(east_m: float, north_m: float, up_m: float) -> None:
    offset = Enu(east_m, north_m, up_m)
    assert ZURICH.at(offset).enu_from(ZURICH) == pytest.approx(offset, abs=1e-5)


def test_the_grid_and_an_autopilot_that_was_switched_on_elsewhere() -> None:
    # Switched on 30 m east, 40 m north of the grid's corner, 5 m above it.
    frame = LocalFrame(origin=Enu(30.0, 40.0, 5.0))
    assert frame.to_autopilot(Enu(100.0, 200.0, 150.0)) == Ned(north_m=160.0, east_m=70.0, down_m=-145.0)
    assert frame.from_autopilot(Ned(north_m=160.0, east_m=70.0, down_m=-145.0)) == Enu(100.0, 200.0, 150.0)


def test_the_origin_of_an_autopilot_north_east_of_the_datum_counts_positive() -> None:
    origin = ZURICH.at(Enu(30.0, 40.0, 5.0))
    frame = LocalFrame(origin=origin.enu_from(ZURICH))
    assert frame.from_autopilot(Ned(0.0, 0.0, 0.0)) == pytest.approx(Enu(30.0, 40.0, 5.0), abs=1e-6)


@pytest.mark.parametrize("latitude_deg", [-60.0, -35.363261, 0.0, 47.4, 70.0])
@pytest.mark.parametrize(("east_m", "north_m"), [(1000.0, 0.0), (0.0, 1000.0), (-700.0, 700.0)])
def test_a_kilometre_of_the_grid_is_one_on_the_earth_in_arducopter_s_metres(
    latitude_deg: float, east_m: float, north_m: float
) -> None:
    """Compared with what ArduPilot itself makes of two places: `Location::get_distance_NE`."""
    origin = Geodetic(latitude_deg=latitude_deg, longitude_deg=149.165230, altitude_m=584.0)
    there = origin.at(Enu(east_m, north_m, 0.0))
    metres = 0.011131884502145034 * 1e7  # a degree of latitude
    middle_deg = (latitude_deg + there.latitude_deg) / 2
    own_m = (
        (there.latitude_deg - latitude_deg) * metres,
        (there.longitude_deg - origin.longitude_deg) * metres * math.cos(math.radians(middle_deg)),
    )
    frame = LocalFrame(origin=Enu(0.0, 0.0, 0.0), scale=sphere_scale(origin, ARDUCOPTER.earth_radius_m))
    sent = frame.to_autopilot(Enu(east_m, north_m, 50.0))
    # Axes are taken as parallel: at 70 degrees the meridians turn by 0.2 m on the way.
    assert sent[:2] == pytest.approx(own_m, abs=0.25)
    assert frame.from_autopilot(sent) == pytest.approx((east_m, north_m, 50.0))


@pytest.mark.parametrize(
    "text",
    ["", "1,2", "1,2,3,4", "a,b,c", "nan,1,2", "1,2,nan", "90.1,0,0", "0,-180.1,0", "1,2,inf", "1,2,1e5"],
)
def test_what_is_no_datum_is_an_error(text: str) -> None:
    with pytest.raises(VehicleError, match=r"^datum: .*; expected LATITUDE,LONGITUDE,ALTITUDE"):
        Geodetic.parse(text)
