"""CPU time of decisions: of one mission at a time, as in the policy node."""

import time
from collections.abc import Sequence
from itertools import product

import numpy as np

from uav_dc_ros.agents.agent import Agent
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.world import Act, State, rollout_steps
from uav_dc_ros.experiments.leaderboard.worlds import Board, BoardWorld

TIMES_FILE = "decision_times.md"
FIELDS = 5  # fields, or missions of a single world, that are flown


def timed(act: Act, times_s: list[float]) -> Act:
    """The actions of `act`; adds the CPU time of each decision to `times_s`."""

    def measured(state: State) -> Array:
        begun_s = time.process_time()
        action = act(state)
        times_s.append(time.process_time() - begun_s)
        return action

    return measured


def measure(agent: Agent, board: Board, weight: float) -> tuple[list[float], list[float]]:
    """CPU time of the first decision in each world of a board, and of all others, seconds.

    The first decision prepares tables.
    """
    first: list[float] = []
    others: list[float] = []
    missions = list(product(board.worlds, range(board.n_missions)))[:FIELDS]
    acts: dict[BoardWorld, Act] = {}
    for world, seed in missions:
        scenario = world.load().scenario
        times_s: list[float] = []
        act = acts.setdefault(world, agent.act_in(scenario, weight))
        for _ in rollout_steps(scenario, timed(act, times_s), [seed]):
            pass
        (first if seed == 0 else others).append(times_s[0])
        others += times_s[1:]
    return first, others


def page(rows: Sequence[tuple[str, str, list[float], list[float]]]) -> str:
    """The text of the page of contestants, boards and times."""
    lines = [
        "# Leaderboard: decision times",
        "",
        "CPU time of a decision, milliseconds, of one mission at a time, as in the policy node. They differ "
        "from machine to machine and from run to run. The first decision in a world prepares tables.",
        "",
        "| | measured on | decisions | median | 99% | maximum | first |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, board, first, others in rows:
        median, high, most = (f"{1e3 * value:.2f}" for value in np.percentile(others, [50, 99, 100]))
        texts = (f"`{name}`", f"`{board}`", str(len(others)), median, high, most, f"{1e3 * max(first):.1f}")
        lines.append(f"| {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"
