"""Where the grid lay in the last flight: kept, offered, and compared with."""

import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from uav_dc_ros import run_all, scenarios
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import NodeError, ParameterError, VehicleError
from uav_dc_ros.nodes import vehicles
from uav_dc_ros.offboard import datums
from uav_dc_ros.offboard.frames import Enu, Geodetic
from uav_dc_ros.runner import run_options

FIVE, THREE = scenarios.load("five_clusters_hover"), scenarios.load("three_clusters_hover")
DATUM = Geodetic(latitude_deg=-35.363261, longitude_deg=149.16523, altitude_m=584.0)
FLIGHT = r"-35\.363261,149\.16523,584\.0 \(flight of five_clusters_hover, 20\d\d-.*\+00:00\)"


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A state folder of this test's own."""
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path


def check(*given: str, scenario: Scenario = FIVE) -> None:
    """What run_all checks of the options of a vehicle."""
    wanted = run_all.parser().parse_args(["--vehicle", "mavlink", "--connect", "tcp:127.0.0.1:1", *given])
    run_options.check_vehicle(wanted, ["bridge"], scenario)


def test_a_datum_with_a_minus_is_a_value() -> None:
    for words in (["--datum", "-35.36,149.16,584"], ["--datum=-35.36,149.16,584"]):
        assert run_all.parser().parse_args(words).datum == "-35.36,149.16,584"
    check("--datum", "-35.36,149.16,584", "--arm")


def test_arming_requires_a_datum() -> None:
    expected = r"arm: without a datum; expected one with it: here \(.*\), last \(.*\) or LAT,LON,ALT"
    with pytest.raises(ParameterError, match=f"{expected}$"):
        check("--arm")
    datums.save(FIVE, DATUM, "mavlink")
    with pytest.raises(ParameterError, match=f"{expected}; the last flight's: {FLIGHT}$"):
        check("--arm")
    for given in ((), ("--arm", "--datum", "here"), ("--arm", "--datum", "last")):
        check(*given)
    with pytest.raises(VehicleError, match="datum: '47,8'; expected LATITUDE,LONGITUDE,ALTITUDE"):
        check("--datum", "47,8")


PLACED = msgspec.structs.replace(FIVE, datum_deg=(DATUM.latitude_deg, DATUM.longitude_deg))


def test_a_scenario_with_a_datum_needs_no_option_and_refuses_another_place() -> None:
    check("--arm", scenario=PLACED)
    assert datums.parse("", PLACED, "mavlink", arm=True) is None, "the ground gives the altitude"
    near, far = DATUM.at(Enu(3.0, 3.0, 50.0)), DATUM.at(Enu(0.0, -6.0, 0.0))
    assert datums.parse(str(near), PLACED, "mavlink") == near
    expected = (
        rf"^datum: '{far}'; the grid's corner at {far} is 6\.0 m from datum_deg = "
        r"\[-35\.363261, 149\.16523\] of scenario five_clusters_hover; expected at most 5 m, or no datum$"
    )
    with pytest.raises(ParameterError, match=expected):
        check("--arm", "--datum", str(far), scenario=PLACED)
    datums.save(PLACED, far, "mavlink")
    with pytest.raises(ParameterError, match=r"^datum: 'last'; .* 6\.0 m from datum_deg"):
        check("--datum", "last", scenario=PLACED)
    text, moved = datums.describe(DATUM, "", PLACED)
    assert moved
    assert ", from the scenario's datum_deg and the ground under the vehicle; 0.0 m" in text
    assert "6.0 m north of that of the last flight" in text


@pytest.mark.parametrize("vehicle", ["mavlink", "mavros"])
@pytest.mark.parametrize(
    ("text", "grid_origin", "expected"),
    [("", "", PLACED.datum_deg), ("here", "", None), (str(DATUM), "", None), ("", "1.0,2.0,3.0", None)],
)
def test_the_transports_get_the_scenario_s_datum(
    vehicle: str, text: str, grid_origin: str, expected: tuple[float, float] | None
) -> None:
    values = {"vehicle": vehicle, "datum": text, "connect": "tcp:127.0.0.1:1", "system": 1, "arm": False}
    datum = datums.parse(text, PLACED, vehicle)
    node: Any = None
    made: Any = vehicles.make(node, values, PLACED, datum, grid_origin, None, False)
    telemetry = made._telemetry
    if vehicle == "mavros":
        assert telemetry.datum == (Geodetic(*expected, 0.0) if expected else datum)
    else:
        assert telemetry.datum_deg == expected
    made.close()


def test_the_last_flight_s_is_that_of_the_same_world() -> None:
    assert datums.last(FIVE) is None
    with pytest.raises(ParameterError, match=r"'last'; .*datums has no flight in this world .*"):
        check("--datum", "last")
    datums.save(FIVE, DATUM, "mavlink")
    datums.save(THREE, DATUM.at(Enu(10.0, 0.0, 0.0)), "px4")
    assert datums.parse("last", FIVE, "px4") == DATUM
    assert datums.parse("last", THREE, "mavlink") != DATUM
    for here in ("here", ""):
        assert datums.parse(here, FIVE, "mavlink") is None


def test_a_flight_through_mavros_has_no_altitude_for_the_others() -> None:
    datums.save(FIVE, DATUM, "mavros")
    assert datums.parse("last", FIVE, "mavros") == DATUM
    with pytest.raises(ParameterError, match=f"reports no altitude above mean sea level: {FLIGHT}; expected"):
        datums.parse("last", FIVE, "mavlink")


def test_a_grid_that_moves_is_seen() -> None:
    text, moved = datums.describe(DATUM, "here", FIVE)
    assert (moved, text) == (
        False,
        f"the grid's corner lies at {DATUM}, from the vehicle's position; no earlier flight in this world",
    )
    datums.save(FIVE, DATUM, "mavlink")
    text, moved = datums.describe(DATUM.at(Enu(200.0, -200.0, 0.0)), "here", FIVE)
    assert moved
    assert re.search(r"; 200\.0 m east and 200\.0 m south of that of the last flight \(20", text)
    text, moved = datums.describe(DATUM, "last", FIVE)
    assert not moved
    assert ", as in the last flight; 0.0 m east and 0.0 m north of that" in text


def test_a_broken_file_is_an_error_only_where_it_is_needed(state: Path) -> None:
    datums.save(FIVE, DATUM, "mavlink")
    (file,) = state.rglob("*.json")
    for broken in (b"", b"{}", b'{"scenario": "x", "datum": "x", "vehicle": "x", "time": "x"}', b"\xff"):
        file.write_bytes(broken)
        with pytest.raises(ParameterError, match=f"datum of the last flight, {file}: .*; expected it whole"):
            check("--datum", "last")
        assert datums.describe(DATUM, "here", FIVE)[1], "it may have moved"
        check("--arm", "--datum", "here")
        with pytest.raises(ParameterError, match="arm: without a datum"):
            check("--arm")


def test_where_it_is_kept(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert datums.folder() == state / "uav_dc_ros" / "datums"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/uav-dc:/var/lib/other")
    assert datums.folder() == Path("/var/lib/uav-dc/uav_dc_ros/datums"), "as systemd has it"
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    monkeypatch.setenv("HOME", "/home/uav")
    assert datums.folder() == Path("/home/uav/.local/state/uav_dc_ros/datums")
    (state / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(state / "file"))
    with pytest.raises(NodeError, match="cannot be made: Not a directory"):
        datums.save(FIVE, DATUM, "mavlink")
