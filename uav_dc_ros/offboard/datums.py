"""Where the grid lay in the last flight, so that the next one does not move it unseen. Knows no ROS.

A file for each scenario's world, in the state folder of the user who flies (`STATE_DIRECTORY` of systemd,
`XDG_STATE_HOME`, or `~/.local/state`).
"""

import math
import os
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from uav_dc_ros import files
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import NodeError, ParameterError, UavDcError, VehicleError
from uav_dc_ros.offboard.frames import Geodetic

HERE, LAST = "here", "last"  # in place of a datum
EXPECTED = (
    f"{HERE} (the vehicle stands at the scenario's start), {LAST} (as in the last flight) or LAT,LON,ALT"
)
MOVED_M = 5.0  # two fixes of one place differ by less
NO_ALTITUDE = "mavros"  # the vehicle's ground level takes the place of the datum's altitude


class SavedDatum(msgspec.Struct, frozen=True, kw_only=True):
    """The grid of the last flight in one world.

    Attributes:
        scenario: its name.
        datum: of the grid, as `Geodetic.parse` reads it.
        vehicle: the way to the autopilot.
        time: when the vehicle took off, UTC, ISO 8601.
    """

    scenario: str
    datum: str
    vehicle: str
    time: str

    def __str__(self) -> str:
        """As an error or a log line tells it."""
        return f"{self.datum} (flight of {self.scenario}, {self.time})"


def folder() -> Path:
    """The folder of the files.

    Raises:
        ParameterError: the user has no home, and no other place is named.
    """
    given = os.environ.get("STATE_DIRECTORY", "").split(":")[0] or os.environ.get("XDG_STATE_HOME", "")
    if not Path(given).is_absolute():
        try:
            given = str(Path.home() / ".local" / "state")
        except RuntimeError:
            raise ParameterError(
                "the datum of a flight has no place: no home folder; expected XDG_STATE_HOME to be set"
            ) from None
    return Path(given) / "uav_dc_ros" / "datums"


def last(scenario: Scenario) -> SavedDatum | None:
    """The last flight in a scenario's world; None: there was none.

    Raises:
        ParameterError: its file cannot be read.
    """
    path = folder() / f"{scenario.fingerprint}.json"
    try:
        kept = msgspec.json.decode(path.read_bytes(), type=SavedDatum)
        Geodetic.parse(kept.datum)
    except FileNotFoundError:
        return None
    except (OSError, msgspec.DecodeError, VehicleError) as error:
        raise ParameterError(
            f"datum of the last flight, {path}: {error}; expected it whole, or removed"
        ) from None
    return kept


def keep(scenario: Scenario, datum: Geodetic, vehicle: str) -> None:
    """Keep the grid of the flight that begins.

    Raises:
        UavDcError: it cannot be written.
    """
    time = datetime.now(UTC).isoformat(timespec="seconds")
    kept = SavedDatum(scenario=scenario.name, datum=str(datum), vehicle=vehicle, time=time)
    path = folder() / f"{scenario.fingerprint}.json"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NodeError(f"{path.parent} cannot be made: {error.strerror}") from None
    files.write(path, msgspec.json.encode(kept))


def parse(text: str, scenario: Scenario, vehicle: str, *, arm: bool = False) -> Geodetic | None:
    """The datum that an option or parameter names; None: the vehicle's place on the ground gives it.

    Args:
        text: `here`, `last` or LAT,LON,ALT; empty: not named, the same as `here`.
        scenario: the world that is flown.
        vehicle: the way to the autopilot.
        arm: is the vehicle to be armed? Then the place of the grid is to be named.

    Raises:
        ParameterError: there is no last flight, or none that fits; it is to arm, and nothing is named.
        VehicleError: no datum.
    """
    if text == HERE:
        return None
    if not text:
        if arm:
            raise ParameterError(f"arm: without a datum; expected one with it: {offer(scenario)}")
        return None
    if text != LAST:
        return Geodetic.parse(text)
    kept = last(scenario)
    if kept is None:
        raise ParameterError(
            f"datum: {LAST!r}; no flight in this world ({scenario.name} {scenario.fingerprint}) is kept in "
            f"{folder()}; expected {HERE} or LAT,LON,ALT"
        )
    if kept.vehicle == NO_ALTITUDE != vehicle:
        raise ParameterError(
            f"datum: {LAST!r}; the last flight was through MAVROS, which reports no altitude above mean sea "
            f"level: {kept}; expected LAT,LON,ALT"
        )
    return Geodetic.parse(kept.datum)


def described(datum: Geodetic, text: str, scenario: Scenario) -> tuple[str, bool]:
    """Where a grid lies, where that comes from, and how far from the last flight's; and whether it moved.

    Args:
        datum: of the grid.
        text: what `parse` was given; empty: an earlier start of the bridge in this flight.
        scenario: the world that is flown.
    """
    sources = {HERE: "from where the vehicle stands", LAST: "as in the last flight", "": "as before"}
    told = f"the grid's corner lies at {datum}, {sources.get(text, 'as given')}"
    try:
        kept = last(scenario)
        if kept is None:
            return f"{told}; no earlier flight in this world is kept", False
        east_m, north_m, _ = datum.seen_from(Geodetic.parse(kept.datum))
    except UavDcError as error:
        return f"{told}; not compared with the last flight: {error}", True
    away = f"{abs(east_m):.1f} m {'east' if east_m >= 0 else 'west'} and "
    away += f"{abs(north_m):.1f} m {'north' if north_m >= 0 else 'south'}"
    moved = math.hypot(east_m, north_m) > MOVED_M
    return f"{told}; {away} of that of the last flight ({kept.time})", moved


def offer(scenario: Scenario) -> str:
    """What may be given as a datum, in words, with the last flight's."""
    try:
        kept = last(scenario)
    except ParameterError:
        kept = None
    return EXPECTED if kept is None else f"{EXPECTED}; the last flight's: {kept}"
