"""What the nodes take at pace 1, and whether their steps keep their time.

    python benchmarks/real_time.py [SECONDS]

Fifty users, steps of one second instead of fifteen, so that there are enough of them to speak of a p99; a
mission with the scenario's own steps takes less. Beside it, a bare rclpy node with a timer of one second.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from flights import ENVIRONMENT, NODES, fly

from uav_dc_ros import files

BARE = """
import resource, sys, time
import rclpy
from rclpy.clock import Clock, ClockType
rclpy.init()
node = rclpy.create_node("bare")
late, due = [], [time.monotonic() + 1.0]
def tick():
    late.append(time.monotonic() - due[0])
    due[0] += 1.0
timer = node.create_timer(1.0, tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
due[0] = time.monotonic() + timer.time_until_next_call() * 1e-9
cpu = time.process_time()
while len(late) < int(sys.argv[1]):
    rclpy.spin_once(node)
late.sort()
print(100 * (time.process_time() - cpu) / len(late), late[int(0.99 * (len(late) - 1))] * 1e3)
"""


def main() -> None:
    """Print the share of a core of each node, and the lateness of steps."""
    seconds = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    shipped = (Path(files.__file__).parent / "scenarios" / "five_clusters_hover.toml").read_text("utf-8")
    with tempfile.TemporaryDirectory() as folder:
        scenario = Path(folder) / "seconds.toml"
        text = shipped.replace("step_s = 15.0", "step_s = 1.0").replace(
            "max_steps = 60", f"max_steps = {seconds}"
        )
        assert "step_s = 1.0" in text, "the scenario has changed"
        scenario.write_text(text)
        bare = subprocess.run(
            [sys.executable, "-c", BARE, str(min(seconds, 20))],
            env=ENVIRONMENT,
            check=True,
            capture_output=True,
            text=True,
        )
        options = ("--scenario", scenario, "--policy", "five_clusters_hover_dueling", "--pace", 1)
        flown = fly(Path(folder), *options)
    cpu_percent = {name: flown.cpu_percent(name) for name in NODES}
    told = ", ".join(f"{name} {percent:.1f}" for name, percent in cpu_percent.items())
    bare_cpu, bare_late_ms = map(float, bare.stdout.split())
    print(f"{len(flown.step_ms)} steps of 1 s at pace 1, 50 users, {os.cpu_count()} cores")
    print(f"percent of one core, medians: {told}; together {sum(cpu_percent.values()):.1f}")
    print(
        f"a step starts late by p50 {flown.last('world', 'step lateness p50 [ms]'):.2f} ms, "
        f"p99 {flown.last('world', 'step lateness p99 [ms]'):.2f} ms; "
        f"overruns: {flown.last('world', 'step overruns'):.0f}, "
        f"hovered: {flown.last('world', 'hovered steps'):.0f}"
    )
    print(f"a bare node with a timer of 1 s: {bare_cpu:.1f} percent, late by p99 {bare_late_ms:.2f} ms")


if __name__ == "__main__":
    main()
