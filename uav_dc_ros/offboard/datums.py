"""The grid's datum: the option or scenario that gives it, and that of the last flight in each world.

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

HERE, LAST, RESTART = "here", "last", "restart"
EXPECTED = (
    f"{HERE} (the vehicle stands at the scenario's start), {LAST} (as in the last flight) or LAT,LON,ALT"
)
SCENARIO = ""  # without the option: `datum_deg` of the scenario, or else `here`
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

    The text is `here`, `last` or LAT,LON,ALT. Empty is the scenario's `datum_deg` with the altitude of the
    ground under the vehicle; without that key it is as `here`, but not with `arm`.

    Raises:
        ParameterError: no last flight fits `vehicle`, the transport; `arm` has no datum; the datum and
            `datum_deg` disagree.
        VehicleError: the text is none of these.
    """
    if arm and not text and scenario.datum_deg is None:
        raise ParameterError(f"arm: without a datum; expected one with it: {_offer(scenario)}")
    if text in ("", HERE):
        return None
    datum = _last(scenario, vehicle) if text == LAST else Geodetic.parse(text)
    if (conflict := disagreement(datum, scenario)) is not None:
        raise ParameterError(f"datum: {text!r}; {conflict}, or no datum")
    return datum


def disagreement(datum: Geodetic, scenario: Scenario) -> str | None:
    """Text on a datum more than `MOVED_M` away from the scenario's `datum_deg`; None: they agree.

    The scenario's users, buildings and zones stand still on the Earth: a grid elsewhere moves them unseen.
    """
    own = scenario.datum_deg
    if own is None or datum[:2] == own:
        return None
    apart_m = math.hypot(*datum.enu_from(Geodetic(*own, datum.altitude_m))[:2])
    if apart_m <= MOVED_M:
        return None
    return (
        f"the grid's corner at {datum} is {apart_m:.1f} m from datum_deg = {list(own)} of scenario "
        f"{scenario.name}; expected at most {MOVED_M:g} m"
    )


def _last(scenario: Scenario, vehicle: str) -> Geodetic:
    """Datum of the last flight; raises ParameterError as `parse`."""
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

    `source` is the text of the option, see `parse`, or `RESTART`: an earlier bridge of this flight.
    """
    sources = {
        HERE: "from the vehicle's position",
        LAST: "as in the last flight",
        SCENARIO: "from the scenario's datum_deg and the ground under the vehicle",
        RESTART: "as before the restart",
    }
    if source == SCENARIO and scenario.datum_deg is None:
        source = HERE
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
