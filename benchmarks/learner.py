"""How fast a population learns, as a multiple of stable-baselines3's DQN on the same machine in the same run.

    python benchmarks/learner.py [--peer PYTHON] [--seconds S] [--rounds N]
    python benchmarks/learner.py --profile
    python benchmarks/learner.py --device cuda [--runs N ...]

An agent-step is one environment step and one gradient step of batch 32. World, observation (position),
network (two hidden layers of 64), batch and buffer are those of `benchmarks/sb3_dqn.py`, which runs in
PYTHON, an interpreter that has stable-baselines3, by turns with this. Each line but the last two is one
batch in one process on one core; those are as the sweep does it, shards of 128 runs in two processes at
a time. Imports are not counted on either side. With --profile: where the time of a shard goes. With
--device: agent-steps per second of one batch there, beside those of one core of the host, and how far the
parameters of both lie apart after the first episode.
"""

import argparse
import cProfile
import json
import multiprocessing
import pstats
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from multiprocessing.synchronize import Barrier
from pathlib import Path
from queue import Queue

import msgspec
import numpy as np
import torch

from uav_dc_ros import scenarios
from uav_dc_ros.agents.policy import Hyperparameters
from uav_dc_ros.experiments.train.population import Population, Run
from uav_dc_ros.experiments.train.training import Training, prepare_torch

SHARD = 128
PEER = Path(__file__).with_name("sb3_dqn.py")


def population(n_runs: int, buffer_size: int = 50_000) -> Population:
    """Runs of both algorithms and both forms of the reward, as a sweep has them."""
    scenario = scenarios.load("five_clusters_hover")
    runs = [
        Run(
            seed=i,
            environment=i % 5,
            algorithm=("dqn", "dueling_dqn")[i % 2],
            reward=msgspec.structs.replace(scenario.reward, form=("immediate", "episode")[i // 2 % 2]),
            hyperparameters=Hyperparameters(episodes=100_000, buffer_size=buffer_size),
        )
        for i in range(n_runs)
    ]
    return Population(scenario=scenario, observation="position", hidden=(64, 64), runs=tuple(runs))


def work(n_runs: int, seconds: float, together: Barrier, results: "Queue[tuple[float, float]]") -> None:
    """Trains one population for a while; reports agent-steps per second and the memory it took, MB."""
    prepare_torch(n_threads=1)
    bare_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    training = Training(population(n_runs), torch.device("cpu"))
    training.fly_episode()
    together.wait()
    started, steps = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        training.fly_episode()
        steps += n_runs * training.population.scenario.mission.max_steps
    rate = steps / (time.perf_counter() - started)
    together.wait()  # both were at work until both were done
    results.put((rate, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - bare_mb))


def measure(n_runs: int, processes: int, seconds: float) -> tuple[float, float]:
    """Agent-steps per second and memory in MB of `processes` batches of `n_runs` side by side."""
    context = multiprocessing.get_context("spawn")
    together, results = context.Barrier(processes), context.Queue()
    workers = [
        context.Process(target=work, args=(n_runs, seconds, together, results)) for _ in range(processes)
    ]
    for worker in workers:
        worker.start()
    found = [results.get() for _ in workers]
    for worker in workers:
        worker.join()
    return sum(rate for rate, _ in found), sum(mb for _, mb in found)


def peer(python: str) -> tuple[float, float]:
    """Agent-steps per second of stable-baselines3: with the same settings, and at its best."""
    done = subprocess.run([python, PEER], capture_output=True, text=True)
    if done.returncode:
        why = done.stderr.strip().rpartition("\n")[2]
        raise SystemExit(f"{PEER.name} in {python}: {why}; expected stable-baselines3: see --peer")
    figures = json.loads(done.stdout.splitlines()[-1])
    return figures["agent_steps_per_s"], figures["best_agent_steps_per_s"]


def profile() -> None:
    """Prints where the time of some episodes of a shard goes, by function."""
    prepare_torch(n_threads=1)
    training = Training(population(SHARD), torch.device("cpu"))
    training.fly_episode()
    watch = cProfile.Profile()
    watch.enable()
    for _ in range(5):
        training.fly_episode()
    watch.disable()
    figures = pstats.Stats(watch).sort_stats("tottime")
    total_s = figures.total_tt  # type: ignore[attr-defined]
    print(f"{1e6 * total_s / (5 * 60 * SHARD):.1f} us per agent-step, watched")
    for (_, _, name), (_, calls, own_s, within_s, _) in sorted(
        figures.stats.items(),  # type: ignore[attr-defined]
        key=lambda item: -item[1][2],
    )[:20]:
        print(
            f"{own_s / total_s:5.1%} itself  {within_s / total_s:6.1%} with what it calls  {calls:7}x  {name}"
        )


def rate_on(training: Training, seconds: float) -> float:
    """Agent-steps per second on the training's device, after one episode that is not counted."""
    device = training.device
    training.fly_episode()
    _wait_for(device)
    started, steps = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        training.fly_episode()
        _wait_for(device)
        steps += len(training.population.runs) * training.population.scenario.mission.max_steps
    return steps / (time.perf_counter() - started)


def _wait_for(device: torch.device) -> None:
    """Returns when the device has done what it was given: calls to it return before that."""
    if device.type != "cpu":
        torch.accelerator.synchronize(device)


def differences(n_runs: int, device: torch.device) -> list[float]:
    """The largest difference of a parameter between the device and the CPU after one episode, of each run."""
    pair = [Training(population(n_runs, buffer_size=1_000), place) for place in (torch.device("cpu"), device)]
    for training in pair:
        training.fly_episode()
    apart = []
    for run in range(n_runs):
        host, there = (training.learner.parameters(run) for training in pair)
        apart.append(max(float(np.abs(host[name] - there[name]).max()) for name in host))
    return apart


def on_device(device: torch.device, sizes: Sequence[int], seconds: float) -> None:
    """Prints what a device does, beside one core of the host."""
    prepare_torch(n_threads=1)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
    print(f"{name}, torch {torch.__version__}")
    print("| runs | agent-steps/s | on one core | ratio | largest difference, worst run | median run |")
    print("|---|---|---|---|---|---|")
    for n_runs in sizes:
        rate = rate_on(Training(population(n_runs), device), seconds)
        host = rate_on(Training(population(n_runs, buffer_size=1_000), torch.device("cpu")), seconds)
        apart = differences(n_runs, device)
        print(
            f"| {n_runs:,} | {rate:,.0f} | {host:,.0f} | {rate / host:.1f} "
            f"| {max(apart):.1e} | {statistics.median(apart):.1e} |",
            flush=True,
        )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peer", default=sys.executable, metavar="PYTHON")
    parser.add_argument("--seconds", default=6.0, type=float, metavar="S", help="of each measurement")
    parser.add_argument("--rounds", default=5, type=int, metavar="N")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--device", type=torch.device, metavar="DEVICE", help="such as cuda")
    parser.add_argument("--runs", default=[1340, 4096], type=int, nargs="+", metavar="N", help="on DEVICE")
    options = parser.parse_args()
    if options.device:
        on_device(options.device, options.runs, options.seconds)
        return
    if options.profile:
        profile()
        return
    # Turn and turn about, since what else runs on the machine slows now the one and now the other.
    peers, sweeps = [], []
    for _ in range(options.rounds):
        peers.append(peer(options.peer))
        sweeps.append(measure(SHARD, 2, options.seconds))
    same, best = (statistics.median(column) for column in zip(*peers, strict=True))
    lines = [(f"{n} in one batch", *measure(n, 1, options.seconds)) for n in (1, 16, 64, 256, 1024)]
    # Every further pair of shards takes its turn at the same rate and in the same memory.
    rate, memory_mb = (statistics.median(column) for column in zip(*sweeps, strict=True))
    lines += [(f"{n} as {n // SHARD} shards, 2 at a time", rate, memory_mb) for n in (256, 1024)]
    ratios = sorted(ours / theirs for (ours, _), (theirs, _) in zip(sweeps, peers, strict=True))
    print(f"stable-baselines3: {same:,.0f} agent-steps/s with these settings, {best:,.0f} at its best")
    print(f"256 runs, round by round: {', '.join(f'{ratio:.0f}x' for ratio in ratios)}")
    print("| runs | agent-steps/s | times stable-baselines3 | times its best | memory, MB |")
    print("|---|---|---|---|---|")
    for title, rate, memory_mb in lines:
        print(f"| {title} | {rate:,.0f} | {rate / same:.1f} | {rate / best:.1f} | {memory_mb:,.0f} |")


if __name__ == "__main__":
    main()
