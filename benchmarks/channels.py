"""World steps per second on one core with a random channel, in ratio to free space in the same run.

    python benchmarks/channels.py [REPEATS]

The worlds are those of `benchmarks/world_steps.py`: `five_clusters_hover` with 50 users, in float32, with
their own draws and the start of each mission counted in.
"""

import sys

import msgspec
from world_steps import Bench, field

from uav_dc_ros.core.scenario import from_values

N_USERS, N_WORLDS = 50, 1024
SHADOWING = {"shadowing": {"sigma_db": 6.0, "correlation_m": 50.0}}
FADING = {"fading": {"model": "rician", "k_db": 10.0}}
CHANNELS = {"free space": {}, "fading": FADING, "shadowing": SHADOWING, "both": SHADOWING | FADING}


def main() -> None:
    """Prints a row for each channel, of the best of all repeats, which take turns."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    values = msgspec.to_builtins(field(N_USERS))
    benches = {
        name: Bench(from_values(values | {"radio": values["radio"] | radio}, name), N_WORLDS)
        for name, radio in CHANNELS.items()
    }
    best_s = dict.fromkeys(benches, float("inf"))
    for _ in range(repeats + 1):  # the first touches the memory
        for name, bench in benches.items():
            best_s[name] = min(best_s[name], bench.mission())
    for name, bench in benches.items():
        rate, ratio = bench.n_steps / best_s[name], best_s[name] / best_s["free space"]
        print(f"{name:10} {rate:10,.0f} world steps/s   {ratio:.1f} times the time of free space")


if __name__ == "__main__":
    main()
