"""Shifts of `evaluate --shift`: a scenario with some values changed, and users that send nothing.

A policy knows its own vehicle and mission: it observes with the shifted scenario, as in a flight. It does not
know that the users have moved: its map, the positions in `users`, is that of the scenario without the shift.

Three changes are of no key of a scenario: `users.missing`, `users.position_error` and `grid.cells`.
"""

import argparse
import difflib
import re
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypeAlias, cast

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.keys import leaves
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.errors import ScenarioError
from uav_dc_ros.experiments.evaluate.field_shifts import misplaced, refined

MISSING = "users.missing"  # the share of the users that sends nothing
POSITION_ERROR = "users.position_error"  # see `field_shifts.misplaced`
CELLS = "grid.cells"  # see `field_shifts.refined`
NO_KEYS = {MISSING: "%", POSITION_ERROR: "%", CELLS: "x"}  # changes of no key of a scenario: operator of each
EXPECTED = (
    "expected KEY=VALUE (KEY==VALUE for a negative one), KEY=+DELTA, KEY=-DELTA, KEY=xFACTOR, "
    f"{MISSING}=SHARE%, {POSITION_ERROR}=SHARE% or {CELLS}=xN, with ',' between"
)
_KEY = r"\w+(?:\[[0-9]+\])*(?:\.\w+(?:\[[0-9]+\])*)*"
_NUMBER = r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_CHANGE = re.compile(rf"({_KEY})(?:=(=)(-?{_NUMBER})|=([-+x]?)({_NUMBER})(%?))", re.ASCII)

Operator: TypeAlias = Literal["=", "+", "-", "x", "%"]


class Change(NamedTuple):
    """A change of one key."""

    key: str  # dotted path, with `[i]` for an element of a list
    operator: Operator  # `=` sets, `+` and `-` add, `x` multiplies, `%` is that of shares in `NO_KEYS`
    number: float


class ShiftRequest(NamedTuple):
    """The value of one `--shift`."""

    text: str
    changes: tuple[Change, ...]


class ShiftedValue(msgspec.Struct, frozen=True, kw_only=True):
    """A changed value: a number, a list with nested lists of numbers, or null for a key that was not set."""

    key: str
    before: Any
    after: Any


class Shift(msgspec.Struct, frozen=True, kw_only=True):
    """A shift in the results."""

    text: str  # as in `--shift`
    values: list[ShiftedValue]  # changed values, in the order of the text

    @property
    def missing(self) -> float:
        """Share of the users that sends nothing, 0 to 1."""
        return next((float(value.after) for value in self.values if value.key == MISSING), 0.0)


class ShiftedWorld(NamedTuple):
    """A scenario, or a shifted one."""

    scenario: Scenario  # in which missions are flown
    known: Scenario  # with which a policy observes
    shift: Shift | UnsetType = UNSET


def parse(text: str) -> ShiftRequest:
    """The type of the option `--shift`."""
    changes = tuple(map(_change, text.split(",")))
    keys = [change.key for change in changes]
    if (double := next((key for key in keys if keys.count(key) > 1), None)) is not None:
        raise argparse.ArgumentTypeError(
            f"{text!r}: {double} is changed {keys.count(double)} times; expected once"
        )
    return ShiftRequest(text, changes)


def apply(request: ShiftRequest, scenario: Scenario) -> ShiftedWorld:
    """The world of a scenario after a shift.

    Raises:
        ScenarioError: an unknown key, a key that is no number, or a world that `scenario.parse` rejects.
    """
    source = f"--shift {request.text} in {scenario.name!r}"
    values = msgspec.json.decode(msgspec.json.encode(scenario))
    shifted = []
    for change in request.changes:
        if change.key in NO_KEYS:
            shifted.append(_shifted_field(change, values, scenario, source))
            continue
        holders = _find(values, change.key, source)
        before = [holder[part] for holder, part in holders]
        after = [_changed(value, change, source) for value in before]
        for (holder, part), value in zip(holders, after, strict=True):
            holder[part] = value
        one = len(holders) == 1
        shifted.append(
            ShiftedValue(
                key=change.key, before=before[0] if one else before, after=after[0] if one else after
            )
        )
    flown = from_values(values, source)
    return ShiftedWorld(flown, _placed_as(scenario, flown), Shift(text=request.text, values=shifted))


def _shifted_field(change: Change, values: dict[str, Any], scenario: Scenario, source: str) -> ShiftedValue:
    """Apply a change of no key to the plain values of a scenario, which change in place."""
    key, number = change.key, change.number
    if key == CELLS:
        if number not in range(2, 1000):
            raise ScenarioError(f"{source}: {key} = x{number:g}; expected x and a whole number from 2 to 999")
        refined(values, int(number))
        return ShiftedValue(key=key, before=1, after=int(number))
    share = number / 100.0
    if key == MISSING and (not n_missing(scenario, share) or share > 1.0):
        n = scenario.n_users
        raise ScenarioError(
            f"{source}: {key} = {number:g}%; expected at least one and at most all of {n} users"
        )
    if key == POSITION_ERROR:
        if not 0.0 < share <= 1.0:
            raise ScenarioError(f"{source}: {key} = {number:g}%; expected above 0% and at most 100%")
        misplaced(values, scenario, share, source)
    return ShiftedValue(key=key, before=0.0, after=share)


def _placed_as(before: Scenario, after: Scenario) -> Scenario:
    """The scenario after a shift, with the users' positions before it."""
    listed = tuple(
        msgspec.structs.replace(user, x_m=own.x_m, y_m=own.y_m)
        for user, own in zip(after.users.user, before.users.user, strict=True)
    )
    centres_m = before.users.cluster_centres_m
    users = msgspec.structs.replace(after.users, cluster_centres_m=centres_m, user=listed)
    return msgspec.structs.replace(after, users=users)


def n_missing(scenario: Scenario, share: float) -> int:
    """Users that send nothing, of a share from 0 to 1."""
    return round(share * scenario.n_users)


def transmitting(scenario: Scenario, seeds: Sequence[int], missing: float) -> Array:
    """Which users send in the missions of seeds, where a share of them does not, bool `[S, U]`.

    A user that is missing at a share is also missing at every greater one.
    """
    # Other draws than those of the mission, which stays the same.
    ranks = [np.random.default_rng([seed, 1]).permutation(scenario.n_users) for seed in seeds]
    return np.stack(ranks) >= n_missing(scenario, missing)


def senders(scenario: Scenario, seeds: Sequence[int], shift: Shift | UnsetType) -> Array | None:
    """Which users send in the missions of seeds after a shift, as `transmitting`; None: all."""
    if shift is UNSET or not shift.missing:
        return None
    return transmitting(scenario, seeds, shift.missing)


def _change(text: str) -> Change:
    match = _CHANGE.fullmatch(text.strip())
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r}; {EXPECTED}")
    key, sets, value, operator, number, percent = match.groups()
    given = f"{sets or ''}{operator or ''}{percent or ''}"
    if NO_KEYS.get(key, given) != given or (key not in NO_KEYS and percent):
        raise argparse.ArgumentTypeError(f"{text!r}; {EXPECTED}")
    return Change(key, cast(Operator, percent or sets or operator or "="), float(value or number))


def _find(values: Any, path: str, source: str) -> list[tuple[Any, str | int]]:
    """The table or list that holds a key, and the key's last part; of a list of tables, each of them."""
    here, holders = [values], []
    try:
        for name in re.findall(r"\w+", path):
            part = int(name) if name.isdecimal() else name
            if isinstance(part, str):
                here = [table for entry in here for table in (entry if isinstance(entry, list) else [entry])]
            holders = [(entry, part) for entry in here]
            here = [entry[part] for entry in here]
    except (KeyError, IndexError, TypeError):
        known = [key for key, value in leaves(values) if isinstance(value, float | int)]
        close = difflib.get_close_matches(path, known, n=1)
        hint = f"did you mean {close[0]}?" if close else f"expected a numeric key, such as {known[-1]}"
        raise ScenarioError(f"{source}: unknown key {path}; {hint}") from None
    return holders


def _changed(value: Any, change: Change, source: str) -> Any:
    """A value after a change; of a list, every element."""
    operator, number = change.operator, change.number
    if isinstance(value, list) and operator != "=":
        return [_changed(entry, change, source) for entry in value]
    if value is None and operator == "=":
        return number
    if isinstance(value, bool) or not isinstance(value, int | float):
        kind = {list: "a list", dict: "a table", type(None): "not set"}.get(type(value), repr(value))
        expected = {
            list: "+DELTA, -DELTA, xFACTOR, or one of its elements",
            dict: "one of its keys",
            type(None): "=VALUE",
        }.get(type(value), "a numeric key")
        raise ScenarioError(f"{source}: {change.key} is {kind}; expected {expected}")
    after = {"=": number, "+": value + number, "-": value - number, "x": value * number}[operator]
    if isinstance(value, float):
        return after
    if not after.is_integer():
        raise ScenarioError(f"{source}: {change.key} = {after:g}; expected a whole number")
    return int(after)
