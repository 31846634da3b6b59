"""Results of sweeps that were never flown: what each setting reached is made up."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any
from zlib import crc32

import msgspec
import numpy as np

from tests.support.worlds import changed
from uav_dc_ros import scenarios
from uav_dc_ros.experiments.paper.plan import runs
from uav_dc_ros.experiments.paper.results import GREEDY, METRICS, Results, ScenarioFacts, SweepMetadata
from uav_dc_ros.experiments.paper.setting import FULL, PlannedRun, Scale, Setting

SHORT = msgspec.structs.replace(FULL, episodes=400)
WORLDS = {
    name: ScenarioFacts.of(scenarios.load(f"{name}_hover")) for name in ("three_clusters", "five_clusters")
}
# Where a made-up run ends by default. Its reward is that of its ratio, as in the paper.
LEVELS = {
    "episode_return": 50.0,
    "throughput_bps": 2e5,
    "users_collected": 30.0,
    "landing_rate": 0.8,
    "arrival_step": 40.0,
}


@functools.cache
def planned_runs(scale: Scale) -> tuple[PlannedRun, ...]:
    """The plan of a scale."""
    return tuple(runs(scale))


def sweep(
    levels: Callable[[Setting], dict[str, Any]] = lambda setting: {},
    scale: Scale = SHORT,
    noise: float = 0.0,
    between: Callable[[Setting, int], float] = lambda setting, environment: 0.0,
) -> Results:
    """Results whose curves rise exponentially to made-up levels.

    Args:
        levels: what differs from `LEVELS` for a setting; beside the metrics `tau`, the episodes in which 63%
            of the way is done, and `jitter`, the relative size of the ups and downs at the end.
        scale: whose plan.
        noise: relative standard deviation of points and greedy figures.
        between: relative change of all levels of a setting in an environment.
    """
    planned = planned_runs(scale)
    episode = np.arange(1, scale.n_points + 1) * scale.episodes_per_point
    curves = {metric: np.zeros((len(planned), len(episode)), np.float32) for metric in METRICS}
    greedy = {metric: np.zeros(len(planned), np.float32) for metric in GREEDY}
    ups_and_downs = np.where(np.arange(len(episode)) % 2, 1.0, -1.0)
    rng = np.random.default_rng(0)
    shapes: dict[tuple[float, float], Any] = {}
    for i, run in enumerate(planned):
        setting = run.setting
        made = {"reward": setting.beta + setting.zeta, "tau": 0.1 * scale.episodes, "jitter": 0.0}
        made |= LEVELS | levels(setting)
        here = 1 + 0.02 * run.environment + between(setting, run.environment)
        if (made["tau"], made["jitter"]) not in shapes:
            rise = 1 - np.exp(-(episode - episode[0]) / made["tau"])
            shapes[made["tau"], made["jitter"]] = (0.2 + 0.8 * rise) * (1 + made["jitter"] * ups_and_downs)
        shape = shapes[made["tau"], made["jitter"]]
        for metric in METRICS:
            curves[metric][i] = made[metric] * here * shape
            if noise:
                curves[metric][i] *= 1 + noise * rng.standard_normal(len(episode))
            shown = f"greedy_{metric.replace('episode_return', 'return')}"
            greedy[shown][i] = made.get(shown, made[metric]) * here * (1 + noise * rng.standard_normal())
    return Results(
        metadata=SweepMetadata(command="a test", scale=scale, worlds=WORLDS, greedy_missions=20),
        planned=planned,
        episode=episode,
        curves=curves,
        greedy=greedy,
    )


def realistic(scale: Scale = FULL) -> Results:
    """A sweep that looks like one that was flown."""

    def levels(setting: Setting) -> dict[str, Any]:
        beta, zeta = setting.ratio
        data = 0.8 + 0.1 * (setting.form == "episode") + 0.05 * np.log2(beta / zeta)
        data -= 0.1 * abs(np.log10(setting.learning_rate / 1e-3))
        home = 0.75 + 0.15 * (setting.r_plus == "exponential") - 0.05 * np.log2(beta / zeta)
        per_bps = WORLDS[setting.scenario].data_per_bps
        n_users = WORLDS[setting.scenario].n_users
        return {
            "reward": beta * data + zeta * home,
            "throughput_bps": data / per_bps,
            "users_collected": 0.6 * n_users * data,
            "landing_rate": min(home, 1.0),
            "arrival_step": 40 - 4 * home,
            "tau": (60 if setting.r_plus == "exponential" else 120)
            * (1e-3 / setting.learning_rate) ** 0.5
            * scale.episodes
            / 1000,
            "jitter": 0.1 if setting.learning_rate > 1e-3 else 0.0,
        }

    return sweep(
        levels,
        scale,
        0.08,
        lambda setting, environment: 0.03 * np.sin(environment * (crc32(str(setting).encode()) % 7)),
    )


def of_the_data_of_the_step(results: Results) -> Results:
    """The same numbers, as of worlds whose reward counts the data of the step."""
    worlds = {
        name: ScenarioFacts.of(changed(f"{name}_hover", reward={"data": "step"}))
        for name in results.metadata.worlds
    }
    metadata = msgspec.structs.replace(results.metadata, worlds=worlds)
    return dataclasses.replace(results, metadata=metadata)
