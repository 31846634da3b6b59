"""Flies missions for the benchmarks of the nodes, and reads from their bags how it went."""

import itertools
import os
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from rosbags.highlevel import AnyReader

NODES = ("world", "channel_monitor", "policy", "recorder")
ENVIRONMENT = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


@dataclass(frozen=True, kw_only=True)
class Flown:
    """What a bag tells of a flight.

    Attributes:
        step_ms: time between one step and the next, milliseconds, in order.
        payload_bytes: median size of a message, by topic.
        diagnostics: what each node told of itself, once a second, in order: values by name.
    """

    step_ms: list[float]
    payload_bytes: dict[str, float]
    diagnostics: dict[str, list[dict[str, str]]]

    def cpu_percent(self, node: str, skip: int = 2) -> float:
        """Share of a core that a node took, percent, median over the seconds after start-up."""
        told = [float(values["cpu [%]"]) for values in self.diagnostics[node][skip:]]
        return statistics.median(told) if told else float("nan")

    def processes(self, nodes: tuple[str, ...]) -> list[list[str]]:
        """The nodes, those of one process together."""
        ids = {node: self.diagnostics[node][-1]["process id"] for node in nodes}
        return [[node for node in nodes if ids[node] == of] for of in dict.fromkeys(ids.values())]

    def last(self, node: str, key: str) -> float:
        """The last value that a node told under a name; NaN if it never did."""
        told = [values[key] for values in self.diagnostics.get(node, []) if key in values]
        return float(told[-1]) if told else float("nan")


def fly(folder: Path, *options: object, nodes: tuple[str, ...] = NODES) -> Flown:
    """Fly with run_all, only these nodes, into a new bag in `folder`."""
    bag = folder / f"bag{len(list(folder.iterdir()))}"
    command = [sys.executable, "-m", "uav_dc_ros.run_all", "--nodes", ",".join(nodes), "--bag", str(bag)]
    command += [str(option) for option in options]
    subprocess.run(command, check=True, env=ENVIRONMENT, stdout=subprocess.DEVNULL)
    return read(bag)


def read(bag: Path) -> Flown:
    """What a bag tells."""
    times_ns: list[int] = []
    sizes: dict[str, list[int]] = {}
    diagnostics: dict[str, list[dict[str, str]]] = {}
    with AnyReader([bag]) as reader:
        for connection, time_ns, data in reader.messages():
            topic = connection.topic.rsplit("/", 1)[-1]
            sizes.setdefault(topic, []).append(len(data))
            if topic == "mission":
                times_ns.append(time_ns)
            elif topic == "diagnostics":
                for status in reader.deserialize(data, connection.msgtype).status:
                    values = {pair.key: pair.value for pair in status.values}
                    diagnostics.setdefault(status.name.rsplit("/", 1)[-1], []).append(values)
    return Flown(
        step_ms=[(b - a) * 1e-6 for a, b in itertools.pairwise(times_ns)],
        payload_bytes={topic: statistics.median(each) for topic, each in sizes.items()},
        diagnostics=diagnostics,
    )
