"""The page of `run_all --view`: its address, the browser that opens it, and its end."""

import os
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Mapping

from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.framework.parameters import ADDRESS
from uav_dc_ros.nodes.view.web import server
from uav_dc_ros.runner.node_process import NodeProcess

NODE = "web_view"
POLL_S = 0.1


class WebPage:
    """The page that the web view of this run serves, at a port (0: any) and with the node's `--set` values.

    Raises ParameterError if the port is in use, or the address belongs to another machine.
    """

    def __init__(self, port: int, settings: Mapping[str, object]) -> None:
        address, port = str(settings.get("address", ADDRESS.default)), int(str(settings.get("port", port)))
        server.check(address=address, port=port)
        token = server.token_for(address, str(settings.get("token", "")))
        port = port or server.free_port(address)
        self.parameters = {"port": port, "token": token}
        self.url = server.url(address, port, token)

    def open_browser(self) -> None:
        """Open the page on a desktop, from a terminal. The browser starts in a thread of its own."""
        has_desktop = sys.platform == "darwin" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
        if has_desktop and is_attended():
            threading.Thread(target=webbrowser.open, args=(self.url,), daemon=True).start()

    def keep(self, process: NodeProcess, is_interrupted: Callable[[], bool]) -> None:
        """Serve the page until Ctrl-C, or until the terminal closes."""
        try:
            while is_attended() and not (is_interrupted() or process.has_ended):
                time.sleep(POLL_S)
        finally:
            process.terminate()
            process.wait(time.monotonic() + NODES[NODE].stop_timeout_s)


def is_attended() -> bool:
    """Whether input and output are a terminal, which is open."""
    return all(
        stream is not None and not stream.closed and stream.isatty() for stream in (sys.stdin, sys.stdout)
    )
