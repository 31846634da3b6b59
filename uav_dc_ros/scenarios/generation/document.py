"""A scenario as the text of a TOML file, with a comment for each key."""

import json
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from uav_dc_ros.core.scenario import Scenario

UNITS = "x is east, y is north, altitude is above the users. A key ends in its unit. Every key is checked."
WIDTH = 100  # of a line with a comment beside the value
COMMENTS = {
    "name": "names the world in bags, policies and reports: a to z, 0 to 9 and _",
    "grid": "The cells that the UAV moves on. Cell 0, 0 is at x = 0 (east), y = 0 (north).",
    "grid.n_x": "cells east",
    "grid.n_y": "cells north",
    "grid.n_z": "layers of altitude",
    "grid.cell_m": "from cell to cell",
    "grid.altitude_min_m": "of the lowest layer, above the users",
    "grid.altitude_step_m": "from layer to layer",
    "datum_deg": "latitude and longitude of x = 0, y = 0 on WGS 84",
    "zones": "relative to this file",
    "obstacles": "A building or a no-fly zone, see docs/obstacles.md.",
    "users": "The users on the ground, see docs/users.md.",
    "users.file": "relative to this file",
    "users.cluster_centres_m": "x, y of each",
    "users.users_per_cluster": "in each cluster",
    "users.cluster_radius_m": "of the disc in which they start",
    "users.v_max_mps": "maximum speed of their random walk",
    "users.mobility": "How they move, see docs/users.md.",
    "users.mobility.model": "random_walk, static, random_waypoint or gauss_markov",
    "mission": "Start, dock and limits of a mission. Start and dock are centres of cells.",
    "mission.start_m": "x, y, altitude",
    "mission.dock_m": "x, y",
    "mission.step_s": "duration of a step: one move, or a hover",
    "mission.max_steps": "steps that the battery lasts",
    "mission.d_cons_m": "3D distance up to which a user is served",
    "mission.r_min_bits": "data after which a user is collected",
    "mission.episode_end": "at_time_limit, or on_arrival: at the dock",
    "radio": "The uplink. Other channels than free space: see docs/channels.md.",
    "radio.model": "free_space, air_to_ground or tr_36_777; each has keys of its own",
    "radio.bandwidth_hz": "",
    "radio.tx_power_w": "of each user",
    "radio.noise_power_dbm": "at the UAV",
    "radio.ref_gain_db": "channel power gain at 1 m",
    "radio.path_loss_exponent": "2 in free space",
    "radio.obstruction_loss_db": "of a link that a building cuts",
    "radio.carrier_hz": "",
    "radio.environment": "",
    "radio.line_of_sight": "mean_loss_db or mean_gain",
    "radio.interference": "transmitting users: all, associated or none",
    "reward": "What a policy learns from; not part of the world. See docs/symbols.md.",
    "reward.beta": "weight of the data",
    "reward.zeta": "weight of the way to the dock",
    "reward.r_plus": "exponential, or binary: at the dock only",
    "reward.form": "episode, or immediate: the change in a step",
    "reward.data_scale_bits": "data of a user that counts as 1",
    "reward.data": "so_far, or step: of the step alone",
    "energy": "The battery and the propulsion of a rotary-wing UAV, see docs/symbols.md.",
}
ENERGY = """
# A battery in joules, see docs/symbols.md. Without the table no energy is counted.
# [energy]
# battery_j = 150e3
# ends = "both"  # steps, battery or both: what ends a mission
"""


def header(arguments: str) -> str:
    """The first comment of a file that `uav-dc scenario` made with these arguments."""
    return f"Made by: uav-dc scenario {arguments}\n{UNITS}"


def text(
    scenario: Scenario, comment: str = "", users_file: str | None = None, zones_file: str | None = None
) -> str:
    """The file's text, which `scenario.parse` reads as the same scenario; `comment` comes first.

    With `users_file` or `zones_file` the text names that file instead of the users or obstacles in it.
    """
    values = msgspec.to_builtins(scenario)
    if users_file is not None:
        others = {key: value for key, value in values["users"].items() if key != "user"}
        values["users"] = {"file": users_file, **others}
    if zones_file is not None:
        values = {key: value for key, value in values.items() if key != "obstacles"} | {"zones": zones_file}
    lines = [*(f"# {line}".rstrip() for line in comment.splitlines()), *([""] if comment else [])]
    lines += _table(values, ())
    return "\n".join(lines) + "\n" + ("" if scenario.energy else ENERGY)


def _table(values: dict[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    """Lines of a table: its keys, then the tables in it."""
    for key, value in values.items():
        if value is not None and not _tables(value):
            yield from _key(key, value, COMMENTS.get(".".join((*path, key)), ""))
    for key, value in values.items():
        inner = (*path, key)
        name = ".".join(inner)
        for table in _tables(value):
            yield ""
            if name in COMMENTS:
                yield f"# {COMMENTS[name]}"
            yield f"[{name}]" if isinstance(value, dict) else f"[[{name}]]"
            yield from _table(table, inner)


def _tables(value: Any) -> list[dict[str, Any]]:
    """The tables that a value is: one, those of an array, or none."""
    if isinstance(value, dict):
        return [value]
    is_array = isinstance(value, list | tuple) and value and all(isinstance(one, dict) for one in value)
    return list(value) if is_array else []


def _key(key: str, value: Any, comment: str) -> Iterator[str]:
    line, comment = f"{key} = {_value(value)}", comment and f"  # {comment}"
    if len(line + comment) <= WIDTH:
        yield line + comment
    elif isinstance(value, list | tuple):
        yield f"{key} = [{comment}"
        yield from (f"    {_value(one)}," for one in value)
        yield "]"
    else:
        yield from (comment.strip(), line) if comment else (line,)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return str(value)


def _number(value: float) -> str:
    """The shortest text that gives the same number: 100.0, 6e6, 0.015."""
    if 1e-4 <= abs(value) < 1e5 or value == 0.0:
        return repr(value)
    return np.format_float_scientific(value, trim="-", exp_digits=1).replace("e+", "e")
