"""The worlds of the leaderboard: shipped ones, unseen random fields, and both with something changed."""

from typing import Any, Literal, TypeAlias, get_args

import msgspec
import numpy as np

from uav_dc_ros import scenarios
from uav_dc_ros.core.channel import FreeSpace, RadioSettings
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.experiments.evaluate.shifts import ShiftedWorld, apply, parse
from uav_dc_ros.scenarios.generation.field import OBSTRUCTION_LOSS_DB

Section: TypeAlias = Literal["fields", "shipped", "channels", "obstacles", "shifts"]
SECTIONS: tuple[Section, ...] = get_args(Section)

# Keys of the table `radio` of a field; with a model, those of free space are left out.
CHANNELS: dict[str, dict[str, Any]] = {
    "air_to_ground": {
        "model": "air_to_ground",
        "carrier_hz": 2e9,
        "environment": "urban",
        "line_of_sight": "mean_gain",
    },
    "tr_36_777": {
        "model": "tr_36_777",
        "carrier_hz": 2e9,
        "environment": "uma_av",
        "line_of_sight": "drawn",
    },
    "shadowing and fading": {
        "shadowing": {"sigma_db": 6.0, "correlation_m": 50.0},
        "fading": {"model": "rician", "k_db": 6.0},
    },
    "interference of the served": {"interference": "associated"},
    "no interference": {"interference": "none"},
}
BUILDINGS = "buildings"
OBSTACLES = ("no-fly zones", BUILDINGS)
_PRISMS, _TRIES = 3, 20  # obstacles of a field, and drafts of it
# Shifts of fields; the last one makes another grid, which policies of a single world do not fit.
SHIFTS = (
    "users.position_error=20%",
    "users.v_max_mps=x2",
    "users.missing=30%",
    "radio.noise_power_dbm=+6",
    "grid.cells=x2",
)
SHIFTED_WORLD = "five_clusters"  # the shipped world that is shifted, too


class BoardWorld(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A world of the leaderboard."""

    scenario: str  # a shipped name, or random:SEED
    variant: str = ""  # one of `CHANNELS` or `OBSTACLES`; "": as it is
    shift: str = ""  # of `evaluate --shift`; "": none

    def load(self) -> ShiftedWorld:
        """The scenario, and what a policy knows of it."""
        scenario = scenarios.load(self.scenario)
        if self.variant in CHANNELS:
            scenario = _with_channel(scenario, CHANNELS[self.variant])
        elif self.variant:
            scenario = _with_obstacles(scenario, self.variant)
        return apply(parse(self.shift), scenario) if self.shift else ShiftedWorld(scenario, scenario)


class Board(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Worlds with one ranking."""

    name: str
    section: Section
    worlds: tuple[BoardWorld, ...]
    n_missions: int  # in each world, seeds 0 to n - 1
    n_bounded: int = 0  # the first missions, world by world, that get a bound
    home: str = ""  # shipped scenario whose policies fly here; "": policies for any field only
    unshifted: str = ""  # board whose first worlds are these without the shift; "": none


class Sizes(msgspec.Struct, frozen=True, kw_only=True):
    """How large a leaderboard is."""

    fields: int  # random fields as they are
    missions: int  # in a shipped world
    variants: int  # random fields with each channel, obstacle and shift
    bounds: int  # random fields with a bound; a tenth of it, rounded up, in every other board but shifts


def boards(sizes: Sizes, sections: tuple[Section, ...] = SECTIONS) -> list[Board]:
    """The boards of some sections."""
    few = -(-sizes.bounds // 10)
    fields = [f"{scenarios.RANDOM}{seed}" for seed in range(max(sizes.fields, sizes.variants))]
    found = [
        Board(
            name="fields",
            section="fields",
            worlds=tuple(BoardWorld(scenario=name) for name in fields[: sizes.fields]),
            n_missions=1,
            n_bounded=min(sizes.bounds, sizes.fields),
        )
    ]
    found += [
        Board(
            name=name,
            section="shipped",
            worlds=(BoardWorld(scenario=name),),
            n_missions=sizes.missions,
            n_bounded=min(few, sizes.missions),
            home=name,
        )
        for name in scenarios.names()
    ]
    for section, variants in (("channels", CHANNELS), ("obstacles", OBSTACLES)):
        found += [
            Board(
                name=variant,
                section="channels" if section == "channels" else "obstacles",
                worlds=tuple(BoardWorld(scenario=name, variant=variant) for name in fields[: sizes.variants]),
                n_missions=1,
                n_bounded=min(few, sizes.variants),
            )
            for variant in variants
        ]
    found += [
        Board(
            name=shift,
            section="shifts",
            worlds=tuple(BoardWorld(scenario=name, shift=shift) for name in fields[: sizes.variants]),
            n_missions=1,
            unshifted="fields",
        )
        for shift in SHIFTS
    ]
    found += [
        Board(
            name=f"{SHIFTED_WORLD}, {shift}",
            section="shifts",
            worlds=(BoardWorld(scenario=SHIFTED_WORLD, shift=shift),),
            n_missions=sizes.missions,
            home=SHIFTED_WORLD,
            unshifted=SHIFTED_WORLD,
        )
        for shift in SHIFTS[:-1]
    ]
    return [board for board in found if board.section in sections]


def _with_channel(scenario: Scenario, keys: dict[str, Any]) -> Scenario:
    values = msgspec.to_builtins(scenario)
    radio = values["radio"]
    if keys.get("model", FreeSpace.__struct_config__.tag) != radio["model"]:
        shared = {*RadioSettings.__struct_fields__, "interference"}
        radio = {key: value for key, value in radio.items() if key in shared}
    return from_values(values | {"radio": radio | keys}, scenario.name)


def _with_obstacles(scenario: Scenario, kind: str) -> Scenario:
    """The scenario with rectangular prisms at random places, the same ones for equal scenarios.

    Sides are 0.5 to 3 cells; roofs are at 0.5 to 1.5 times the altitude of the second layer.
    """
    rng, grid = np.random.default_rng(int(scenario.fingerprint, 16)), scenario.grid
    values = msgspec.to_builtins(scenario)
    if kind == BUILDINGS:
        values["radio"]["obstruction_loss_db"] = OBSTRUCTION_LOSS_DB
    for _ in range(_TRIES):
        prisms = []
        for _ in range(_PRISMS):
            x_m, y_m = (rng.random(2) * (grid.n_x - 1, grid.n_y - 1) * grid.cell_m).round(1).tolist()
            a_m, b_m = (rng.uniform(0.5, 3.0, 2) * grid.cell_m).round(1).tolist()
            corners_m = [(x_m, y_m), (x_m + a_m, y_m), (x_m + a_m, y_m + b_m), (x_m, y_m + b_m)]
            height_m = rng.uniform(0.5, 1.5) * (grid.altitude_min_m + grid.altitude_step_m)
            prisms.append(
                {"kind": "building", "polygon_m": corners_m, "height_m": round(height_m, 1)}
                if kind == BUILDINGS
                else {"kind": "no_fly", "polygon_m": corners_m}
            )
        try:
            return from_values(values | {"obstacles": prisms}, scenario.name)
        except ScenarioError:  # such as a closed dock
            continue
    raise ScenarioError(f"scenario {scenario.name!r}: {_TRIES} drafts of {kind} close the field")
