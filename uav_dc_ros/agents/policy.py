"""A trained policy: a folder, and what flies from it. Needs numpy only.

A policy is a folder: `config.json` (a `PolicyConfig`), `model.safetensors` (the parameters of the network),
`README.md` (the card: what it is, how it was made, how it does) and its pictures.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
import numpy as np
import safetensors.numpy
from msgspec import UNSET, Meta, UnsetType
from safetensors import SafetensorError

from uav_dc_ros import files, scenarios
from uav_dc_ros.agents import network, set_network
from uav_dc_ros.agents.set_network import SetArchitecture
from uav_dc_ros.agents.set_policy import NAME, Count, Probability, SetPolicyConfig
from uav_dc_ros.core import observations
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.entities.encoding import FEATURES, allowed
from uav_dc_ros.core.grid import ACTION_LABELS
from uav_dc_ros.core.observations import Observation
from uav_dc_ros.core.scenario import Scenario, from_values
from uav_dc_ros.errors import PolicyError, ScenarioError

NAME_IN_WORDS = "at most 64 letters (a to z, A to Z), digits, '_', '.' and '-', a letter or digit first"
CONFIG, MODEL, CARD = "config.json", "model.safetensors", "README.md"
LEARNING_CURVE, TRAJECTORY = "learning_curve.png", "trajectory.png"

Algorithm: TypeAlias = Literal["dqn", "dueling_dqn", "double_dqn", "dueling_double_dqn"]


class Hyperparameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Hyperparameters of training; the defaults are the paper's where it gives one."""

    gamma: Probability = 0.9  # discount
    epsilon: Probability = 0.9  # probability of the greedy action
    batch_size: Count = 32  # transitions in a mini-batch
    learning_rate: Annotated[float, Meta(gt=0, le=1)] = 1e-3  # of Adam
    # Iterations between copies to the target network. The paper leaves it open; 500 is about eight missions.
    target_every: Count = 500
    # Transitions in the replay buffer. The paper leaves it open; 50 000 is about 800 missions.
    buffer_size: Count = 50_000
    episodes: Count = 2000  # missions of training
    # Steps of a return before the target network's value; absent: 1, as in the paper
    n_step: Annotated[int, Meta(ge=2, le=1000)] | UnsetType = UNSET


class PolicyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A policy without its parameters."""

    format: Literal[1] = 1  # version of this file's layout
    name: Annotated[str, Meta(pattern=NAME)]  # the policy's name
    algorithm: Algorithm  # the network, plain or dueling, and its target; see `dqn`
    aggregation: network.Aggregation = "mean"  # subtracted by a dueling network; ignored for a plain one
    observation: Observation  # encoding, see `core.observations`
    hidden: Annotated[tuple[network.Width, ...], Meta(min_length=1, max_length=16)]  # units of each layer
    actions: tuple[str, ...] = ACTION_LABELS  # labels of the actions, in the order of the network's outputs
    hyperparameters: Hyperparameters  # of training
    seed: Annotated[int, Meta(ge=0)]  # seed of its run
    episode: Annotated[int, Meta(ge=0)]  # episode after which these parameters were taken
    version: str  # version of the package that made it
    scenario: dict[str, Any]  # the world it was trained in, as plain values

    def architecture(self, scenario: Scenario) -> network.Architecture:
        """Sizes of its network for the world it was trained in."""
        return network.Architecture(
            n_inputs=observations.size(self.observation, scenario),
            hidden=self.hidden,
            n_actions=len(self.actions),
            dueling=self.aggregation if self.algorithm.startswith("dueling") else None,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Policy:
    """A trained policy."""

    folder: Path  # folder that it was loaded from
    config: PolicyConfig | SetPolicyConfig  # everything except the parameters
    scenario: Scenario  # the world it was trained in; of one for any field that in which it flies by default
    parameters: Mapping[str, Array]  # of its network, float32, as named by its `shapes`
    sha256: str  # hash of config and model, in hex: identifies exactly what flew

    @property
    def name(self) -> str:
        """The policy's name; of a shipped policy that of its folder, since shipped ones have been renamed."""
        shipped = self.folder.resolve().parent == files.shipped_folder("policies").resolve()
        return self.folder.name if shipped else self.config.name

    @cached_property
    def _architecture(self) -> network.Architecture | SetArchitecture:
        return self.config.architecture(self.scenario)

    @cached_property
    def _float64(self) -> network.Parameters:
        # The last digit of a product depends on the batch size: in float64 it cannot decide an action.
        return {name: np.asarray(values, np.float64) for name, values in self.parameters.items()}

    def observe(
        self,
        scenario: Scenario,
        *,
        cell: Array,
        step: Array,
        data_bits: Array,
        collected: Array,
        delivered_bits: Array | None = None,
        energy_used_j: Array | None = None,
        weight: Array | float | None = None,
    ) -> Array:
        """The policy's observation of a mission, float32 `[..., D]`; see `core.observations.encode`."""
        return observations.encode(
            self.config.observation,
            scenario,
            cell=cell,
            step=step,
            data_bits=data_bits,
            collected=collected,
            delivered_bits=delivered_bits,
            energy_used_j=energy_used_j,
            weight=weight,
        )

    def q_values(self, observation: Array) -> Array:
        """Q(s, a) of observations `[..., D]`, float64 `[..., A]`."""
        return self._of_actions(observation, set_network.q_values)

    def _of_actions(self, observation: Array, of_sets: Callable[..., Array]) -> Array:
        """A number for each action by the network, or by the function `of_sets` of one for any field."""
        rows = np.asarray(observation, np.float64).reshape(-1, observation.shape[-1])
        if isinstance(self._architecture, SetArchitecture):
            values = of_sets(self._architecture, self._float64, rows)
        else:
            values = network.q_values(self._architecture, self._float64, rows)
        return values.reshape(*observation.shape[:-1], self._architecture.n_actions)

    def act(self, observation: Array, mask: Array | None = None) -> Array:
        """The greedy action for observations `[..., D]`: values of `core.grid.Action`, `[...]`.

        Among obstacles it is the best one in a mask, bool `[..., A]`; see `core.world.action_mask`. With the
        observation `entities` it is the best one of those that the observation names, see
        `core.entities.encoding.allowed`.
        """
        # V of a network for sets decides nothing, and takes as long as the rest.
        values = self._of_actions(observation, set_network.preferences)
        if self.config.observation == "entities":
            mask = allowed(observation)
        return (values if mask is None else np.where(mask, values, -np.inf)).argmax(axis=-1)

    def check(self, scenario: Scenario) -> None:
        """Reject a world in which the policy's observations have another meaning.

        Raises:
            PolicyError: another grid or, unless it observes its position only, another number of clusters; or
                no battery, which it observes. A policy for any field refuses one that is larger than what it
                observes.
        """
        own = self.scenario
        if (problem := observations.problem(self.config.observation, scenario)) is not None:
            raise PolicyError(f"policy {self.name!r} needs {problem}")
        if isinstance(self.config, SetPolicyConfig):
            return
        facts: list[tuple[str, object, object]] = [
            ("the grid's number of cells east, north, up", own.grid.shape, scenario.grid.shape)
        ]
        if self.config.observation != "position":
            facts.append(("the number of clusters", own.n_clusters, scenario.n_clusters))
        for fact, expected, value in facts:
            if value != expected:
                raise PolicyError(
                    f"policy {self.name!r} does not fit scenario {scenario.name!r}: {fact} is {value}; "
                    f"expected {expected}, as in {own.name!r}, where it was trained"
                )


def names() -> list[str]:
    """Names of the shipped policies."""
    # A hidden folder is the partial one of a killed `save`.
    return sorted(path.parent.name for path in files.shipped_folder("policies").glob(f"[!.]*/{CONFIG}"))


def load(name_or_path: str | Path) -> Policy:
    """The policy with a shipped name, or in the folder at a path.

    Raises:
        PolicyError: no such policy, a missing or damaged file, or a model that does not match the config.
    """
    name = str(name_or_path)
    folder = files.shipped_folder("policies") / name if name in names() else Path(name_or_path)
    if not folder.is_dir():
        raise PolicyError(
            f"policy {name!r}: no such name or folder; expected one of {', '.join(names()) or '(none)'}, "
            f"or the path of a folder with {CONFIG} and {MODEL}"
        )
    path, model_path = folder / CONFIG, folder / MODEL
    config_bytes, model_bytes = _read(path), _read(model_path)
    try:
        config = _config(config_bytes, path)
        scenario = scenarios.as_shipped(from_values(config.scenario, f"{path}: scenario"))
        if (problem := observations.problem(config.observation, scenario)) is not None:
            raise PolicyError(f"{path}: {problem}")
    except msgspec.MsgspecError as error:
        raise PolicyError(f"{path}: {error}") from None
    except ScenarioError as error:
        raise PolicyError(str(error)) from None
    if config.actions != ACTION_LABELS:
        raise PolicyError(f"{path}: actions = {list(config.actions)}; expected {list(ACTION_LABELS)}")
    if isinstance(config, SetPolicyConfig) and config.features != FEATURES:
        raise PolicyError(f"{path}: features = {config.features}; expected {FEATURES}, of this version")
    parameters = _parameters(model_bytes, config.architecture(scenario), model_path)
    sha256 = hashlib.sha256(config_bytes + model_bytes).hexdigest()
    return Policy(folder=folder, config=config, scenario=scenario, parameters=parameters, sha256=sha256)


def save(
    folder: Path,
    config: PolicyConfig | SetPolicyConfig,
    parameters: Mapping[str, Array],
    card: Callable[[Policy], str],
    draw: Callable[[Policy, Path], None] | None = None,
) -> None:
    """Write a policy's folder, completely or not at all.

    `card` returns the text of README.md, and `draw` draws pictures, of the policy as loaded from the new
    folder.

    Raises:
        PolicyError: `folder` exists or cannot be written, or the new policy cannot be loaded.
    """
    check_new(folder)
    arrays = {name: np.ascontiguousarray(values, np.float32) for name, values in parameters.items()}
    try:
        with files.building(folder) as partial:
            (partial / MODEL).write_bytes(safetensors.numpy.save(arrays))
            (partial / CONFIG).write_bytes(msgspec.json.format(msgspec.json.encode(config), indent=2) + b"\n")
            policy = load(partial)
            (partial / CARD).write_text(card(policy), "utf-8")
            if draw:
                draw(policy, partial)
    except OSError as error:
        raise PolicyError(f"policy {str(folder)!r} cannot be written: {error}") from None


def check_new(folder: Path) -> None:
    """Raise PolicyError when `folder` exists: a policy is never overwritten."""
    if folder.exists():
        raise PolicyError(f"{str(folder)!r} exists; expected a new folder, a policy is never overwritten")


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read: {error.strerror}") from None


class _Format(msgspec.Struct):
    format: Any = 1


def _config(text: bytes, path: Path) -> PolicyConfig | SetPolicyConfig:
    """The config in a file; `format` names its type."""
    number = msgspec.json.decode(text, type=_Format).format
    if number == 2:  # of a development version, whose networks added to the plan
        raise PolicyError(f"{path}: format = 2; expected 3, which `train --scenario random` writes")
    if number == 3:
        return msgspec.json.decode(text, type=SetPolicyConfig)
    return msgspec.json.decode(text, type=PolicyConfig)


def _parameters(
    model: bytes, architecture: network.Architecture | SetArchitecture, path: Path
) -> dict[str, Array]:
    """The arrays in a model file, checked against the architecture."""
    try:
        arrays = safetensors.numpy.load(model)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise PolicyError(f"{path}: damaged or not a safetensors file: {error}") from None
    if isinstance(architecture, SetArchitecture):
        expected = set_network.shapes(architecture)
    else:
        expected = network.shapes(architecture)
    for name in sorted(expected.keys() | arrays.keys()):
        if name not in arrays:
            raise PolicyError(f"{path}: tensor {name!r} is missing; expected shape {expected[name]}")
        if name not in expected:
            raise PolicyError(f"{path}: unexpected tensor {name!r}; expected {', '.join(expected)}")
        if arrays[name].shape != expected[name] or arrays[name].dtype != np.float32:
            raise PolicyError(
                f"{path}: tensor {name!r} is {arrays[name].dtype} {arrays[name].shape}; "
                f"expected float32 {expected[name]}"
            )
        if not np.isfinite(arrays[name]).all():
            raise PolicyError(f"{path}: tensor {name!r} holds values that are not finite numbers")
    return arrays
