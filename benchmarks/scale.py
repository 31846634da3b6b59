"""How lockstep missions scale with the number of users.

python benchmarks/scale.py [USERS ...]
"""

import os
import statistics
import sys
import tempfile
from pathlib import Path

from flights import NODES, fly

from uav_dc_ros import files

CLUSTERS = 5
USERS = (100, 1_000, 10_000)
SECONDS_WANTED = 5.0  # of flight, so that every node tells of itself a few times


def main() -> None:
    """Print steps per second, sizes of payloads, and the nodes' shares of a core."""
    wanted = [int(text) for text in sys.argv[1:]] or USERS
    shipped = (Path(files.__file__).parent / "scenarios" / "five_clusters_hover.toml").read_text("utf-8")
    print(f"lockstep, {os.cpu_count()} cores; payloads in kB, nodes in percent of one core")
    print(f"{'users':>6} {'steps/s':>8} {'users kB':>9} {'rates kB':>9}  " + "  ".join(NODES))
    with tempfile.TemporaryDirectory() as folder:
        for users in wanted:
            scenario = Path(folder) / f"users_{users}.toml"
            text = shipped.replace("users_per_cluster = 10", f"users_per_cluster = {users // CLUSTERS}")
            assert f"users_per_cluster = {users // CLUSTERS}" in text, "the scenario has changed"
            scenario.write_text(text)
            missions = max(1, round(SECONDS_WANTED * min(600, 450_000 / users) / 60))
            policy = "five_clusters_hover_dueling"
            options = ("--scenario", scenario, "--policy", policy, "--pace", "lockstep")
            options += ("--no-compose",)  # who takes how much
            flown = fly(Path(folder), *options, "--missions", missions)
            sizes = [flown.payload_bytes[topic] / 1e3 for topic in ("users", "rates")]
            cpu = "  ".join(f"{flown.cpu_percent(name, 1):>{len(name)}.0f}" for name in NODES)
            rate_hz = 1e3 / statistics.median(flown.step_ms)
            print(f"{users:>6} {rate_hz:>8.1f} {sizes[0]:>9.1f} {sizes[1]:>9.1f}  {cpu}")


if __name__ == "__main__":
    main()
