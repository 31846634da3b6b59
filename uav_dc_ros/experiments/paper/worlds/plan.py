"""The runs of a world: those that the claims read, at a scale that 64 worlds can afford.

Budget: 64 worlds in 90 minutes on 2 cores are 10,800 core-seconds, 169 for each world. `FULL` takes about 80%
of that, see docs/paper/README.md.
"""

from collections.abc import Iterable, Sequence
from functools import cache, partial

import msgspec
import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.experiments.paper import setting, sweep
from uav_dc_ros.experiments.paper.claims.criteria import Claim
from uav_dc_ros.experiments.paper.claims.findings import CLAIMS, Finding, finding
from uav_dc_ros.experiments.paper.evidence import Evidence
from uav_dc_ros.experiments.paper.results import GREEDY, METRICS, Results, ScenarioFacts, SweepMetadata
from uav_dc_ros.experiments.paper.setting import OBSERVATION, PlannedRun, Scale, Setting, domain
from uav_dc_ros.experiments.paper.shards import Shard
from uav_dc_ros.experiments.paper.sweep import GREEDY_SEEDS, RunResults
from uav_dc_ros.experiments.paper.worlds import draw
from uav_dc_ros.experiments.paper.worlds.draw import World
from uav_dc_ros.experiments.train.population import Population

SCENARIOS = ("five_clusters", "three_clusters")
# Layouts and seeds that the sweep does not use: the choice of a world must not see what confirms it.
ENVIRONMENTS = tuple(range(100, 140))
FULL = msgspec.structs.replace(
    setting.FULL,
    # The paper calls curves stable after about 400.
    episodes=400,
    environments=ENVIRONMENTS[:5],
    repeats=1,
    # Those that a claim names (1:2, 1:1, 2:1), and 4:1: most claims on ratios are on the side above 1:1.
    ratios=((1, 2), (1, 1), (2, 1), (4, 1)),
)
SMOKE = msgspec.structs.replace(
    setting.SMOKE, environments=ENVIRONMENTS[:2], episodes=5, ratios=((1, 2), (1, 1), (2, 1))
)
SCALES = {scale.name: scale for scale in (FULL, SMOKE)}
# Weighed in twice as many environments as the others. The choice of a world rests on C1, which compares one
# setting with a number, so that its interval is wide and its runs are few.
WIDE = ("C1",)
# Screening takes as many; where they leave C1 undecided, so many times those of the other claims.
WIDEST = 8
# Claims that are not weighed: undecided in every world.
CUT = {
    "C18": "its 16 pairs of gamma and epsilon would take 75 more runs in each world, 30% of the budget",
    "C19": "its other batch sizes would take as long as 40 runs more; the paper calls the difference slight",
}


class _Needs(Evidence):
    """Evidence that records the settings that a claim reads; its numbers are made up."""

    def __init__(self, scale: Scale) -> None:
        facts = ScenarioFacts(fingerprint="", n_users=50, max_steps=1, data_per_bps=1.0)
        worlds = dict.fromkeys(SCENARIOS, facts)
        no_points, no_runs = np.zeros((0, scale.n_points)), np.zeros(0)
        super().__init__(
            Results(
                metadata=SweepMetadata(command="", scale=scale, worlds=worlds, greedy_missions=0),
                planned=(),
                episode=scale.episodes_per_point * (1 + np.arange(scale.n_points)),
                curves=dict.fromkeys(METRICS, no_points),
                greedy=dict.fromkeys(GREEDY, no_runs),
            )
        )
        self.settings: dict[Setting, None] = {}
        self._rng = np.random.default_rng(0)

    def of(self, measure: str, setting: Setting, *axes: str) -> Array:
        self.settings |= dict.fromkeys(setting.along(axes, self.scale))
        return self._made_up(*(len(domain(axis, self.scale)) for axis in axes))

    def curves(self, metric: str, setting: Setting) -> Array:
        self.settings[setting] = None
        return self._made_up(self.scale.n_points)

    def reach(self, setting: Setting, goal: Array) -> Array:
        self.settings[setting] = None
        return self._made_up()

    def _made_up(self, *shape: int) -> Array:
        return 1.0 + self._rng.random((len(self.scale.environments), *shape))


def settings(claims: Iterable[Claim], scale: Scale) -> list[Setting]:
    """The settings that claims read, each once, in a fixed order."""
    needs = _Needs(scale)
    for claim in claims:
        list(claim.test(needs))
    return list(needs.settings)


@cache
def planned(scale: Scale) -> tuple[PlannedRun, ...]:
    """The runs of every world."""
    return tuple(dict.fromkeys(run for _, _, runs in _groups(scale) for run in runs))


@cache
def _groups(scale: Scale) -> tuple[tuple[Scale, tuple[Claim, ...], tuple[PlannedRun, ...]], ...]:
    """Claims that are weighed at one scale, with their runs."""
    others = tuple(claim for claim in CLAIMS if claim.id not in (*WIDE, *CUT))
    return (scale, others, _runs(others, scale)), _screening(scale, wide(scale))


def wide(scale: Scale, times: int = 2) -> tuple[int, ...]:
    """Environments of the claims in `WIDE`: so many times those of the scale."""
    return ENVIRONMENTS[: times * len(scale.environments)]


def _runs(claims: Iterable[Claim], scale: Scale) -> tuple[PlannedRun, ...]:
    return tuple(
        PlannedRun(one, environment, repeat)
        for one in settings(claims, scale)
        for environment in scale.environments
        for repeat in range(scale.repeats)
    )


def make_shards(world: World, scale: Scale) -> list[tuple[Shard, list[PlannedRun]]]:
    """The runs of a world as shards."""
    return sweep.make_shards(planned(scale), scale, partial(population, world))


def screening_worlds(first: int, n: int) -> list[World]:
    """The n worlds, from number `first` on, whose episode ends at the time limit: see `choose`."""
    count = 2 * n
    while True:
        following = draw.worlds(first + count)[0][first:]
        found = [world for world in following if world.episode_end == "at_time_limit"]
        if len(found) >= n:
            return found[:n]
        count += n


def make_screening_shards(
    world: World, scale: Scale, environments: Sequence[int]
) -> list[tuple[Shard, list[PlannedRun]]]:
    """The runs of a world that the claims in `WIDE` read in some environments, as shards."""
    (_, _, runs) = _screening(scale, tuple(environments))
    return sweep.make_shards(runs, scale, partial(population, world))


@cache
def _screening(
    scale: Scale, environments: tuple[int, ...]
) -> tuple[Scale, tuple[Claim, ...], tuple[PlannedRun, ...]]:
    of = msgspec.structs.replace(scale, environments=environments)
    claims = tuple(claim for claim in CLAIMS if claim.id in WIDE)
    return of, claims, _runs(claims, of)


def population(world: World, scenario: str, runs: Sequence[PlannedRun], scale: Scale) -> Population:
    """Planned runs in a world: its data, its scale and its learner in place of the sweep's."""

    def run(one: PlannedRun) -> object:
        made = one.run(scale)
        return msgspec.structs.replace(
            made,
            reward=msgspec.structs.replace(
                made.reward, data=world.data, data_scale_bits=world.data_scale_bits
            ),
            hyperparameters=msgspec.structs.replace(
                made.hyperparameters, target_every=world.target_every, buffer_size=world.buffer_size
            ),
        )

    return Population(
        scenario=world.scenario(scenario),
        observation=OBSERVATION,
        hidden=world.layers,
        runs=tuple(run(one) for one in runs),  # type: ignore[misc]
    )


def findings(world: World, scale: Scale, found: RunResults) -> list[Finding]:
    """Every claim, tested by the sweep's rules in one world; those of `CUT` are `not tested`."""
    tested = {claim: Finding(claim, "not tested", ()) for claim in CLAIMS}
    for group in _groups(scale):
        tested |= {one.claim: one for one in _tested(world, *group, found)}
    return list(tested.values())


def screening_findings(
    world: World, scale: Scale, environments: Sequence[int], found: RunResults
) -> list[Finding]:
    """The claims in `WIDE`, tested in some environments of a world."""
    return _tested(world, *_screening(scale, tuple(environments)), found)


def _tested(
    world: World, scale: Scale, claims: Sequence[Claim], runs: Sequence[PlannedRun], found: RunResults
) -> list[Finding]:
    facts = {name: ScenarioFacts.of(world.scenario(name), any_end=True) for name in SCENARIOS}
    metadata = SweepMetadata(command="", scale=scale, worlds=facts, greedy_missions=GREEDY_SEEDS[1])
    evidence = Evidence(sweep.collect(runs, metadata, found))
    # A reward or a throughput of exactly 0 has no relative difference: an equality is then undecided.
    with np.errstate(divide="ignore", invalid="ignore"):
        return [finding(claim, evidence) for claim in claims]
