"""The live view: serves the mission to Foxglove over WebSocket, every message as it came.

A client reads CDR with the definitions that are sent along, so it needs no ROS. Topics are called as in
the graph, with their namespace. Times are those of receipt, on the wall clock: mission time may run a
hundred times faster, and begins anew with every run, which a client's time line cannot; it is in the
stamps, and on `clock`.
"""

from typing import Any

from uav_dc_ros import files
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.view.foxglove_server import FoxgloveServer
from uav_dc_ros.topics import TOPICS, Topic

LAYOUT_FOLDER, LAYOUT = "share/foxglove", "mission.json"
ANYWHERE = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # listened on; where to find it on this machine


class LiveViewNode(MissionNode):
    """A WebSocket server with one channel for each topic."""

    pause_s = 0.02  # nobody waits for it

    def __init__(self) -> None:
        super().__init__("live_view")
        self._view: FoxgloveServer | None = None

    def configure(self) -> None:
        """Listen, and tell the clients which topics there are."""
        self._view = FoxgloveServer(
            name=f"uav_dc_ros {self.get_namespace()}".removesuffix(" /"),
            address=self.values["address"],
            port=self.values["port"],
            topics={self.resolve_topic_name(name): TOPICS[name] for name in self.row.subscribes},
        )

    def activate(self) -> None:
        """Serve from here on, and tell where."""
        assert self._view is not None, "it was configured"
        given = self.values["address"]
        host = ANYWHERE.get(given, given)
        where = f"[{host}]" if ":" in host else host
        layout = str(files.shipped_folder(LAYOUT_FOLDER) / LAYOUT)
        if self.get_namespace() != "/":
            layout += f" (put {self.get_namespace()} in front of its topics)"
        self.get_logger().info(
            f"live view: ws://{where}:{self._view.port} (Foxglove: Open connection, Foxglove WebSocket); "
            f"layout: {layout}"
        )

    def cleanup(self) -> None:
        """Close the server."""
        if self._view is not None:
            self._view.stop()
            self._view = None

    def subscribe(self, topic: Topic) -> Any:
        """Subscribe to a topic of the row, for its bytes."""
        assert self._view is not None, "it was configured"
        view, full_name = self._view, self.resolve_topic_name(topic.name)

        def hear(data: bytes, info: Any) -> None:
            if self.is_of_another_run(topic.name, data):
                return
            view.send(full_name, data, info["received_timestamp"])
            self.statistics.count_received(topic.name, info)

        return self.create_raw_subscription(topic, hear)

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """Where it listens."""
        return [], {} if self._view is None else {"port": str(self._view.port)}


if __name__ == "__main__":
    node_main.main(LiveViewNode)
