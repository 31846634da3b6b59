"""What a run of missions is made of: the options of run_all, and of `fly` from Python."""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from uav_dc_ros import cli
from uav_dc_ros.core import pace as paces
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.topics import SIMULATED, SYSTEM_MAX, VEHICLES

PORT_MAX = 65535


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """A run of missions: the options of run_all. What depends on this machine is checked when it flies.

    Attributes:
        scenario: name of a shipped scenario, or the path of a TOML file.
        policy: name of a shipped policy, or its folder; None: the scenario's name with `_dueling`.
        seed: seed of the first mission's users; each further mission takes the next one.
        missions: number of missions.
        pace: how many times faster than real time, or `lockstep`: as fast as the nodes can.
        vehicle: what flies: `simulated`, `mavlink`, `mavros` or `px4`.
        connect: address of a vehicle on MAVLink.
        system: its MAVLink system number; None: the only autopilot on the link.
        arm: does the bridge arm the vehicle and take off?
        datum: where the grid's corner lies: `here`, `last` or `LAT,LON,ALT`.
        settings: parameters of nodes by `NODE.PARAMETER`. Text is read as `--set` reads it.
        bag: folder of the new bag; None: a dated one in `bags/`.
        record: is a bag written?
        namespace: ROS namespace of the mission.
        nodes: nodes to start on this host; None: all.
        compose: do world, channel monitor and policy share a process? None: in lockstep.
        live: TCP port of the Foxglove server; None: there is none.
        summary: file for the summary as JSON; None: there is none.

    Raises:
        ParameterError: a value that no run can have.
    """

    scenario: str | Path = "five_clusters"
    policy: str | Path | None = None
    seed: int = 0
    missions: int = 1
    pace: float | Literal["lockstep"] = paces.WATCHABLE
    vehicle: str = SIMULATED
    connect: str | None = None
    system: int | None = None
    arm: bool = False
    datum: str | None = None
    settings: Mapping[str, object] = field(default_factory=dict)
    bag: str | Path | None = None
    record: bool = True
    namespace: str = "/"
    nodes: tuple[str, ...] | None = None
    compose: bool | None = None
    live: int | None = None
    summary: str | Path | None = None

    def __post_init__(self) -> None:
        """Check each value by itself."""
        for name in ("scenario", "policy", "bag", "summary"):
            value = getattr(self, name)
            optional = name != "scenario"
            if not (isinstance(value, str | Path) or (optional and value is None)):
                raise ParameterError(f"{name}: {value!r}; expected text or a path")
        for name, least, most in (
            ("seed", 0, 2**62 - 1),  # so that sums of it still fit into 64 bits
            ("missions", 1, 2**62 - 1),
            ("system", 1, SYSTEM_MAX),
            ("live", 0, PORT_MAX),
        ):
            self._check_whole(name, least, most)
        if self.pace != paces.LOCKSTEP:
            if isinstance(self.pace, bool) or not isinstance(self.pace, int | float):
                raise ParameterError(f"pace: {self.pace!r}; expected {paces.LOCKSTEP!r} or a number above 0")
            paces.parse(repr(self.pace))
        if self.vehicle not in (SIMULATED, *VEHICLES):
            raise ParameterError(
                f"vehicle: {self.vehicle!r}; expected one of {', '.join((SIMULATED, *VEHICLES))}"
            )
        for name in ("arm", "record"):
            self._check_flag(name)
        if self.compose is not None:
            self._check_flag("compose")
        if not self.record and self.bag is not None:
            raise ParameterError(f"bag: {str(self.bag)!r}, with record = False; expected one or the other")
        for key in self.settings:
            if not all(str(key).partition(".")):
                raise ParameterError(f"settings: {key!r}; expected NODE.PARAMETER, such as bridge.then")
        self._check_namespace()
        self._check_nodes()

    @property
    def factor(self) -> float | None:
        """How many times faster than real time; None in lockstep."""
        return None if self.pace == paces.LOCKSTEP else float(self.pace)

    def _check_whole(self, name: str, least: int, most: int) -> None:
        value = getattr(self, name)
        if value is None and name in ("system", "live"):
            return
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise ParameterError(f"{name}: {value!r}; expected a whole number from {least} to {most}")

    def _check_flag(self, name: str) -> None:
        if not isinstance(getattr(self, name), bool):
            raise ParameterError(f"{name}: {getattr(self, name)!r}; expected True or False")

    def _check_namespace(self) -> None:
        try:
            object.__setattr__(self, "namespace", cli.namespace(self.namespace))
        except argparse.ArgumentTypeError as error:
            raise ParameterError(f"namespace: {error}") from None

    def _check_nodes(self) -> None:
        names = self.nodes
        if names is None:
            return
        if isinstance(names, str) or not names or len(set(names)) < len(names):
            raise ParameterError(f"nodes: {names!r}; expected names of nodes, each once")
        object.__setattr__(self, "nodes", tuple(names))
