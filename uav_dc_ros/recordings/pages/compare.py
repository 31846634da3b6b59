"""Missions or policies side by side: means with their intervals, curves, and paths.

A group is a bag; or, where one bag alone is looked at, each of its missions. Intervals are 95% bootstrap
intervals over the missions of a group. Groups that flew the same seeds are also compared seed by seed: the
same users stand at the same places there, so that less than chance is left in the difference.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from uav_dc_ros import __version__
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core import stats
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import BagError, ParameterError
from uav_dc_ros.messages import Phase
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.pages.missions import Flown, flown, significant
from uav_dc_ros.recordings.pages.page import PAGE_MAX, Page
from uav_dc_ros.recordings.pages.world import world
from uav_dc_ros.recordings.recorded_step import printable
from uav_dc_ros.recordings.thinning import spread

GROUPS_MAX = 8  # more colours and dashes nobody tells apart
TRACKS_MAX = 20  # of a group, in a picture
POINTS_MAX = 400  # of a curve
METRICS = ("landed", "users_collected", "data_bits", "sum_rate_bps", "distance_m", "steps", "reward")
CURVES = ("n_collected", "sum_rate_bps", "reward")


@dataclass
class Group:
    """Missions that are told together."""

    label: str
    scenario: Scenario
    policy: str
    bag: str
    summaries: list[dict[str, Any]] = field(default_factory=list)
    curves: list[dict[str, Array]] = field(default_factory=list)  # by name of CURVES, and `step`
    tracks: list[list[list[float]]] = field(default_factory=list)  # x, y, z of a path, metres

    def add(self, one: Flown) -> None:
        """One more mission."""
        course = one.course()
        summary = one.summary()
        self.summaries.append(summary | {"landed": float(summary["outcome"] == Phase.LANDED)})
        self.curves.append(
            {
                "step": np.asarray([it["step"] for it in course]),
                "n_collected": np.asarray([it["n_collected"] for it in course], np.float64),
                "sum_rate_bps": _held([it["sum_rate_bps"] for it in course]),
                "reward": _held([it["reward"][2] for it in course]),
            }
        )
        if len(self.tracks) < TRACKS_MAX:
            path = np.asarray([it["uav_m"] for it in course if it["uav_m"] is not None]).reshape(-1, 3)
            self.tracks.append(path.T.tolist())

    def values(self, metric: str) -> Array:
        """A metric of each mission, `[n]`."""
        return np.asarray([summary[metric] for summary in self.summaries], np.float64)


def page(
    bags: list[Path], missions: list[int] | None, scenario: str | None, namespace: str | None
) -> tuple[Page, str]:
    """The page, and what is in it, in words.

    Args:
        bags: one: its missions side by side; several: those bags.
        missions: indices of those to look at; all, unless told.
        scenario, namespace: as `steps.scenario` and `steps.namespace` take them.

    Raises:
        BagError: a bag cannot be read, or has none of these missions.
        ParameterError: more groups than a picture can tell apart.
    """
    if len(bags) > GROUPS_MAX:
        raise ParameterError(f"--compare: {len(bags)} bags; expected at most {GROUPS_MAX}")
    groups: list[Group] = []
    for bag, label in zip(bags, _labels(bags), strict=True):
        groups += _groups(bag, label, missions, scenario, namespace, apart=len(bags) == 1)
    first = groups[0].scenario
    title = f"{first.name}: {len(groups)} {'bags' if len(bags) > 1 else 'missions'} side by side"
    made = Page("compare", title)
    last = max(int(curve["step"][-1]) for group in groups for curve in group.curves)
    axis = spread(last + 1, POINTS_MAX)
    data = {
        "title": title,
        "version": __version__,
        "world": world(first),
        "steps": axis.tolist(),
        "worlds_differ": len({group.scenario.fingerprint for group in groups}) > 1,
        "rewards_differ": len({repr(group.scenario.reward) for group in groups}) > 1,
        "groups": [_group(group, groups[0], axis) for group in groups],
    }
    if not made.add("data", data):
        raise BagError(f"the comparison does not fit into {PAGE_MAX / 1e6:.0f} MB; expected fewer bags")
    n_missions = sum(len(group.summaries) for group in groups)
    return made, f"{n_missions} missions in {len(groups)} groups"


def _labels(bags: list[Path]) -> list[str]:
    """Names of bags; with their folders, where names alone are equal."""
    names = [printable(bag.absolute().name) for bag in bags]
    return names if len(set(names)) == len(names) else [printable(str(bag)) for bag in bags]


def _groups(
    bag: Path, label: str, missions: list[int] | None, wanted: str | None, namespace: str | None, apart: bool
) -> list[Group]:
    """The group of a bag; or, `apart`, a group for each of its missions."""
    groups: list[Group] = []
    with BagReader(bag) as reader:
        name = step_reader.namespace(reader, namespace)
        scenario = step_reader.scenario(reader, name, wanted)
        policy = reader.about.get("policy", "unknown policy")
        recorded = step_reader.Steps(reader, name, scenario.step_ns)
        for one in flown(iter(recorded), scenario):
            if missions is not None and one.index not in missions:
                continue
            if apart and len(groups) == GROUPS_MAX:
                raise ParameterError(
                    f"--compare: bag {bag} has more missions than can be told apart; expected up to "
                    f"{GROUPS_MAX}: --mission N ..."
                )
            if apart or not groups:
                flight = f" of flight {one.flight}" if one.flight else ""
                told = f"mission {one.index}{flight}" if apart else label
                groups.append(Group(told, scenario, policy, label))
            groups[-1].add(one)
    if not groups:
        wanted, why = "that is wanted " if missions else "", "; ".join(recorded.rejected.lines())
        raise BagError(f"bag {bag}: no step of a mission {wanted}is in it{why and f': {why}'}")
    return groups


def _group(group: Group, first: Group, axis: Array) -> dict[str, Any]:
    """A group as the page's data."""
    return {
        "label": group.label,
        "bag": group.bag,
        "policy": group.policy,
        "scenario": group.scenario.name,
        "users": group.scenario.n_users,
        "missions": len(group.summaries),
        "seeds": _seeds(group),
        "metrics": {metric: _interval(group.values(metric)) for metric in METRICS},
        "paired": None if group is first else _paired(group, first),
        "curves": {name: _band(group, name, axis) for name in CURVES},
        "tracks": group.tracks,
    }


def _seeds(group: Group) -> str:
    seeds = sorted({s["seed"] for s in group.summaries if s["seed"] is not None})
    if len(seeds) > 1 and seeds == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    told = ", ".join(map(str, seeds[:10]))
    return f"{told}, …" if len(seeds) > 10 else told


def _interval(values: Array) -> dict[str, float | None]:
    """Mean, and the ends of its interval; of one value there is none."""
    if len(values) < 2:
        return {"mean": float(values.mean()), "low": None, "high": None}
    return stats.interval(values)._asdict()


def _paired(group: Group, first: Group) -> dict[str, Any] | None:
    """What a group has more than the first one, seed by seed; None without two seeds in common.

    In another world the same seed makes other users: nothing is compared there.
    """
    if group.scenario.fingerprint != first.scenario.fingerprint:
        return None
    mine, theirs = ({s["seed"]: s for s in it.summaries if s["seed"] is not None} for it in (group, first))
    common = sorted(set(mine) & set(theirs))
    if len(common) < 2:
        return None
    differences = {
        metric: _interval(np.asarray([mine[seed][metric] - theirs[seed][metric] for seed in common]))
        for metric in METRICS
    }
    return {"seeds": len(common), "differences": differences}


def _band(group: Group, name: str, axis: Array) -> dict[str, list[float]]:
    """Mean and interval at each step of the axis; a mission that is over stays as it ended, at no rate."""
    rows = []
    for curve in group.curves:
        place = np.searchsorted(curve["step"], axis, side="right") - 1
        row = curve[name][np.maximum(place, 0)]
        over = axis > curve["step"][-1]
        rows.append(np.where(over, 0.0, row) if name == "sum_rate_bps" else row)
    told = stats.band(np.asarray(rows))
    return {key: significant(values) for key, values in zip(("mean", "low", "high"), told, strict=True)}


def _held(values: list[float | None]) -> Array:
    """Values `[T]`; where one is not known, the one before it; 0 before the first."""
    held: list[float] = []
    for value in values:
        held.append(value if value is not None else (held[-1] if held else 0.0))
    return np.asarray(held)
