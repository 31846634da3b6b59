"""The nodes' ROS parameters: each declared once, with description, unit and range. Knows no ROS."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from uav_dc_ros.bags.compression import COMPRESSIONS
from uav_dc_ros.core import pace
from uav_dc_ros.errors import ParameterError
from uav_dc_ros.messages import Run
from uav_dc_ros.topics import SIMULATED, VEHICLES

EXTERNAL = "external"  # what the world calls a vehicle that is not its own
WHOLE_MAX = 2**63 - 1  # of a ROS integer
SPLIT_MAX_S = 1e9  # thirty years
PORT_MAX = 65535


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A parameter.

    Its type is that of its default. It can be set until the node is configured, and again after the node
    was cleaned up: what a node has checked and loaded does not change under it.

    Attributes:
        name: its name.
        default: its value unless another is given.
        description: what it is for.
        unit: of its value; empty for names, counts and switches.
        least, most: range of a number.
        read_only: is it fixed when the node starts?
        parse: makes the value that the node uses; raises ParameterError.
    """

    name: str
    default: bool | int | float | str | list[str]
    description: str
    unit: str = ""
    least: float | None = None
    most: float | None = None
    read_only: bool = False
    parse: Callable[[Any], Any] | None = None

    @property
    def expected(self) -> str:
        """What is expected of its value, in words."""
        if self.least is None:
            words = {bool: "true or false", list: "a list of texts"}
            return words.get(type(self.default), "text")
        kind = "a whole number" if isinstance(self.default, int) else "a number"
        return f"{kind} from {self.least} to {self.most}{f' {self.unit}' if self.unit else ''}"

    def typed(self, given: Any) -> Any:
        """A value as one of the parameter's type, where it denotes one: `dwell_s:=1` and `pace:=90` do."""
        if isinstance(self.default, list):
            return list(given) if isinstance(given, list | tuple) else given
        if isinstance(self.default, str) and isinstance(given, bool | int | float):
            return str(given)
        if type(self.default) is float and type(given) is int:
            with contextlib.suppress(OverflowError):
                return float(given)
        return given

    def value(self, given: Any) -> Any:
        """The value that a node uses, checked.

        Raises:
            ParameterError: a value of another type, out of range, or that makes no sense.
        """
        given = self.typed(given)
        if type(given) is not type(self.default):
            raise ParameterError(f"{self.name}: {given!r}; expected {self.expected}")
        number: Any = given
        if self.least is not None and not self.least <= number <= (self.most or 0):
            raise ParameterError(f"{self.name}: {given!r}; expected {self.expected}")
        if self.parse is None:
            return given
        try:
            return self.parse(given)
        except ParameterError as error:
            raise ParameterError(f"{self.name}: {error}") from None


def _names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")] if text.strip() else []
    if "" in names:
        raise ParameterError(f"{text!r}; expected names of topics with a comma between")
    return names


def one_of(*choices: str) -> Callable[[str], str]:
    """The check of a text that is one of a few."""

    def check(text: str) -> str:
        if text not in choices:
            raise ParameterError(f"{text!r}; expected one of {', '.join(choices)}")
        return text

    return check


def _run(text: str) -> str:
    try:
        return msgspec.convert(text, Run)
    except msgspec.ValidationError:
        raise ParameterError(f"{text!r}; expected 16 hexadecimal digits in lower case, as a text") from None


AUTOSTART = Parameter(
    name="autostart",
    default=True,
    description="configure and activate at once; false: wait for a lifecycle manager",
    read_only=True,
)
PEERS = Parameter(
    name="peers",
    default=["world", "channel_monitor", "policy"],
    description="nodes of this mission, by name; it starts when all of them are there",
    read_only=True,
)
RUN = Parameter(
    name="run",
    default="",
    description="identity of this run of missions, 16 hexadecimal digits: the node ignores messages of every "
    "other run; empty: the vehicle draws one, the others adopt the vehicle's",
    read_only=True,
    parse=_run,
)
SCENARIO = Parameter(
    name="scenario", default="five_clusters", description="name of a shipped scenario, or path of a TOML file"
)
SCENARIO_OR_POLICYS = Parameter(
    name="scenario", default="", description="scenario of the mission; empty: the policy's own"
)
POLICY = Parameter(
    name="policy",
    default="five_clusters_dueling",
    description="name of a shipped policy, or its folder",
)
POLICY_IF_KNOWN = Parameter(
    name="policy", default="", description="policy that flies, by name or folder; empty: not known"
)
SEED = Parameter(
    name="seed", default=0, least=0, most=WHOLE_MAX, description="seed of the first mission's users"
)
MISSIONS = Parameter(
    name="missions",
    default=1,
    least=1,
    most=WHOLE_MAX,
    description="missions to fly, one after the other, with seeds that follow each other",
)
PACE = Parameter(
    name="pace",
    default=pace.LOCKSTEP,
    description="'lockstep', or how many times faster than real time",
    parse=pace.parse,
)
JOURNAL = Parameter(
    name="journal",
    default="",
    description="file in which the node keeps what it must know again after a restart, one file for one "
    "flight; empty: it forgets",
)
BAG = Parameter(name="bag", default="", description="folder of the new bag")
RESUME = Parameter(
    name="resume",
    default=False,
    description="go on with the bag of a recorder that was killed, instead of refusing an existing folder",
)
RECORDED_TOPICS = Parameter(
    name="topics",
    default="",
    description="topics to record, by name, with a comma between; empty: all in the node's namespace",
    parse=_names,
)
SPLIT_BYTES = Parameter(
    name="split_bytes",
    default=0,
    least=0,
    most=WHOLE_MAX,
    unit="bytes",
    description="size of a bag's file after which the next one is begun; 0: never",
)
SPLIT_S = Parameter(
    name="split_s",
    default=0.0,
    least=0.0,
    most=SPLIT_MAX_S,
    unit="s",
    description="time after which the next file of a bag is begun; 0: never",
)
COMPRESSION = Parameter(
    name="compression",
    default="zstd",
    description=f"how a bag's chunks are compressed: one of {', '.join(COMPRESSIONS)}",
    parse=one_of(*COMPRESSIONS),
)
MIN_FREE_BYTES = Parameter(
    name="min_free_bytes",
    default=256 * 2**20,
    least=0,
    most=WHOLE_MAX,
    unit="bytes",
    description="free space of the disk below which recording stops, and the bag is closed",
)
RATE_HZ = Parameter(
    name="rate",
    default=5.0,
    least=0.1,
    most=60.0,
    unit="Hz",
    description="how often path and markers are drawn, at most",
)
PORT = Parameter(
    name="port",
    default=8765,
    least=0,
    most=PORT_MAX,
    description="TCP port of the Foxglove WebSocket server; 0: any that is free",
)
ADDRESS = Parameter(
    name="address",
    default="127.0.0.1",
    description="network address that the server listens on; 0.0.0.0: all of this machine's",
)
VEHICLE_OF_WORLD = Parameter(
    name="vehicle",
    default=SIMULATED,
    description=f"'{SIMULATED}': this node flies it; '{EXTERNAL}': a bridge does, and here are the users",
    parse=one_of(SIMULATED, EXTERNAL),
)
VEHICLE_FLOWN = Parameter(
    name="vehicle",
    default=SIMULATED,
    description=f"what flies: '{SIMULATED}', or the way to a real one: one of {', '.join(VEHICLES)}",
    parse=one_of(SIMULATED, *VEHICLES),
)
BAG_FILES = (RECORDED_TOPICS, SPLIT_BYTES, SPLIT_S, COMPRESSION, MIN_FREE_BYTES)  # of who writes a bag
EVERY = (AUTOSTART, PEERS, RUN)  # that every node has
