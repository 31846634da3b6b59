"""What it costs a mission to publish its numbers as standard messages, and to be watched on a page.

    python benchmarks/watching.py [ROUNDS]

Each round flies missions in lockstep in four ways, one after another, in an order that changes from round to
round, and then one mission at pace 1 with steps of a second in three of them. It prints medians over the
rounds of the ratios to the first two ways within a round. The page's reader is a client of its stream: it
reads all that a browser would, and draws nothing. The last way has one more client that never reads.

On a busy machine the time of a step differs more between rounds than between ways; the CPU time does not.
"""

import contextlib
import http.client
import os
import statistics
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from flights import NODES, Flown, fly

from uav_dc_ros import files
from uav_dc_ros.nodes.view.web.server import free_port

MISSIONS = 60
SECONDS = 20
WITH = (*NODES, "visualizer")
NO_NUMBERS = ("--set", "visualizer.numeric_rate=0")


@contextlib.contextmanager
def watched(port: int, reads: bool) -> Iterator[None]:
    """A client of a page that appears at this port, and stays connected."""
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.05):
            with contextlib.suppress(OSError, http.client.HTTPException):
                connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
                connection.request("GET", "/news")
                response = connection.getresponse()
                while reads and response.fp.readline():
                    pass
                over.wait()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()


def flown(folder: Path, way: str, *options: object) -> Flown:
    """One flight in a way."""
    if way == "without numbers":
        return fly(folder, *options, *NO_NUMBERS, nodes=WITH)
    if way == "with numbers":
        return fly(folder, *options, nodes=WITH)
    port = free_port("127.0.0.1")
    with contextlib.ExitStack() as stack:
        stack.enter_context(watched(port, reads=True))
        if way == "with a slow page":
            stack.enter_context(watched(port, reads=False))
        return fly(folder, *options, "--view", port, nodes=WITH)


WAYS = ("without numbers", "with numbers", "with a page", "with a slow page")


def cpu_per_step_ms(one: Flown) -> float:
    """CPU time of all processes for a step, milliseconds."""
    nodes = [name for name in (*WITH, "web_view", "mission_monitor") if name in one.diagnostics]
    percent = sum(one.cpu_percent(names[0], skip=1) for names in one.processes(tuple(nodes)))
    return percent / 100 * statistics.mean(one.step_ms)


def report(title: str, unit: str, rounds: list[dict[str, float]]) -> None:
    """Print the median of each way, and of its ratio to the first and to the second."""
    print(f"{title}, {len(rounds)} rounds, {os.cpu_count()} cores")
    for way in rounds[0]:
        value = statistics.median(one[way] for one in rounds)
        ratios = [
            statistics.median(one[way] / one[base] for one in rounds)
            for base in WAYS[:2]
            if base in rounds[0]
        ]
        print(f"  {way}: {value:.3f} {unit}, " + " and ".join(f"{ratio:.3f}" for ratio in ratios) + " times")


def main() -> None:
    """Fly the rounds, and print what they took."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    steps: list[dict[str, float]] = []
    work: list[dict[str, float]] = []
    late: list[dict[str, float]] = []
    cpu: list[dict[str, float]] = []
    shipped = (Path(files.__file__).parent / "scenarios" / "five_clusters_hover.toml").read_text("utf-8")
    text = shipped.replace("step_s = 15.0", "step_s = 1.0").replace(
        "max_steps = 60", f"max_steps = {SECONDS}"
    )
    assert "step_s = 1.0" in text, "the scenario has changed"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scenario = folder / "seconds.toml"
        scenario.write_text(text)
        for i in range(rounds):
            order = WAYS[i % len(WAYS) :] + WAYS[: i % len(WAYS)]
            lockstep = ("--pace", "lockstep", "--missions", MISSIONS)
            found = {way: flown(folder, way, *lockstep) for way in order}
            steps.append({way: statistics.mean(found[way].step_ms) for way in WAYS})
            work.append({way: cpu_per_step_ms(found[way]) for way in WAYS})
            for title, of in (("time", steps[-1]), ("CPU time", work[-1])):
                print(f"{title}: " + ", ".join(f"{way} {ms:.3f} ms" for way, ms in of.items()), flush=True)
        real = ("--scenario", scenario, "--policy", "five_clusters_hover_dueling", "--pace", 1)
        for _ in range(min(rounds, 3)):
            found = {way: flown(folder, way, *real) for way in WAYS[:3]}
            cpu.append({way: sum(map(one.cpu_percent, NODES)) for way, one in found.items()})
            late.append({way: one.last("world", "step lateness p50 [ms]") for way, one in found.items()})
            overruns = {way: f"{one.last('world', 'step overruns'):.0f}" for way, one in found.items()}
            print(f"overruns at pace 1: {overruns}", flush=True)
    report("a step in lockstep, mean with the starts of missions", "ms", steps)
    report("CPU time of a step in lockstep, all processes", "ms", work)
    report("the four nodes at pace 1, of one core", "%", cpu)
    report("a step at pace 1 starts late by, median", "ms", late)


if __name__ == "__main__":
    main()
