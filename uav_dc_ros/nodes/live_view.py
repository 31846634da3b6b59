"""The live view: serves the mission's messages to Foxglove over WebSocket, serialised.

A client reads CDR and JSON with the definitions that the server sends, so it needs no ROS. Topics have their
full names. Times are those of receipt, on the wall clock: mission time may run a hundred times faster and
restarts with every run, which a client's time line does not support; it is in the stamps, and on `clock`.
"""

from typing import Any

from uav_dc_ros import files
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.view.foxglove_server import FoxgloveServer
from uav_dc_ros.topics import TOPICS, Topic

LAYOUT_FOLDER, LAYOUT = "share/foxglove", "mission.json"
LOOPBACK = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # of the addresses that stand for all


class LiveViewNode(MissionNode):
    """A WebSocket server with one channel for each topic."""

    drain_quiet_s = 0.1  # a client receives the end of a mission, too
    pause_s = 0.02  # no node waits for it

    def __init__(self) -> None:
        super().__init__("live_view")
        self._server: FoxgloveServer | None = None

    def configure(self) -> None:
        """Start the server."""
        self._server = FoxgloveServer(
            name=f"uav_dc_ros {self.get_namespace()}".removesuffix(" /"),
            address=self.values["address"],
            port=self.values["port"],
            topics={self.resolve_topic_name(name): TOPICS[name] for name in self.row.subscribes},
        )

    def activate(self) -> None:
        """Log the address."""
        assert self._server is not None, "configure created it"
        address = self.values["address"]
        host = LOOPBACK.get(address, address)
        host = f"[{host}]" if ":" in host else host
        layout = str(files.shipped_folder(LAYOUT_FOLDER) / LAYOUT)
        if self.get_namespace() != "/":
            layout += f" (put {self.get_namespace()} in front of its topics)"
        self.get_logger().info(
            f"live view: ws://{host}:{self._server.port} (Foxglove: Open connection, Foxglove WebSocket); "
            f"layout: {layout}"
        )

    def cleanup(self) -> None:
        """Close the server."""
        if self._server is not None:
            self._server.stop()
            self._server = None

    def subscribe(self, topic: Topic) -> Any:
        """Subscribe to a topic of the row, serialised."""
        assert self._server is not None, "configure created it"
        send, name = self._server.send, self.resolve_topic_name(topic.name)
        return self.subscribe_serialised(
            topic, lambda data, info: send(name, data, info["received_timestamp"])
        )

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """The port of the server."""
        return [], {} if self._server is None else {"port": str(self._server.port)}


if __name__ == "__main__":
    node_main.main(LiveViewNode)
