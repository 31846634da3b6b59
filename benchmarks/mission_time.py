"""How long a lockstep mission takes from the command to the prompt, and where the time goes.

    python benchmarks/mission_time.py [RUNS]

The bare limit in the same run: one Python that imports rclpy and numpy, makes a node, and ends.

Both find this package's bytecode, as where it is installed: a first mission, which is not counted, writes it.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rosbags.highlevel import AnyReader

from uav_dc_ros import scenarios

STEPS = scenarios.load("five_clusters_hover").mission.max_steps
BARE = "import rclpy, numpy; rclpy.init(); rclpy.create_node('bare').destroy_node(); rclpy.shutdown()"
ENVIRONMENT = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
ENVIRONMENT.pop("PYTHONDONTWRITEBYTECODE", None)


def timed(*command: str) -> tuple[float, float]:
    """Run a command; when it started (seconds since the epoch), and how long it took."""
    started_s = time.time()
    subprocess.run(command, check=True, env=ENVIRONMENT, stdout=subprocess.DEVNULL)
    return started_s, time.time() - started_s


def mission(bag: Path) -> dict[str, float]:
    """Fly one; seconds of each part.

    Start-up ends with the first message on `mission`, closing begins after the last one.
    """
    run_all = (sys.executable, "-m", "uav_dc_ros.run_all", "--pace", "lockstep", "--bag", str(bag))
    started_s, total_s = timed(*run_all)
    with AnyReader([bag]) as reader:
        ours = [connection for connection in reader.connections if connection.topic == "/mission"]
        times_ns = [time_ns for _, time_ns, _ in reader.messages(ours)]
    start_up_s = times_ns[0] * 1e-9 - started_s
    flight_s = (times_ns[-1] - times_ns[0]) * 1e-9
    return {
        "start-up": start_up_s,
        "flight": flight_s,
        "closing": total_s - start_up_s - flight_s,
        "total": total_s,
        "bare node": timed(sys.executable, "-c", BARE)[1],
    }


def main() -> None:
    """Print the median and the range of each part."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    with tempfile.TemporaryDirectory() as folder:
        ENVIRONMENT["PYTHONPYCACHEPREFIX"] = str(Path(folder) / "bytecode")
        flown = [mission(Path(folder) / f"bag{i}") for i in range(runs + 1)][1:]
    print(f"one five_clusters_hover mission in lockstep, {runs} runs, {os.cpu_count()} cores; seconds")
    for part in flown[0]:
        values = [run[part] for run in flown]
        print(
            f"{part:>10}  median {statistics.median(values):6.2f}  {min(values):6.2f} to {max(values):6.2f}"
        )
    rates = [STEPS / run["flight"] for run in flown]
    print(f"steps per second in flight: median {statistics.median(rates):.0f}")
    ratio = statistics.median(run["total"] / run["bare node"] for run in flown)
    print(f"total / bare node: {ratio:.1f} (four processes on {os.cpu_count()} cores)")


if __name__ == "__main__":
    main()
