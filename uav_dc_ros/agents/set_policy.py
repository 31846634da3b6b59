"""The config of a policy that observes `entities`, and so flies in fields that it has not seen."""

from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta

from uav_dc_ros.agents import network
from uav_dc_ros.agents.set_network import SetArchitecture
from uav_dc_ros.core.entities.encoding import FEATURES
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.scenario import Scenario

NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}\Z"  # of a policy
Count: TypeAlias = Annotated[int, Meta(ge=1)]
Probability: TypeAlias = Annotated[float, Meta(ge=0, le=1)]


LearningRate: TypeAlias = Annotated[float, Meta(gt=0, le=1)]


class FlyingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the algorithms for random layouts have in common."""

    iterations: Count = 400  # rounds of flying and fitting
    layouts: Count = 12  # new ones of an iteration
    missions: Count = 40  # in each layout
    batch_size: Count = 512  # decisions in a mini-batch


class RolloutSettings(FlyingSettings, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="rollouts"):
    """Hyperparameters of policy improvement with rollouts on random layouts."""

    missions: Count = 16  # in each layout
    tested: Annotated[float, Meta(gt=0, le=1)] = 0.3  # share of the decisions in which all actions are flown
    horizon: Count = 8  # steps that are flown then; the plan estimates what the mission is worth from there
    # Steps by which an action must be worth more than the plan's own to be preferred: estimates are random.
    caution: Annotated[float, Meta(ge=0)] = 0.5
    random_moves: Annotated[float, Meta(ge=0, lt=1)] = 0.1  # share of the moves that are random
    kept: Count = 100  # iterations of which the decisions are fitted
    batch_size: Count = 1024  # decisions in a mini-batch
    batches: Count = 8  # mini-batches of an iteration
    value_rate: LearningRate = 7e-4  # learning rate of Adam for V; it falls to a fiftieth
    advantage_rate: LearningRate = 1e-3  # for A, likewise
    # Limit of the difference between an action and the plan's own, in steps, that is fitted.
    steps_max: Annotated[float, Meta(gt=0)] = 20.0


class PqnSettings(FlyingSettings, frozen=True, forbid_unknown_fields=True, kw_only=True, tag="pqn"):
    """Hyperparameters of parallelised Q-learning on random layouts."""

    epochs: Count = 1  # passes over the decisions of an iteration
    learning_rate: LearningRate = 7e-4  # of Adam; it falls to a fiftieth
    trace: Probability = 0.95  # lambda of the returns
    # Of a step. J alone makes a step that is lost cost (1 - w) / T_cons, which is less than what a network
    # resolves: with a discount of 1 it hovers between two cells until time presses.
    discount: Probability = 0.99
    # alpha of advantage learning: it makes the differences between actions 1 / (1 - alpha) times as large
    advantage: Annotated[float, Meta(ge=0, lt=1)] = 0.8
    # Share of the layouts that the planner `fixed_tour` flies as demonstrations, at the start and later
    demonstrations: Probability = 1.0
    demonstrations_end: Probability = 0.25
    shown: Annotated[float, Meta(gt=0, le=1)] = 0.1  # share of the iterations in which it falls to that
    epsilon: Probability = 0.93  # probability of the greedy action, or the planner's, at the start
    epsilon_end: Probability = 0.99  # and at the end


class SetPolicyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A policy for any field without its parameters: format 3 of `config.json`."""

    format: Literal[3] = 3
    name: Annotated[str, Meta(pattern=NAME)]  # the policy's name
    observation: Literal["entities"] = "entities"  # see `core.entities`
    features: int = FEATURES  # version of that encoding
    width: network.Width  # units of the layers of a cluster
    hidden: Annotated[
        tuple[network.Width, ...], Meta(min_length=1, max_length=16)
    ]  # units behind the pooling
    actions: tuple[str, ...] = ACTION_LABELS  # labels of the actions, in the order of the network's outputs
    hyperparameters: RolloutSettings | PqnSettings  # of training; `type` names the algorithm
    seed: Annotated[int, Meta(ge=0)]  # of its run
    iteration: Annotated[int, Meta(ge=0)]  # after which these parameters were taken
    version: str  # version of the package that made it
    scenario: dict[str, Any]  # the world in which it flies where no other is given, as plain values

    def architecture(self, scenario: Scenario) -> SetArchitecture:
        """Sizes of its network, which are those for every world."""
        return SetArchitecture(width=self.width, hidden=self.hidden, n_actions=len(self.actions))
