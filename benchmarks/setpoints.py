"""Whether setpoints keep their pace while others want the processor: 20 Hz, as an autopilot gets them.

    python benchmarks/setpoints.py [SECONDS]

The MAVLink transport, in a process of its own, streams to the tests' fake autopilot; beside it in the same
run, to a second one, a loop that sleeps until the next setpoint is due and does nothing else. Told is the
99th percentile of |gap - 50 ms| of each, by the times at which the system received them. The aim is 10 ms.
"""

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.support.fake_autopilot.streaming import off_beat_ms

AIM_MS = 10.0
SENDERS = ("transport", "bare")


def main() -> None:
    """Print a line for each kind of company."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 30.0
    cores = os.cpu_count() or 1
    companies = {
        "alone": {},
        "a policy that loads, and is killed": {"loading": True},
        f"{cores} busy processes": {"burning": cores},
        f"{2 * cores} busy processes, and the policy": {"burning": 2 * cores, "loading": True},
    }
    print(f"{cores} cores, {seconds:g} s each; p99 of |gap - 50 ms|, aim {AIM_MS:g} ms")
    for name, company in companies.items():
        ours_ms, bare_ms = off_beat_ms(seconds, SENDERS, **company)
        print(f"{name}: {ours_ms:.1f} ms; bare {bare_ms:.1f} ms; ratio {ours_ms / bare_ms:.2f}", flush=True)


if __name__ == "__main__":
    main()
