"""A run of missions: the options of run_all, and of `fly` from Python."""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Literal

from uav_dc_ros import cli
from uav_dc_ros.core import pace as paces
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.topics import SIMULATED, SYSTEM_MAX, VEHICLES

PORT_MAX = 65535
SEARCH_MAX = 1024  # missions of a search
SEARCH_TIME_S = (0.001, 3600.0)  # range of its time limit
RANGES = {  # of whole numbers
    "seed": (0, 2**62 - 1),  # sums of it fit into 64 bits
    "missions": (1, 2**62 - 1),
    "system": (1, SYSTEM_MAX),
    "live": (0, PORT_MAX),
    "view": (0, PORT_MAX),
    "search": (0, SEARCH_MAX),
}
OPTIONAL = ("policy", "objective", "bag", "summary", "system", "live", "view", "compose", "search_time_limit")


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """A run of missions: the options of run_all. Raises ParameterError for an invalid value.

    `MissionRunner` checks what depends on this machine.
    """

    scenario: str | Path = "five_clusters"  # a shipped one, the path of a TOML file, or `random:SEED`
    # Shipped policy, its folder, or a planner; None: the scenario's name with `_dueling`
    policy: str | Path | None = None
    objective: float | None = None  # weight w of the users in a planner's objective, 0 to 1; None: 10/11
    search: int = 0  # missions that a policy flies in a model before each move; 0: it does not search
    # Time of a search, seconds; None: half of a step's time, and no limit in lockstep
    search_time_limit: float | None = None
    seed: int = 0  # seed of the first mission's users; each further mission takes the next one
    missions: int = 1  # number of missions
    pace: float | Literal["lockstep"] = paces.WATCHABLE  # times faster than real time, or as fast as possible
    vehicle: str = SIMULATED  # `simulated`, `mavlink`, `mavros` or `px4`
    connect: str | None = None  # address of a vehicle on MAVLink
    system: int | None = None  # its MAVLink system number; None: the only autopilot on the link
    arm: bool = False  # whether the bridge arms the vehicle and takes off
    datum: str | None = None  # position of the grid's corner: `here`, `last` or `LAT,LON,ALT`
    upload_fence: bool = False  # whether the bridge uploads its fence to an autopilot on MAVLink
    # Parameters of nodes by `NODE.PARAMETER`. Text is parsed as by `--set`.
    settings: Mapping[str, object] = field(default_factory=dict)
    bag: str | Path | None = None  # folder of the new bag; None: a dated one in `bags/`
    record: bool = True  # whether a bag is written
    namespace: str = "/"  # ROS namespace of the mission
    nodes: tuple[str, ...] | None = None  # nodes to start on this host; None: all
    # Whether world, channel monitor and policy share a process; None: in lockstep.
    compose: bool | None = None
    live: int | None = None  # TCP port of the Foxglove server; None: no server
    view: int | None = None  # TCP port of the page that shows the mission; 0: any; None: no page
    summary: str | Path | None = None  # JSON file for the summary; None: no file

    def __post_init__(self) -> None:
        """Check each value."""
        for name in ("scenario", "policy", "bag", "summary"):
            self._check_type(name, str | Path, "text or a path")
        for name in ("arm", "upload_fence", "record", "compose"):
            self._check_type(name, bool, "True or False")
        for name, (minimum, maximum) in RANGES.items():
            value = getattr(self, name)
            expected = f"a whole number from {minimum} to {maximum}"
            self._check_type(name, int, expected)
            if value is not None and (isinstance(value, bool) or not minimum <= value <= maximum):
                raise ParameterError(f"{name}: {value!r}; expected {expected}")
        if self.pace != paces.LOCKSTEP:
            if isinstance(self.pace, bool) or not isinstance(self.pace, int | float):
                raise ParameterError(f"pace: {self.pace!r}; expected {paces.LOCKSTEP!r} or a number above 0")
            paces.parse(repr(self.pace))
        self._check_type("objective", int | float, "a number from 0 to 1")
        if self.objective is not None and not 0.0 <= self.objective <= 1.0:
            raise ParameterError(f"objective: {self.objective!r}; expected a number from 0 to 1")
        low_s, high_s = SEARCH_TIME_S
        expected = f"a number of seconds from {low_s:g} to {high_s:g}"
        self._check_type("search_time_limit", int | float, expected)
        if self.search_time_limit is not None and not low_s <= self.search_time_limit <= high_s:
            raise ParameterError(f"search_time_limit: {self.search_time_limit!r}; expected {expected}")
        if self.vehicle not in (SIMULATED, *VEHICLES):
            expected = ", ".join((SIMULATED, *VEHICLES))
            raise ParameterError(f"vehicle: {self.vehicle!r}; expected one of {expected}")
        if not self.record and self.bag is not None:
            raise ParameterError(f"bag: {str(self.bag)!r}, with record = False; expected one or the other")
        for key in self.settings:
            if not all(str(key).partition(".")):
                expected = "NODE.PARAMETER, such as bridge.failsafe_action"
                raise ParameterError(f"settings: {key!r}; expected {expected}")
        try:
            object.__setattr__(self, "namespace", cli.namespace(self.namespace))
        except argparse.ArgumentTypeError as error:
            raise ParameterError(f"namespace: {error}") from None
        if self.nodes is not None:
            if isinstance(self.nodes, str) or not self.nodes or len(set(self.nodes)) < len(self.nodes):
                raise ParameterError(f"nodes: {self.nodes!r}; expected names of nodes, each once")
            object.__setattr__(self, "nodes", tuple(self.nodes))

    @property
    def factor(self) -> float | None:
        """How many times faster than real time; None in lockstep."""
        return None if self.pace == paces.LOCKSTEP else float(self.pace)

    def _check_type(self, name: str, expected_type: type | UnionType, expected: str) -> None:
        value = getattr(self, name)
        if not isinstance(value, expected_type) and not (value is None and name in OPTIONAL):
            raise ParameterError(f"{name}: {value!r}; expected {expected}")
