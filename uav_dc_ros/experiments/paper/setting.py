"""Settings, runs and scales of the sweep.

The run of environment e and repeat r has the seed `1000 r + e` in every setting. So all settings have the
same users and the same random numbers, and differences within an environment are paired (common random
numbers). Two runs share their stream as long as they draw equally many numbers, so runs with different batch
sizes share only the initial users.

Environments come in blocks: those of block b are `10,000 b`, `10,000 b + 1`, ..., so blocks share no layout
and no seed. Worlds and rules were chosen on block 0; the others are for confirming what was found there.
"""

from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import NamedTuple, TypeAlias

import msgspec

from uav_dc_ros import scenarios
from uav_dc_ros.agents.policy import Algorithm, Hyperparameters
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.reward import RewardForm, RPlus
from uav_dc_ros.experiments.train.population import Run

Ratio: TypeAlias = tuple[float, float]

OBSERVATION: Observation = "position"  # the paper's state: a network's input is the UAV's cell
# The learner of the chosen world: the paper leaves all three open. See docs/paper/worlds.md.
HIDDEN = (32, 32)
TARGET_EVERY = 1631  # iterations between copies to the target network
BUFFER_SIZE = 4227  # transitions in the replay buffer
ALGORITHMS: tuple[Algorithm, ...] = ("dqn", "dueling_dqn")
R_PLUS: tuple[RPlus, ...] = ("binary", "exponential")
FORMS: tuple[RewardForm, ...] = ("immediate", "episode")
# beta, zeta as the paper writes them: 2:1 is beta = 2, zeta = 1. Rewards of different ratios therefore
# have different scales.
RATIOS: tuple[Ratio, ...] = ((1, 4), (1, 3), (1, 2), (1, 1), (2, 1), (3, 1), (4, 1))
# "We run the algorithm five times in five different environmental settings": five layouts of the users. Five
# more narrow the intervals; the report has the verdicts of the first five, too.
PAPER_ENVIRONMENTS = 5
N_ENVIRONMENTS = 10
BLOCK_SIZE = 10_000  # numbers of environments from block to block
MAX_BLOCK = 99  # its seeds are below the first of validation


class Scale(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Size of a sweep."""

    name: str
    block: int = 0
    episodes: int  # training missions of every run
    episodes_per_point: int  # consecutive missions whose mean is a point of a curve
    environments: tuple[int, ...]  # layouts of the users
    repeats: int  # runs of each setting in each environment
    ratios: tuple[Ratio, ...]
    gammas: tuple[float, ...]
    epsilons: tuple[float, ...]
    batch_sizes: tuple[int, ...]
    learning_rates: tuple[float, ...]

    def in_block(self, block: int) -> "Scale":
        """The scale of block 0 with the environments of another block."""
        environments = tuple(BLOCK_SIZE * block + environment for environment in self.environments)
        return msgspec.structs.replace(self, block=block, environments=environments)

    @property
    def n_points(self) -> int:
        """Points of a curve."""
        return self.episodes // self.episodes_per_point


FULL = Scale(
    name="full",
    # The paper calls curves stable after about 400; its axes are not in the source. More than twice that
    # shows whether they are.
    episodes=1000,
    # Ten missions even out the exploration of each, and leave a hundred points.
    episodes_per_point=10,
    environments=tuple(range(N_ENVIRONMENTS)),
    # As in the paper: twice as many environments narrow an interval more than a second run in each.
    repeats=1,
    ratios=RATIOS,
    # The paper states the best values, 0.9 and 0.9, and not the grid: values on either side.
    gammas=(0.8, 0.9, 0.95, 0.99),
    epsilons=(0.7, 0.8, 0.9, 0.95),
    # Likewise: powers of two around 32.
    batch_sizes=(8, 16, 32, 64, 128),
    # All four are in the paper's text.
    learning_rates=(1e-2, 1e-3, 1e-4, 1e-5),
)
# Shows in a minute that every figure and every claim can be made; its numbers mean nothing. The ratios are
# those that a claim names, and one on either side of 1:1 for the claims on "above" and "below".
SMOKE = Scale(
    name="smoke",
    episodes=10,
    episodes_per_point=1,
    environments=(0, 1),
    repeats=1,
    ratios=((1, 2), (1, 1), (2, 1)),
    gammas=(0.9, 0.99),
    epsilons=(0.8, 0.9),
    batch_sizes=(8, 32),
    learning_rates=(1e-2, 1e-3, 1e-4, 1e-5),
)
SCALES = {scale.name: scale for scale in (FULL, SMOKE)}


class Setting(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the paper compares: a scenario, a learner and a reward. The defaults are the paper's."""

    scenario: str = "five_clusters"
    algorithm: Algorithm = "dqn"
    r_plus: RPlus = "exponential"
    form: RewardForm = "episode"
    beta: float = 1
    zeta: float = 1
    gamma: float = 0.9
    epsilon: float = 0.9
    batch_size: int = 32
    learning_rate: float = 1e-3

    @property
    def ratio(self) -> Ratio:
        """The weights beta and zeta."""
        return self.beta, self.zeta

    def with_(self, **values: object) -> "Setting":
        """The setting with other values; `ratio` stands for beta and zeta."""
        if "ratio" in values:
            values["beta"], values["zeta"] = values.pop("ratio")  # type: ignore[misc]
        return msgspec.structs.replace(self, **values)

    def along(self, axes: Sequence[str], scale: Scale) -> list["Setting"]:
        """Every combination of the values of `axes` in the sweep; the last axis varies fastest."""
        points = product(*(domain(axis, scale) for axis in axes))
        return [self.with_(**dict(zip(axes, point, strict=True))) for point in points]

    def values(self, axes: Sequence[str]) -> tuple[object, ...]:
        """Its values on `axes`."""
        return tuple(getattr(self, axis) for axis in axes)


class PlannedRun(NamedTuple):
    """One run of the sweep."""

    setting: Setting
    environment: int  # layout of the users
    repeat: int

    @property
    def seed(self) -> int:
        """Seed of the run: equal for all settings."""
        return 1000 * self.repeat + self.environment

    def run(self, scale: Scale) -> Run:
        """The run of the trainer."""
        setting = self.setting
        reward = msgspec.structs.replace(
            _scenario(setting.scenario).reward,
            beta=float(setting.beta),
            zeta=float(setting.zeta),
            r_plus=setting.r_plus,
            form=setting.form,
        )
        return Run(
            seed=self.seed,
            environment=self.environment,
            algorithm=setting.algorithm,
            reward=reward,
            hyperparameters=Hyperparameters(
                gamma=setting.gamma,
                epsilon=setting.epsilon,
                batch_size=setting.batch_size,
                learning_rate=setting.learning_rate,
                episodes=scale.episodes,
                target_every=TARGET_EVERY,
                buffer_size=BUFFER_SIZE,
            ),
        )


def domain(axis: str, scale: Scale) -> Sequence[object]:
    """The values of an axis in the sweep: a field of `Setting`, or `ratio`."""
    domains: dict[str, Sequence[object]] = {
        "algorithm": ALGORITHMS,
        "r_plus": R_PLUS,
        "form": FORMS,
        "ratio": scale.ratios,
        "gamma": scale.gammas,
        "epsilon": scale.epsilons,
        "batch_size": scale.batch_sizes,
        "learning_rate": scale.learning_rates,
    }
    return domains[axis]


def name(value: object) -> str:
    """A value of a setting in words."""
    if isinstance(value, tuple):
        return f"{value[0]:g}:{value[1]:g}"
    words = {
        "dqn": "DQL",
        "dueling_dqn": "dueling DQL",
        "three_clusters": "3 clusters",
        "five_clusters": "5 clusters",
    }
    return words.get(value, value) if isinstance(value, str) else f"{value:g}"


_scenario = cache(scenarios.load)
