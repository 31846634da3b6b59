"""A single mission, kept step by step for its picture."""

from dataclasses import fields
from typing import Any

from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.env.trajectory import Trajectory
from uav_dc_ros.experiments.evaluate.rollout import Act, flight


def roll_out_trajectory(scenario: Scenario, act: Act, seed: int, layout: Array | None = None) -> Trajectory:
    """Flies the mission with a seed; its users start as the seed says, or by the draws `layout` `[U, 2]`."""

    def alone(batch: Any) -> Any:
        return type(batch)(**{f.name: getattr(batch, f.name)[0, 0] for f in fields(batch)})

    track = Trajectory(scenario)
    for state, outcome in flight(scenario, act, [seed], layouts=[layout]):
        link: world.Link | None = alone(outcome.link) if outcome else None
        track.add(alone(state), link)
        if outcome and (outcome.terminated | outcome.truncated).all():
            break
    return track
