"""Flights of the leaderboard: blocks of worlds, each flown by a process, and the files of their results.

A folder has a file for each contestant in each block. A file that exists is not flown again, so a command
that was killed continues, and a contestant that joins later flies alone. Files are named by their content's
causes: the worlds, the contestant, the weight and the code.
"""

import hashlib
from collections.abc import Callable, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

import uav_dc_ros
from uav_dc_ros import files, scenarios
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import State
from uav_dc_ros.errors import ParameterError, PolicyError, ScenarioError, UavDcError
from uav_dc_ros.experiments.code_hash import code_hash_of
from uav_dc_ros.experiments.evaluate.rollout import roll_out_to_end
from uav_dc_ros.experiments.evaluate.shifts import ShiftedWorld, senders
from uav_dc_ros.experiments.leaderboard.worlds import Board, BoardWorld
from uav_dc_ros.experiments.optimum.problem import ClairvoyantProblem
from uav_dc_ros.experiments.optimum.solve import solve

T = TypeVar("T")

BLOCK = 20  # worlds that one process flies
# The modules that fly; the second is loaded by its name. Everything that they import decides the results.
_ROOTS = ("uav_dc_ros.experiments.leaderboard.flights", "uav_dc_ros.scenarios.generation.random_field")


class Contestant(msgspec.Struct, frozen=True, kw_only=True):
    """What flies."""

    name: str
    argument: str  # for `agent.load`
    sha256: str | None = None  # of a policy
    search: int = 0  # see `Agent.search`


class Block(msgspec.Struct, frozen=True, kw_only=True):
    """Missions that are flown together, world by world, seeds 0 to `n_missions` - 1."""

    worlds: tuple[BoardWorld, ...]
    n_missions: int
    weight: float  # w in J
    n_bounded: int  # the first missions, which get a bound
    width: int  # of the decision diagrams behind the bounds


class BlockResult(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a contestant did in a block, by mission, world by world."""

    objective: list[float] = []  # J
    users: list[float] = []  # collected, share of all
    data: list[float] = []  # delivered, mean over the users of the share of r_min, each at most 1
    landed: list[bool] = []
    arrival: list[float] = []  # step of the arrival, share of T_cons; 1 where it did not land
    refused: str = ""  # why the contestant does not fit a world; then the lists are empty


class Bounds(msgspec.Struct, frozen=True, kw_only=True):
    """What is possible in the first missions of a block; null in worlds without a bound."""

    bound: list[float | None]  # no mission has a greater J
    found: list[float | None]  # J of the best mission that was found, with the walks known


class FlightTask(msgspec.Struct, frozen=True, kw_only=True):
    """The contestants whose results of a block are missing."""

    name: str
    block: Block
    contestants: tuple[Contestant, ...]
    bounds: bool  # whether the bounds are missing

    @property
    def n_steps(self) -> int:
        """What progress counts: worlds, and missions with a bound."""
        return len(self.block.worlds) + self.bounds * self.block.n_bounded


def blocks(board: Board, weight: float, width: int) -> list[Block]:
    """The blocks of a board."""
    found = []
    for first in range(0, len(board.worlds), BLOCK):
        worlds = board.worlds[first : first + BLOCK]
        n_bounded = min(max(board.n_bounded - first * board.n_missions, 0), len(worlds) * board.n_missions)
        found.append(
            Block(worlds=worlds, n_missions=board.n_missions, weight=weight, n_bounded=n_bounded, width=width)
        )
    return found


def task(board: Board, i: int, block: Block, contestants: Sequence[Contestant], folder: Path) -> FlightTask:
    """What is missing of the i-th block of a board."""
    missing = tuple(one for one in contestants if not result_file(folder, block, one).is_file())
    bounds = block.n_bounded > 0 and not bounds_file(folder, block).is_file()
    name = f"{board.name}, {i * BLOCK + 1} to {i * BLOCK + len(block.worlds)} of {len(board.worlds)}"
    return FlightTask(name=name, block=block, contestants=missing, bounds=bounds)


def fly(folder: Path, task: FlightTask, on_progress: Callable[[int], None]) -> None:
    """Fly what is missing of a block, and save it; `on_progress` gets the steps done, see `n_steps`."""
    block = task.block
    loaded = [(one, agents.load(one.argument, one.search)) for one in task.contestants]
    flown: dict[Contestant, list[BlockResult]] = {one: [] for one in task.contestants}
    if task.contestants:
        for n, world in enumerate(block.worlds, start=1):
            shifted = world.load()
            for one, agent in loaded:
                flown[one].append(_fly(agent, shifted, block))
            on_progress(n)
    for one, parts in flown.items():
        files.write(result_file(folder, block, one), msgspec.json.encode(joined(parts)))
    if task.bounds:
        bounds = Bounds(bound=[], found=[])
        missions = list(product(block.worlds, range(block.n_missions)))[: block.n_bounded]
        for n, (world, seed) in enumerate(missions, start=len(block.worlds) + 1):
            bound, found = _bound(world.load().scenario, seed, block)
            bounds.bound.append(bound)
            bounds.found.append(found)
            on_progress(n)
        files.write(bounds_file(folder, block), msgspec.json.encode(bounds))


def _fly(agent: agents.Agent, world: ShiftedWorld, block: Block) -> BlockResult:
    scenario, seeds = world.scenario, range(block.n_missions)
    try:
        act = agent.act_in(world.known, block.weight)
    except (PolicyError, ParameterError) as error:
        return BlockResult(refused=str(error))
    sends = senders(scenario, seeds, world.shift)
    missions, end = roll_out_to_end(scenario, act, seeds, transmitting=sends, service=False)
    arrival = np.where(missions.landed, missions.arrival_step / scenario.mission.max_steps, 1.0)
    return BlockResult(
        objective=missions.objective(scenario, block.weight).tolist(),
        users=(missions.users_collected / scenario.n_users).tolist(),
        data=data_share(scenario, end).tolist(),
        landed=missions.landed.tolist(),
        arrival=arrival.tolist(),
    )


def data_share(scenario: Scenario, state: State) -> Array:
    """Data delivered, mean over the users of the share of r_min, each at most 1, `[...]`."""
    r_min_bits = scenario.user_r_min_bits(state.data_bits)
    return np.minimum(state.data_bits / r_min_bits, 1.0).mean(axis=-1)


def _bound(scenario: Scenario, seed: int, block: Block) -> tuple[float | None, float | None]:
    try:
        problem = ClairvoyantProblem(scenario, seed)
    except ScenarioError:  # interference of the served, or a battery that ends missions
        return None, None
    solution = solve(problem, block.weight, widths=(block.width,))
    return solution.bound, solution.objective


def joined(parts: Sequence[BlockResult]) -> BlockResult:
    """One result of several, in their order; refused if one of them is."""
    refused = next((one.refused for one in parts if one.refused), "")
    if refused:
        return BlockResult(refused=refused)
    return BlockResult(
        objective=[value for one in parts for value in one.objective],
        users=[value for one in parts for value in one.users],
        data=[value for one in parts for value in one.data],
        landed=[value for one in parts for value in one.landed],
        arrival=[value for one in parts for value in one.arrival],
    )


def load_flown(folder: Path, block: Block, contestant: Contestant) -> BlockResult:
    """The result of a contestant in a block; raises UavDcError if it is missing or damaged."""
    return _load(result_file(folder, block, contestant), BlockResult)


def load_bounds(folder: Path, block: Block) -> Bounds:
    """The bounds of a block; raises UavDcError if they are missing or damaged."""
    return _load(bounds_file(folder, block), Bounds)


def result_file(folder: Path, block: Block, contestant: Contestant) -> Path:
    """File of a contestant's result in a block."""
    who = (contestant.sha256 or contestant.name, contestant.search)
    identity = (who, block.worlds, block.n_missions, block.weight)
    return folder / f"{_name(identity)}.json"


def bounds_file(folder: Path, block: Block) -> Path:
    """File of the bounds of a block."""
    return folder / f"bound_{_name(block)}.json"


def _name(identity: object) -> str:
    content = msgspec.json.encode((identity, _code_hash()))
    return hashlib.sha256(content).hexdigest()[:16]


@cache
def _code_hash() -> str:
    """Hash of the code that flies, and of the shipped scenarios."""
    digest = hashlib.sha256(code_hash_of(Path(uav_dc_ros.__file__).parent.parent, _ROOTS).encode())
    for name in scenarios.names():
        digest.update(scenarios.read(name).encode())
    return digest.hexdigest()


def _load(path: Path, kind: type[T]) -> T:
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (OSError, msgspec.DecodeError) as error:
        raise UavDcError(f"{path}: cannot be read: {error}; delete it, and it is flown again") from None
