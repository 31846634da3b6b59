"""The web view: serves a page that shows missions live in any browser.

It shows the missions of all namespaces that it finds. No other node waits for it: it is no peer of theirs,
its subscriptions keep only the newest messages, and it decodes a few of them ten times a second.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

from uav_dc_ros import cdr, scenarios
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.mission_node import MissionNode
from uav_dc_ros.nodes.ros import numeric_messages, qos
from uav_dc_ros.nodes.view.web import server
from uav_dc_ros.nodes.view.web.feed import Feed
from uav_dc_ros.nodes.view.web.inbox import Inbox
from uav_dc_ros.nodes.view.web.page import page
from uav_dc_ros.topics import JSON, TOPICS, Topic

UPDATE_S = 0.1
SCAN_S = 1.0  # period of scans for missions in other namespaces
SHOWN = ("mission", "users", "rates")


class WebViewNode(MissionNode):
    """A web server with one page."""

    drain_quiet_s = 0.1  # it shows the end of a mission, too
    pause_s = 0.05  # no node waits for it

    def __init__(self) -> None:
        super().__init__("web_view")
        self._server: server.ViewServer | None = None

    def configure(self) -> None:
        """Load the scenario, and start the server."""
        values = self.values
        self.scenario = scenarios.load(values["scenario"])
        token = server.token_for(values["address"], values["token"])
        self._feed = Feed()
        self._server = server.ViewServer(
            self._feed, page(), address=values["address"], port=values["port"], token=token
        )

    def activate(self) -> None:
        """Log the page's address, and start to look for missions."""
        assert self._server is not None, "configure created it"
        self._inboxes: dict[str, Inbox] = {}
        self._others: set[str] = set()  # topics in use: other namespaces', and those of real vehicles
        address = server.url(self.values["address"], self._server.port, self._server.token)
        self.get_logger().info(f"live view: {address}")
        self.timer(UPDATE_S, self._update)
        self.timer(SCAN_S, self._scan)

    def deactivate(self) -> None:
        """Show the last state."""
        self._update()

    def cleanup(self) -> None:
        """Close the server."""
        if self._server is not None:
            self._server.stop()
            self._server = None

    def subscribe(self, topic: Topic) -> Any:
        """Subscribe to a topic of the row, serialised."""
        add = self._inbox(self.get_namespace()).add
        return self.subscribe_serialised(topic, lambda data, _: add(topic.name, data))

    def _inbox(self, namespace: str) -> Inbox:
        if namespace not in self._inboxes:
            self._inboxes[namespace] = Inbox(namespace, self._feed, self._find_scenario)
        return self._inboxes[namespace]

    def _find_scenario(self, name: str, fingerprint: str) -> Scenario | None:
        """The node's own scenario or a shipped one, with this fingerprint."""
        found = self.scenario if self.scenario.fingerprint == fingerprint else _shipped(name)
        return found if found is not None and found.fingerprint == fingerprint else None

    def _update(self) -> None:
        """Add what has come since the last update to the page."""
        inboxes = [inbox for inbox in self._inboxes.values() if inbox.has_new]
        if not inboxes:
            return
        with self._feed.changing():
            for inbox in inboxes:
                inbox.update(self.reject)
        for inbox in inboxes:
            if inbox.needs_pose:
                self._subscribe_other(inbox, "pose", lambda data, to: to.add_pose(cdr.Pose(data).position_m))
                self._subscribe_other(
                    inbox, "battery", lambda data, to: to.set_charge(numeric_messages.read_charge(data))
                )

    def _scan(self) -> None:
        """Subscribe to missions of other namespaces."""
        own = self.get_namespace()
        for name, types in self.get_topic_names_and_types():
            namespace, _, topic = name.rpartition("/")
            if topic == "mission" and JSON in types and (namespace or "/") != own:
                inbox = self._inbox(namespace or "/")
                for shown in SHOWN:
                    self._subscribe_other(inbox, shown, partial(_add, shown))

    def _subscribe_other(self, inbox: Inbox, name: str, handle: Callable[[bytes, Inbox], None]) -> None:
        """Subscribe once to a topic that is not of the row."""
        full_name, topic = f"{inbox.namespace.rstrip('/')}/{name}", TOPICS[name]
        if full_name in self._others:
            return
        self._others.add(full_name)

        def receive(data: bytes, _: Any) -> None:
            try:
                handle(data, inbox)
            except MessageError as error:
                self.reject(name, error)

        profile = qos.requested(topic, keep_all=False)
        subscription = qos.create_subscription(self, qos.message_class(topic), full_name, receive, profile)
        self._until_inactive.callback(self.destroy_subscription, subscription)

    def diagnose(self) -> tuple[list[str], dict[str, str]]:
        """The port of the server, and the number of open pages."""
        if self._server is None:
            return [], {}
        return [], {"port": str(self._server.port), "open pages": str(self._server.pages)}


def _add(topic: str, data: bytes, inbox: Inbox) -> None:
    inbox.add(topic, data)


@lru_cache(maxsize=16)
def _shipped(name: str) -> Scenario | None:
    return scenarios.load(name) if name in scenarios.names() else None


if __name__ == "__main__":
    node_main.main(WebViewNode)
