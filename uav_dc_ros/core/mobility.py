"""The users' start positions, and how they move: `users.mobility` names the model.

`random_walk`      the paper's: a new direction and speed in each step
`static`           users stay where they start
`random_waypoint`  straight to a random point, a pause, then to the next. Johnson and Maltz, "Dynamic Source
                   Routing in Ad Hoc Wireless Networks", in: Mobile Computing, Kluwer, 1996
`gauss_markov`     a velocity that keeps a share of itself. Liang and Haas, "Predictive Distance-Based
                   Mobility Management for PCS Networks", INFOCOM 1999; users stay in the field by reflection

A model is a pure function of positions, of what it remembers (`motion`), and of uniform draws. docs/users.md
writes the formulas out, with their stationary distributions.
"""

import math
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import msgspec
import numpy as np
from msgspec import Meta

from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.propagation.counter_random import seed_of
from uav_dc_ros.core.propagation.stochastic import Seeds

if TYPE_CHECKING:  # a scenario holds a `Mobility`
    from uav_dc_ros.core.scenario import Scenario

Positive: TypeAlias = Annotated[float, Meta(gt=0)]


class MobilityModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="model"):
    """A mobility model."""

    @property
    def n_draws(self) -> int:
        """Uniform draws of a user for its start, and again for each step."""
        return 2


class RandomWalk(MobilityModel, frozen=True, tag="random_walk"):
    """The paper's random walk, up to `users.v_max_mps`; the model of a scenario that names none."""


class Static(MobilityModel, frozen=True, tag="static"):
    """Users stay where they start."""


class RandomWaypoint(MobilityModel, frozen=True, tag="random_waypoint"):
    """Random waypoints; see `_to_waypoints`."""

    # v_min_mps, v_max_mps: speed of a leg, uniform in between, m/s. Above 0: otherwise the mean speed decays
    # to 0, since the slower a leg, the longer it lasts.
    v_min_mps: Positive
    v_max_mps: Positive
    pause_s: Annotated[float, Meta(ge=0)]  # pause at each waypoint, seconds
    # Waypoints are uniform in the grid's area (`Grid.area_m`), or in the disc in which the user starts.
    waypoints: Literal["field", "start_disc"] = "field"

    @property
    def n_draws(self) -> int:
        """Two for the waypoint, one for the speed."""
        return 3


class GaussMarkov(MobilityModel, frozen=True, tag="gauss_markov"):
    """Gauss-Markov velocity; see `_gauss_markov`."""

    alpha: Annotated[float, Meta(ge=0, le=1)]  # correlation of the velocity in one step and the next
    mean_speed_mps: Positive  # mean of the speed, m/s

    @property
    def n_draws(self) -> int:
        """Two for the start, two for its velocity."""
        return 4

    @property
    def sigma_mps(self) -> float:
        """Standard deviation of each component of the velocity, m/s: the speed is Rayleigh distributed."""
        return self.mean_speed_mps * math.sqrt(2.0 / math.pi)


Mobility: TypeAlias = RandomWalk | Static | RandomWaypoint | GaussMarkov


def begin(scenario: "Scenario", draws: Array) -> tuple[Array, Array]:
    """Start positions, metres, `[..., U, 2]`, and motion, from uniform draws `[..., U, D]`.

    D is `scenario.draws_shape[1]`. Motion is what the model remembers, see `move`.
    """
    model = scenario.users.moves
    centres_m = constant(scenario.user_centres_m, draws)
    users_m = scatter(centres_m, scenario.user_radii_m(draws), draws)
    if isinstance(model, RandomWaypoint):
        # At a waypoint whose pause is over: the first leg starts with the first step.
        resting = draws[..., :1] * 0.0
        return users_m, array_namespace(draws).concat([users_m, resting + 1.0, resting], axis=-1)
    if isinstance(model, GaussMarkov):
        velocity_mps = _normal(draws[..., 2:]) * model.sigma_mps
        return _reflect(scenario, users_m, velocity_mps)
    return users_m, draws[..., :0]


def move(scenario: "Scenario", users_m: Array, motion: Array, draws: Array) -> tuple[Array, Array]:
    """Positions, metres, `[..., U, 2]`, and motion after a step, from uniform draws `[..., U, D]`.

    Motion is that of `begin` or of the step before: of `random_waypoint` the waypoint x, y (m), the speed
    (m/s) and the pause that is due there (s), `[..., U, 4]`; of `gauss_markov` the velocity x, y (m/s),
    `[..., U, 2]`; of other models nothing, `[..., U, 0]`.
    """
    model, step_s = scenario.users.moves, scenario.mission.step_s
    match model:
        case RandomWalk():
            assert scenario.users.v_max_mps is not None, "checked by parse()"
            return walk(users_m, scenario.users.v_max_mps, step_s, draws), motion
        case Static():
            return users_m, motion
        case RandomWaypoint():
            return _to_waypoints(scenario, model, users_m, motion, draws)
        case GaussMarkov():
            kept, fresh = model.alpha, model.sigma_mps * math.sqrt(1.0 - model.alpha * model.alpha)
            velocity_mps = kept * motion + fresh * _normal(draws)
            return _reflect(scenario, users_m + velocity_mps * step_s, velocity_mps)


def scatter(centres_m: Array, radius_m: float | Array, draws: Array) -> Array:
    """Points, metres, `[..., U, 2]`, from uniform draws `[..., U, 2]` or more.

    They are uniform by area in a disc of radius C, a number or `[U]`, around each user's centre, `[U, 2]`.
    """
    xp = array_namespace(draws)
    # The square root makes equal areas, not equal radii, equally likely.
    return centres_m + _polar(radius_m * xp.sqrt(draws[..., 0]), draws[..., 1])


def walk(users_m: Array, v_max_mps: float, step_s: float, draws: Array) -> Array:
    """Positions after one step of the unbounded random walk, metres, `[..., U, 2]`, from uniform draws.

    Speeds (up to v) and directions are uniform. `users_m` and `draws` are `[..., U, 2]`.
    """
    return users_m + _polar(v_max_mps * step_s * draws[..., 0], draws[..., 1])


def _to_waypoints(
    scenario: "Scenario", model: RandomWaypoint, users_m: Array, motion: Array, draws: Array
) -> tuple[Array, Array]:
    """A step of the random waypoint model, in continuous time up to the second waypoint within the step.

    A user that reaches a second waypoint within a step stays there at least to the end of the step.
    """
    xp = array_namespace(draws)
    waypoint_m, speed_mps, pause_s = motion[..., :2], motion[..., 2], motion[..., 3]
    left_s = xp.zeros_like(speed_mps) + scenario.mission.step_s
    users_m, left_s = _go(users_m, waypoint_m, speed_mps, left_s)
    paused_s = xp.minimum(pause_s, left_s)
    left_s, pause_s = left_s - paused_s, pause_s - paused_s
    if model.waypoints == "field":
        (west_m, south_m), (east_m, north_m) = scenario.grid.area_m
        origin_m = constant((west_m, south_m), draws)
        fresh_m = origin_m + draws[..., :2] * constant((east_m - west_m, north_m - south_m), draws)
    else:
        centres_m = constant(scenario.user_centres_m, draws)
        fresh_m = scatter(centres_m, scenario.user_radii_m(draws), draws)
    leaves = left_s > 0.0  # it has reached its waypoint, and its pause is over
    waypoint_m = xp.where(leaves[..., None], fresh_m, waypoint_m)
    speed_mps = xp.where(
        leaves, model.v_min_mps + (model.v_max_mps - model.v_min_mps) * draws[..., 2], speed_mps
    )
    pause_s = xp.where(leaves, xp.zeros_like(pause_s) + model.pause_s, pause_s)
    users_m, left_s = _go(users_m, waypoint_m, speed_mps, left_s)
    pause_s = xp.maximum(pause_s - left_s, xp.zeros_like(pause_s))
    return users_m, xp.concat([waypoint_m, speed_mps[..., None], pause_s[..., None]], axis=-1)


def _go(users_m: Array, waypoint_m: Array, speed_mps: Array, time_s: Array) -> tuple[Array, Array]:
    """Positions `[..., U, 2]` after a time on the way to a waypoint, and the time left there, `[..., U]`."""
    xp = array_namespace(users_m)
    way_m = waypoint_m - users_m
    length_m, reach_m = xp.sqrt((way_m * way_m).sum(axis=-1)), speed_mps * time_s
    arrived = reach_m >= length_m
    share = reach_m / xp.where(arrived, xp.ones_like(length_m), length_m)
    users_m = xp.where(arrived[..., None], waypoint_m, users_m + share[..., None] * way_m)
    left_s = xp.where(arrived, time_s - length_m / speed_mps, xp.zeros_like(time_s))
    return users_m, xp.maximum(left_s, xp.zeros_like(left_s))  # rounding


def _reflect(scenario: "Scenario", users_m: Array, velocity_mps: Array) -> tuple[Array, Array]:
    """Positions and velocities, `[..., U, 2]`, mirrored at the border of the grid's area."""
    xp = array_namespace(users_m)
    (west_m, south_m), (east_m, north_m) = scenario.grid.area_m
    low_m, high_m = constant((west_m, south_m), users_m), constant((east_m, north_m), users_m)
    size_m = high_m - low_m
    along_m = xp.remainder(users_m - low_m, 2.0 * size_m)
    mirrored_m = low_m + (size_m - abs(along_m - size_m))
    inside = (users_m >= low_m) & (users_m <= high_m)
    velocity_mps = xp.where(inside | (along_m <= size_m), velocity_mps, -velocity_mps)
    return xp.where(inside, users_m, mirrored_m), velocity_mps


def _normal(draws: Array) -> Array:
    """Two independent standard normal numbers, `[..., 2]`, from two uniform draws (Box and Muller, 1958)."""
    xp = array_namespace(draws)
    return _polar(xp.sqrt(-2.0 * xp.log1p(-draws[..., 0])), draws[..., 1])


def _polar(radius_m: Array, turn: Array) -> Array:
    """Radius `[...]` and angle in turns `[...]` as x, y, `[..., 2]`."""
    xp = array_namespace(radius_m)
    angle_rad = (2.0 * math.pi) * turn
    radius_m, angle_rad = radius_m[..., None], angle_rad[..., None]  # `stack` takes twice the time
    return xp.concat([radius_m * xp.cos(angle_rad), radius_m * xp.sin(angle_rad)], axis=-1)


class WalkingUsers:
    """The users of one mission, drawn from its seed in the order of the environment."""

    def __init__(self, scenario: "Scenario", seed: int) -> None:
        self._scenario = scenario
        self._rng = np.random.default_rng(seed)
        self.step = 0  # steps walked
        draws = self._draws()
        # Of the first user: the channel's seeds come from them.
        self._first_draws = self._step_draws = self._next_draws = draws[:1]
        self.positions_m: Array  # current positions, metres, `[U, 2]`
        self.positions_m, self._motion = begin(scenario, draws)
        self._next: tuple[Array, Array] | None = None  # positions and motion after the next step

    def walk(self, steps: int = 1) -> None:
        """Advance the users."""
        for _ in range(steps):
            self.next_m()
            assert self._next is not None, "set by next_m()"
            (self.positions_m, self._motion), self._next = self._next, None
            self._step_draws = self._next_draws
            self.step += 1

    def next_m(self) -> Array:
        """Positions after the next step, metres, `[U, 2]`; drawn once."""
        if self._next is None:
            draws = self._draws()
            self._next, self._next_draws = (
                move(self._scenario, self.positions_m, self._motion, draws),
                draws[:1],
            )
        return self._next[0]

    @property
    def seeds(self) -> Seeds | None:
        """The channel's seeds in the current step; None: the channel is not random."""
        return self._seeds(self._step_draws)

    @property
    def next_seeds(self) -> Seeds | None:
        """The channel's seeds in the next step."""
        self.next_m()
        return self._seeds(self._next_draws)

    def _seeds(self, draws: Array) -> Seeds | None:
        if not self._scenario.radio.is_random:
            return None
        return Seeds(int(seed_of(self._first_draws)), int(seed_of(draws)))

    def _draws(self) -> Array:
        return self._rng.random(self._scenario.draws_shape)
