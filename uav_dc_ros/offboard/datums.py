"""The grid's datum: the option that gives it, and the datum of the last flight in each scenario's world.

Files are in the user's state folder (systemd's `STATE_DIRECTORY`, `XDG_STATE_HOME`, or `~/.local/state`).
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

HERE, LAST = "here", "last"
EXPECTED = (
    f"{HERE} (the vehicle stands at the scenario's start), {LAST} (as in the last flight) or LAT,LON,ALT"
)
MOVED_M = 5.0  # two fixes of one place differ by less
NO_ALTITUDE = "mavros"  # altitude 0 of the datum is the ground under the vehicle


class SavedDatum(msgspec.Struct, frozen=True, kw_only=True):
    """Datum of the last flight in one world."""

    scenario: str
    datum: str  # as `Geodetic.parse` reads it
    vehicle: str  # transport to the autopilot
    time: str  # take-off, UTC, ISO 8601

    def __str__(self) -> str:
        """Text for errors and log lines."""
        return f"{self.datum} (flight of {self.scenario}, {self.time})"


def folder() -> Path:
    """Folder of the saved datums; raises ParameterError if there is no home folder, nor another named."""
    path = os.environ.get("STATE_DIRECTORY", "").split(":")[0] or os.environ.get("XDG_STATE_HOME", "")
    if not Path(path).is_absolute():
        try:
            path = str(Path.home() / ".local" / "state")
        except RuntimeError:
            raise ParameterError(
                "the datum of a flight cannot be saved: no home folder; expected XDG_STATE_HOME to be set"
            ) from None
    return Path(path) / "uav_dc_ros" / "datums"


def last(scenario: Scenario) -> SavedDatum | None:
    """Datum of the last flight in a scenario's world; None: no flight. ParameterError: it cannot be read."""
    path = folder() / f"{scenario.fingerprint}.json"
    try:
        saved = msgspec.json.decode(path.read_bytes(), type=SavedDatum)
        Geodetic.parse(saved.datum)
    except FileNotFoundError:
        return None
    except (OSError, msgspec.DecodeError, VehicleError) as error:
        raise ParameterError(
            f"datum of the last flight, {path}: {error}; expected it whole, or removed"
        ) from None
    return saved


def save(scenario: Scenario, datum: Geodetic, vehicle: str) -> None:
    """Save the datum of the flight that begins; raises UavDcError if the file cannot be written."""
    time = datetime.now(UTC).isoformat(timespec="seconds")
    saved = SavedDatum(scenario=scenario.name, datum=str(datum), vehicle=vehicle, time=time)
    path = folder() / f"{scenario.fingerprint}.json"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NodeError(f"{path.parent} cannot be made: {error.strerror}") from None
    files.write(path, msgspec.json.encode(saved))


def parse(text: str, scenario: Scenario, vehicle: str, *, arm: bool = False) -> Geodetic | None:
    """Datum given by an option or parameter; None: the position of the vehicle on the ground gives it.

    The text is `here`, `last` or LAT,LON,ALT; empty is as `here`, but not with `arm`. Raises ParameterError
    if no last flight fits `vehicle`, the transport, or `arm` has no datum; VehicleError if the text is none.
    """
    if arm and not text:
        raise ParameterError(f"arm: without a datum; expected one with it: {_offer(scenario)}")
    if text in ("", HERE):
        return None
    if text != LAST:
        return Geodetic.parse(text)
    saved = last(scenario)
    if saved is None:
        raise ParameterError(
            f"datum: {LAST!r}; {folder()} has no flight in this world ({scenario.name} "
            f"{scenario.fingerprint}); expected {HERE} or LAT,LON,ALT"
        )
    if saved.vehicle == NO_ALTITUDE != vehicle:
        raise ParameterError(
            f"datum: {LAST!r}; the last flight was through MAVROS, which reports no altitude above mean sea "
            f"level: {saved}; expected LAT,LON,ALT"
        )
    return Geodetic.parse(saved.datum)


def describe(datum: Geodetic, source: str, scenario: Scenario) -> tuple[str, bool]:
    """Position of the grid, its source and its distance from the last flight's; and whether it has moved.

    `source` is the text of the option, see `parse`; empty: an earlier start of the bridge in this flight.
    """
    sources = {
        HERE: "from the vehicle's position",
        LAST: "as in the last flight",
        "": "as before the restart",
    }
    text = f"the grid's corner lies at {datum}, {sources.get(source, 'as given')}"
    try:
        saved = last(scenario)
        if saved is None:
            return f"{text}; no earlier flight in this world", False
        east_m, north_m, _ = datum.enu_from(Geodetic.parse(saved.datum))
    except UavDcError as error:
        return f"{text}; not compared with the last flight: {error}", True
    east = f"{abs(east_m):.1f} m {'east' if east_m >= 0 else 'west'}"
    north = f"{abs(north_m):.1f} m {'north' if north_m >= 0 else 'south'}"
    moved = math.hypot(east_m, north_m) > MOVED_M
    return f"{text}; {east} and {north} of that of the last flight ({saved.time})", moved


def _offer(scenario: Scenario) -> str:
    """Permitted values, with the last flight's datum."""
    try:
        saved = last(scenario)
    except ParameterError:
        saved = None
    return EXPECTED if saved is None else f"{EXPECTED}; the last flight's: {saved}"
