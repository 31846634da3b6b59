"""A scenario: every value of a world, frozen and parsed strictly.

`parse` reads the text of a TOML file; `uav_dc_ros.scenarios.load` finds the file. An unknown key, a wrong
type and a value out of range are errors that name the key, the value and what was expected.
"""

import difflib
import hashlib
import json
import math
import re
import reprlib
import tomllib
from collections.abc import Iterator
from functools import cache, cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_args, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta

from uav_dc_ros.core import channel
from uav_dc_ros.core.arrays import Array, constant
from uav_dc_ros.core.channel import FreeSpace, Radio
from uav_dc_ros.core.energy import EnergySettings, StepEnergies
from uav_dc_ros.core.grid import Grid
from uav_dc_ros.core.keys import leaves, path_of
from uav_dc_ros.core.mobility import RandomWalk
from uav_dc_ros.core.obstacles import Buildings, Moves, Obstacle, moves_to_dock, problems
from uav_dc_ros.core.pace import TIME_MAX_S
from uav_dc_ros.core.reward import RewardData, RewardForm, RPlus
from uav_dc_ros.core.users.settings import UserSettings
from uav_dc_ros.errors import ScenarioError, UnknownKeyError

if TYPE_CHECKING:
    from uav_dc_ros.core.entities.tables import EntityTables

EpisodeEnd: TypeAlias = Literal["at_time_limit", "on_arrival"]

Positive: TypeAlias = Annotated[float, Meta(gt=0)]
NotNegative: TypeAlias = Annotated[float, Meta(ge=0)]
Latitude: TypeAlias = Annotated[float, Meta(ge=-90, le=90)]
Longitude: TypeAlias = Annotated[float, Meta(ge=-180, le=180)]

_NAME = r"^[a-z][a-z0-9_]{0,63}\Z"
_NAME_IN_WORDS = "a lower-case letter (a to z), then at most 63 of a to z, 0 to 9 and '_'"


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the scenario file."""


class MissionSettings(_Table, frozen=True):
    """Start, destination and limits of the mission."""

    start_m: tuple[float, float, float]  # start x, y, altitude, metres; the centre of a cell
    dock_m: tuple[float, float]  # destination x, y, metres; the centre of a cell
    step_s: Positive  # duration of a step, seconds
    max_steps: Annotated[int, Meta(ge=1, le=1_000_000)]  # steps T_cons that the battery allows
    d_cons_m: Positive  # maximum 3D distance at which a user is served, metres
    r_min_bits: Positive  # data at which a user counts as collected, bit; a listed user may have its own
    # `at_time_limit`: every mission flies `max_steps` steps, and has landed if it ends over the dock.
    # `on_arrival`: it ends at the dock, or after `max_steps` without landing.
    episode_end: EpisodeEnd


class RewardSettings(_Table, frozen=True):
    """The trade-off game."""

    beta: NotNegative  # weight of the data collected
    zeta: NotNegative  # weight of the trajectory reward
    r_plus: RPlus  # trajectory reward, see `reward.r_plus`
    form: RewardForm  # reward of a step, see `reward.step_reward`
    data_scale_bits: Positive  # data of a user that counts as 1 in the reward, bit
    # Data R in r^t (eq. 7), see `reward.counted_data`. Scenarios of version 0.1.0, also those in policies,
    # checkpoints and bags, lack the key: their data is the data so far.
    data: RewardData = "so_far"


class Scenario(_Table, frozen=True, dict=True, omit_defaults=True):
    """Every value of a world. `U` below is the number of users, M K where all clusters are equal."""

    name: Annotated[str, Meta(pattern=_NAME)]
    grid: Grid
    users: UserSettings
    mission: MissionSettings
    radio: Radio  # the uplink; `radio.model` names the struct, see `channel`
    reward: RewardSettings
    # The battery. Without the table no energy is counted.
    energy: EnergySettings | None = None
    # Latitude and longitude of x = 0, y = 0 on WGS 84, degrees; for files with positions in degrees
    datum_deg: tuple[Latitude, Longitude] | None = None
    obstacles: Annotated[tuple[Obstacle, ...], Meta(max_length=10_000)] = ()  # buildings and no-fly zones

    @property
    def n_clusters(self) -> int:
        """Clusters M."""
        return len(self.users.sizes)

    @cached_property
    def n_users(self) -> int:
        """Users U."""
        return sum(self.users.sizes)

    @cached_property
    def user_cluster(self) -> Array:
        """Cluster index of each user, integers `[U]`, ascending."""
        return np.repeat(np.arange(self.n_clusters), self.users.sizes)

    @cached_property
    def cluster_centres_m(self) -> tuple[tuple[float, float], ...]:
        """Centre of each cluster, metres, `[M, 2]`."""
        return tuple(disc.centre_m for disc in self.users.clusters)

    @property
    def user_centres_m(self) -> tuple[tuple[float, float], ...]:
        """Centre of the disc in which each user starts, metres, `[U, 2]`."""
        return self.users.centres_m

    def user_radii_m(self, like: Array) -> float | Array:
        """Radius of that disc, metres; `[U]` with the library, device and dtype of `like`, if they differ."""
        return _number_or_array(self.users.radii_m, like)

    def user_r_min_bits(self, like: Array) -> float | Array:
        """Data at which each user counts as collected, bit, as `user_radii_m`."""
        return _number_or_array(self._r_min_bits, like)

    @cached_property
    def _r_min_bits(self) -> float | tuple[float, ...]:
        return self.users.r_min_bits(self.mission.r_min_bits)

    def user_weights(self, like: Array) -> Array | None:
        """Share of each user in the sum of the priorities, `[U]`, as `user_radii_m`; None: equal shares."""
        return None if self.users.weights is None else constant(self.users.weights, like)

    @property
    def is_random(self) -> bool:
        """Whether anything is drawn; otherwise every seed gives the same mission."""
        return self.users.is_random or self.radio.is_random

    @property
    def draws_shape(self) -> tuple[int, int]:
        """Users U, and uniform draws D of each for the start of a mission and again for each step."""
        return self.n_users, self.users.moves.n_draws

    @cached_property
    def step_ns(self) -> int:
        """Duration of a step, nanoseconds."""
        return round(self.mission.step_s * 1e9)

    def time_ns(self, mission: int, step: int) -> int:
        """Time of a step since the first mission's start, nanoseconds; one step lies between missions."""
        return round((mission * (self.mission.max_steps + 1) + step) * self.mission.step_s * 1e9)

    @cached_property
    def start_cell(self) -> tuple[int, int, int]:
        """Cell in which a mission starts."""
        cell = self.grid.cell_at(self.mission.start_m)
        assert cell is not None, "checked by parse()"
        return cell

    @cached_property
    def dock_cell(self) -> tuple[int, int]:
        """Indices east and north of the dock's column of cells."""
        cell = self.grid.cell_at((*self.mission.dock_m, self.grid.altitude_min_m))
        assert cell is not None, "checked by parse()"
        return cell[:2]

    @cached_property
    def goals_cells(self) -> tuple[tuple[float, float], ...]:
        """The clusters' centres and the dock, in cells from the grid's origin, `[M + 1, 2]`."""
        cell_m = self.grid.cell_m
        goals_m = (*self.cluster_centres_m, self.mission.dock_m)
        return tuple((x_m / cell_m, y_m / cell_m) for x_m, y_m in goals_m)

    @cached_property
    def moves(self) -> Moves | None:
        """The moves that have an effect among the obstacles; None: there are no obstacles."""
        return Moves(self.grid, self.obstacles) if self.obstacles else None

    @cached_property
    def buildings(self) -> Buildings | None:
        """The buildings, which cut lines of sight; None: there are none."""
        return Buildings(self.obstacles) if any(one.kind == "building" for one in self.obstacles) else None

    @cached_property
    def entity_tables(self) -> "EntityTables":
        """What the observation `entities` looks up."""
        from uav_dc_ros.core.entities.tables import EntityTables  # whose world has a scenario

        return EntityTables(self)

    @property
    def ends_at_any_step(self) -> bool:
        """Whether a mission may end before its last step."""
        by_battery = self.energy is not None and self.energy.ends != "steps"
        return by_battery or self.mission.episode_end == "on_arrival"

    @cached_property
    def step_energies_j(self) -> StepEnergies:
        """Energy of each kind of step, joules; only with a table `energy`."""
        assert self.energy is not None, "checked by the caller"
        return self.energy.step_energies_j(self.grid, self.mission.step_s)

    @cached_property
    def fingerprint(self) -> str:
        """First 12 hex digits of the SHA-256 of every value but the reward's: equal for equal worlds only.

        A policy trained with another reward flies in the same world.
        """
        world = msgspec.to_builtins(self)
        del world["reward"]
        if isinstance(self.radio, FreeSpace):
            del world["radio"]["model"]  # which scenarios of version 0.2.0 lack
        world["radio"].pop("file", None)  # its content counts, not its place
        if isinstance(self.users.moves, RandomWalk):
            world["users"].pop("mobility", None)  # likewise
        return hashlib.sha256(msgspec.json.encode(world, order="sorted")).hexdigest()[:12]


def parse(text: str, source: str) -> Scenario:
    """A scenario from the text of a TOML file; `source` names the file in errors.

    Raises:
        ScenarioError: not TOML, an unknown key, a wrong type, a value out of range, or inconsistent values.
    """
    return from_values(read_values(text, source), source)


def read_values(text: str, source: str) -> dict[str, Any]:
    """The plain values in the text of a TOML file; raises ScenarioError if it is no TOML."""
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))  # the byte-order mark of Windows editors
    except (ValueError, RecursionError) as error:  # ValueError: also of an integer with too many digits
        raise ScenarioError(f"{source}: not a TOML file: {error}") from None


def from_values(values: dict[str, Any], source: str) -> Scenario:
    """A scenario from plain values, as TOML or JSON hold them; see `parse`."""
    scenario = with_types(values, source)
    if (error_text := next(inconsistencies(scenario), None)) is not None:
        raise ScenarioError(f"{source}: {error_text}", path_of(error_text))
    return scenario


def with_types(values: dict[str, Any], source: str) -> Scenario:
    """A scenario whose keys, types and ranges are right, but whose values need not fit together."""
    values = with_radio_model(values)
    _check_keys(values, Scenario, source)
    try:
        scenario = msgspec.convert(values, Scenario)
    except msgspec.ValidationError as error:
        explained = _explain(str(error), values)
        raise ScenarioError(f"{source}: {explained}", path_of(explained)) from None
    for key, value in leaves(msgspec.to_builtins(scenario)):
        # TOML's `nan` and `inf`, which no range of the types excludes
        if isinstance(value, float) and not math.isfinite(value):
            raise ScenarioError(f"{source}: {key} = {value}; expected a finite number", path_of(key))
    return scenario


def with_radio_model(values: Any) -> Any:
    """Plain values of a scenario with `radio.model`; those of version 0.2.0 lack it: free space."""
    if isinstance(values, dict) and isinstance(radio := values.get("radio"), dict):
        return values | {"radio": {"model": FreeSpace.__struct_config__.tag, **radio}}
    return values


def _check_keys(values: Any, struct: type, source: str, table: str = "") -> None:
    """Reject unknown keys before anything else: a typo is the likeliest mistake."""
    if not isinstance(values, dict):
        return
    known = _keys(struct)
    for key, value in values.items():
        # Quoted as in TOML when it is no bare key.
        name = table + (key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key))
        if key not in known:
            close = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"expected one of {', '.join(known)}"
            message = f"{source}: unknown key {name} = {reprlib.repr(value)}; {hint}"
            raise UnknownKeyError(message, (*path_of(table), key))
        if (inner := _table(known[key], value)) is not None:
            entries = {f"{name}[{i}].": one for i, one in enumerate(value)} if isinstance(value, list) else {}
            for path, entry in (entries or {f"{name}.": value}).items():
                _check_keys(entry, inner, source, path)


@cache
def _keys(struct: type) -> dict[str, Any]:
    """Keys of a table and their types; `model` comes first, where there are several."""
    tag_field = struct.__struct_config__.tag_field  # type: ignore[attr-defined]
    return ({tag_field: str} if tag_field else {}) | get_type_hints(struct)


def _tables(kind: Any) -> list[type[msgspec.Struct]]:
    """The tables that a key of this type may hold."""
    kinds = get_args(kind) or (kind,)
    return [one for one in kinds if isinstance(one, type) and issubclass(one, msgspec.Struct)]


def _table(kind: Any, values: Any) -> type[msgspec.Struct] | None:
    """The table of these values; of several, that of their model. None: there is none."""
    tables = _tables(kind)
    if len(tables) > 1:
        model = values.get("model") if isinstance(values, dict) else None
        tables = [one for one in tables if one.__struct_config__.tag == model]
    return tables[0] if tables else None


def _explain(message: str, values: Any) -> str:
    """msgspec's message, with the key and the value in front."""
    expected, _, path = message.partition(" - at `$.")
    path = path.removesuffix("`")
    kind: Any = Scenario
    outer: Any = None
    for key in re.findall(r"\w+", path):
        if key.isdecimal():
            values = values[int(key)]
        else:
            table = _table(kind, values)
            outer, kind, values = kind, _keys(table)[key] if table else str, values[key]
    if missing := re.fullmatch(r"Object missing required field `(.+)`", expected):
        key = f"{path}.{missing[1]}" if path else missing[1]
        table = _table(kind, values)
        is_table = table is not None and _tables(_keys(table)[missing[1]])
        return f"missing {'table' if is_table else 'key'} {key}"
    if expected.startswith("Invalid enum value"):
        expected = f"one of {', '.join(get_args(kind))}"
    elif expected.startswith("Invalid value"):  # the model
        expected = f"one of {', '.join(str(one.__struct_config__.tag) for one in _tables(outer))}"
    elif "matching regex" in expected:
        expected = _NAME_IN_WORDS  # the only pattern of a scenario
    elif expected == "Number out of range":
        expected = "a finite number"
    expected = expected.replace("`", "").removeprefix("Expected ").replace("object", "table")
    expected = expected.replace(" | null", "")  # what TOML does not have
    return f"{path or 'scenario'} = {reprlib.repr(values)}; expected {expected}"


def inconsistencies(scenario: Scenario) -> Iterator[str]:
    """Errors of combined values, each beginning with its key, lazily."""
    grid, mission = scenario.grid, scenario.mission
    of_users = list(scenario.users.inconsistencies())
    yield from of_users
    top_m = grid.altitude_min_m + (grid.n_z - 1) * grid.altitude_step_m
    extent = (
        f"x 0 to {(grid.n_x - 1) * grid.cell_m:g} and y 0 to {(grid.n_y - 1) * grid.cell_m:g} m "
        f"in steps of {grid.cell_m:g}"
    )
    start, dock = grid.cell_at(mission.start_m), grid.cell_at((*mission.dock_m, grid.altitude_min_m))
    if start is None:
        yield (
            f"mission.start_m = {list(mission.start_m)}; expected the centre of a cell: "
            f"{extent}, altitude {grid.altitude_min_m:g} to {top_m:g} m in steps of {grid.altitude_step_m:g}"
        )
    if dock is None:
        yield f"mission.dock_m = {list(mission.dock_m)}; expected the centre of a cell: {extent}"
    moves = abs(start[0] - dock[0]) + abs(start[1] - dock[1]) if start and dock else 0
    if scenario.obstacles and start and dock:
        yield from problems(scenario)
        moves = moves_to_dock(scenario)
    if moves > mission.max_steps:
        expected = f"expected at least {moves}, the moves from start to dock"
        yield f"mission.max_steps = {mission.max_steps}; {expected}"
    if (mission.max_steps + 1) * mission.step_s >= TIME_MAX_S:
        yield (
            f"mission.step_s = {mission.step_s:g}; expected less than "
            f"{TIME_MAX_S / (mission.max_steps + 1):g}, so that mission.max_steps of it fit into a ROS time"
        )
    if grid.altitude_min_m > mission.d_cons_m:
        yield (
            f"mission.d_cons_m = {mission.d_cons_m:g}; expected at least "
            f"grid.altitude_min_m = {grid.altitude_min_m:g}, or no user can be served"
        )
    yield from scenario.users.outside(grid)
    for disc in () if of_users else scenario.users.start_discs():
        distance_m = grid.distance_m(disc.centre_m, disc.radius_m)
        if distance_m > max(mission.d_cons_m, grid.altitude_min_m):
            yield (
                f"{disc.key} = {list(disc.centre_m)}: its disc is {distance_m:.1f} m from the "
                f"nearest cell; expected at most mission.d_cons_m = {mission.d_cons_m:g}, or its users are "
                "out of reach"
            )
    if scenario.energy is not None:
        yield from scenario.energy.inconsistencies(grid, mission.step_s, mission.max_steps, moves)
    mission_s = mission.max_steps * mission.step_s
    yield from channel.inconsistencies(scenario.radio, grid, None if of_users else scenario.users, mission_s)


def _number_or_array(value: float | tuple[float, ...], like: Array) -> float | Array:
    return constant(value, like) if isinstance(value, tuple) else value
