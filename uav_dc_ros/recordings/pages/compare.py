"""Missions or policies side by side: means with intervals, curves, and paths.

A group is a bag; or, with one bag only, a mission. Intervals are 95% bootstrap intervals over the missions of
a group. Groups with the same seeds are also compared seed by seed: their users are at the same positions,
which leaves less chance in the difference.
"""

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from uav_dc_ros import __version__
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core import stats
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.reward import MISSION_REWARD
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.users.service import FIGURES
from uav_dc_ros.errors import BagError, ParameterError
from uav_dc_ros.messages import Phase, printable
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.pages.missions import BATTERY, MissionData, read_missions, significant
from uav_dc_ros.recordings.pages.page import PAGE_MAX, Page, world_data
from uav_dc_ros.recordings.recorded_step import mission_name
from uav_dc_ros.recordings.thinning import spread

GROUPS_MAX = 8  # distinguishable colours and dashes
PATHS_MAX = 20  # of a group, in a picture
POINTS_MAX = 400  # of a curve
METRICS = (
    "landed",
    "users_collected",
    "data_bits",
    "sum_rate_bps",
    "distance_m",
    "steps",
    "reward",
    *FIGURES,
)
CHARGE = "state_of_charge"  # further curve of a world with a battery


@dataclass
class Group:
    """Missions whose results are combined."""

    label: str
    scenario: Scenario
    policy: str
    bag: str
    summaries: list[dict[str, Any]] = field(default_factory=list)
    curves: list[dict[str, Array]] = field(default_factory=list)  # by name, and `step`
    paths: list[list[list[float]]] = field(default_factory=list)  # x, y, z, metres

    def add(self, mission: MissionData) -> None:
        """Add a mission."""
        steps, summary = mission.steps(), mission.summary()
        self.summaries.append(summary | {"landed": float(summary["outcome"] == Phase.LANDED)})
        self.curves.append(
            {
                "step": np.asarray([it["step"] for it in steps]),
                "n_collected": np.asarray([it["n_collected"] for it in steps], np.float64),
                "sum_rate_bps": _filled([it["sum_rate_bps"] for it in steps]),
                "reward": _filled([it["reward"][2] for it in steps]),
                **({CHARGE: _filled([it[CHARGE] for it in steps], 1.0)} if self.scenario.energy else {}),
            }
        )
        if len(self.paths) < PATHS_MAX:
            path = np.asarray([it["uav_m"] for it in steps if it["uav_m"] is not None]).reshape(-1, 3)
            self.paths.append(path.T.tolist())

    def data(self, first: "Group", axis: Array) -> dict[str, Any]:
        """Page data; `first`: the group to compare with; `axis`: steps of the curves, `[T]`."""
        return {
            "label": self.label,
            "bag": self.bag,
            "policy": self.policy,
            "scenario": self.scenario.name,
            "users": self.scenario.n_users,
            "missions": len(self.summaries),
            "seeds": self._seeds(),
            "metrics": {name: self._metric(name) for name in self._metrics()},
            "paired": None if self is first else self._paired(first),
            "curves": {name: self._band(name, axis) for name in self.curves[0] if name != "step"},
            "paths": self.paths,
        }

    def _metrics(self) -> tuple[str, ...]:
        return (*METRICS, *BATTERY) if self.scenario.energy else METRICS

    def _metric(self, name: str) -> dict[str, float | None] | None:
        """Mean and 95% interval over the missions that have it; no interval of one, and None of none."""
        values = np.asarray([it[name] for it in self.summaries if it[name] is not None], np.float64)
        if not values.size:
            return None
        if len(values) < 2:
            return {"mean": float(values.mean()), "low": None, "high": None}
        found = stats.interval(values)
        return (found.within(0.0, 1.0) if name == "landed" else found)._asdict()

    def _by_seed(self) -> dict[int, dict[str, Any]]:
        return {summary["seed"]: summary for summary in self.summaries if summary["seed"] is not None}

    def _seeds(self) -> str:
        seeds = sorted(self._by_seed())
        if len(seeds) > 1 and seeds == list(range(seeds[0], seeds[-1] + 1)):
            return f"{seeds[0]} to {seeds[-1]}"
        listed = ", ".join(map(str, seeds[:10]))
        return f"{listed}, …" if len(seeds) > 10 else listed

    def _paired(self, first: "Group") -> dict[str, Any] | None:
        """Differences to the first group, seed by seed; None without two common seeds in the same world."""
        if self.scenario.fingerprint != first.scenario.fingerprint:
            return None
        mine, theirs = self._by_seed(), first._by_seed()
        common = sorted(set(mine) & set(theirs))
        if len(common) < 2:
            return None
        pairs = [(mine[seed], theirs[seed]) for seed in common]
        differences = {
            name: stats.interval(values)._asdict()
            for name in self._metrics()
            if len(values := [a[name] - b[name] for a, b in pairs if None not in (a[name], b[name])]) > 1
        }
        return {"seeds": len(common), "differences": differences}

    def _band(self, name: str, axis: Array) -> dict[str, list[float]]:
        """Mean and interval at each step of the axis. After its end a mission keeps its values, at rate 0."""
        rows = []
        for curve in self.curves:
            index = np.searchsorted(curve["step"], axis, side="right") - 1
            row = curve[name][np.maximum(index, 0)]
            rows.append(np.where(axis > curve["step"][-1], 0.0, row) if name == "sum_rate_bps" else row)
        band = stats.band(np.asarray(rows))
        return {key: significant(values) for key, values in zip(("mean", "low", "high"), band, strict=True)}


def page(options: argparse.Namespace) -> tuple[Page, str]:
    """The page, and its content in a few words; raises ParameterError for more than `GROUPS_MAX` groups."""
    bags: list[Path] = [options.bag, *options.compare]
    if len(bags) > GROUPS_MAX:
        raise ParameterError(f"--compare: {len(bags)} bags; expected at most {GROUPS_MAX}")
    labels = [printable(bag.absolute().name) for bag in bags]
    if len(set(labels)) < len(labels):
        labels = [printable(str(bag)) for bag in bags]
    groups: list[Group] = []
    for bag, label in zip(bags, labels, strict=True):
        groups += _groups(bag, label, options, split=len(bags) == 1)
    first = groups[0]
    title = f"{first.scenario.name}: {len(groups)} {'bags' if len(bags) > 1 else 'missions'} side by side"
    axis = spread(max(int(curve["step"][-1]) for group in groups for curve in group.curves) + 1, POINTS_MAX)
    words = dict.fromkeys(MISSION_REWARD[group.scenario.reward.data] for group in groups)
    data = {
        "title": title,
        "version": __version__,
        "world": world_data(first.scenario),
        "steps": axis.tolist(),
        "worlds_differ": len({group.scenario.fingerprint for group in groups}) > 1,
        "rewards_differ": len({repr(group.scenario.reward) for group in groups}) > 1,
        "reward_words": " or ".join(words),
        "groups": [group.data(first, axis) for group in groups],
    }
    made = Page("compare", title)
    if not made.add("data", data):
        raise BagError(f"the comparison does not fit into {PAGE_MAX / 1e6:.0f} MB; expected fewer bags")
    return made, f"{sum(len(group.summaries) for group in groups)} missions in {len(groups)} groups"


def _groups(bag: Path, label: str, options: argparse.Namespace, split: bool) -> list[Group]:
    """The group of a bag; or, with `split`, a group for each of its missions."""
    groups: list[Group] = []
    missions: list[int] | None = options.mission
    with BagReader(bag) as reader:
        name = step_reader.namespace(reader, options.namespace)
        scenario = step_reader.scenario(reader, name, options.scenario)
        policy = reader.about.get("policy", "unknown policy")
        recorded = step_reader.Steps(reader, name, scenario.step_ns)
        for mission in read_missions(recorded, scenario, False):
            if missions is not None and mission.index not in missions:
                continue
            if split and len(groups) == GROUPS_MAX:
                raise ParameterError(
                    f"--compare: bag {bag} has more missions than a picture shows; expected up to "
                    f"{GROUPS_MAX}: --mission N ..."
                )
            if split or not groups:
                own = mission_name(mission.index, mission.flight) if split else label
                groups.append(Group(own, scenario, policy, label))
            groups[-1].add(mission)
    if not groups:
        raise BagError(no_step(bag, missions, recorded))
    return groups


def no_step(bag: Path, missions: list[int] | None, recorded: step_reader.Steps) -> str:
    """Why a bag has no page."""
    wanted = "" if missions is None else f" {', '.join(map(str, missions))}"
    why = "; ".join(recorded.rejected.lines())
    return f"bag {bag} holds no step of a mission{wanted}{why and f': {why}'}"


def _filled(values: list[float | None], first: float = 0.0) -> Array:
    """Values `[T]`. An unknown one equals the one before; it is `first` at the start."""
    filled: list[float] = []
    for value in values:
        filled.append(value if value is not None else (filled[-1] if filled else first))
    return np.asarray(filled)
