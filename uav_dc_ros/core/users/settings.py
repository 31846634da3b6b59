"""The users of a scenario: clusters around centres, or a list with the position of each user."""

import math
from collections.abc import Iterator
from functools import cached_property
from itertools import chain
from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta

from uav_dc_ros.core.grid import Grid
from uav_dc_ros.core.mobility import GaussMarkov, Mobility, RandomWalk, RandomWaypoint, Static

CLUSTERS_MAX = 1000
USERS_MAX = 100_000

Positive: TypeAlias = Annotated[float, Meta(gt=0)]
NotNegative: TypeAlias = Annotated[float, Meta(ge=0)]
Label: TypeAlias = Annotated[str, Meta(min_length=1, max_length=64)]
Size: TypeAlias = Annotated[int, Meta(ge=1, le=USERS_MAX)]
Point: TypeAlias = tuple[float, float]  # x, y, metres


class User(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A user of the list `users.user`; a row of a file of users."""

    # x_m, y_m: position at the start of a mission, or the centre of the disc in which it starts, metres
    x_m: float
    y_m: float
    name: Label | None = None  # different for each user
    cluster: Label | None = (
        None  # users with equal ones are a cluster; without one, a user is a cluster alone
    )
    radius_m: NotNegative = 0.0  # radius of the disc in which it starts, metres
    data_bits: Positive | None = None  # its r_min, bit; without it, `mission.r_min_bits`
    priority: Positive = 1.0  # weight in the reward and in the age of information


class Disc(msgspec.Struct, frozen=True):
    """A disc in which users start, and its key in the scenario."""

    key: str
    centre_m: Point
    radius_m: float


class UserSettings(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True, dict=True
):
    """The users on the ground: clusters (the first three keys), or a list (`user` or `file`)."""

    # Centre x, y of each of the M clusters, metres
    cluster_centres_m: Annotated[tuple[Point, ...], Meta(min_length=1, max_length=CLUSTERS_MAX)] | None = None
    users_per_cluster: Size | tuple[Size, ...] | None = None  # users K in a cluster; or a number for each
    cluster_radius_m: Positive | None = None  # radius C of the disc in which a cluster's users start, metres
    v_max_mps: NotNegative | None = None  # maximum speed v, m/s; only of the random walk, which needs it
    # How users move; `mobility.model` names the struct, see `mobility`. None: the random walk.
    mobility: Mobility | None = None
    user: Annotated[tuple[User, ...], Meta(max_length=USERS_MAX)] = ()  # the users one by one
    # A CSV or GeoJSON file of users beside the scenario's file. `scenarios.load` puts its users into `user`.
    file: str | None = None

    @property
    def moves(self) -> Mobility:
        """How users move."""
        return self.mobility or RandomWalk()

    @cached_property
    def listed(self) -> tuple[tuple[User, ...], ...]:
        """The users of the list by cluster, in the order of the first user of each; () without a list."""
        clusters: dict[object, list[User]] = {}
        for i, user in enumerate(self.user):
            clusters.setdefault(user.cluster or i, []).append(user)
        return tuple(map(tuple, clusters.values()))

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Users of each of the M clusters."""
        if self.user:
            return tuple(map(len, self.listed))
        each = self.users_per_cluster
        assert self.cluster_centres_m is not None, "checked by parse()"
        assert each is not None, "checked by parse()"
        return each if isinstance(each, tuple) else (each,) * len(self.cluster_centres_m)

    @cached_property
    def clusters(self) -> tuple[Disc, ...]:
        """The disc of each of the M clusters; of a list, around the mean of its users' positions."""
        if not self.user:
            assert self.cluster_centres_m is not None, "checked by parse()"
            assert self.cluster_radius_m is not None, "checked by parse()"
            keys = (f"users.cluster_centres_m[{i}]" for i in range(len(self.cluster_centres_m)))
            return tuple(
                Disc(key, at_m, self.cluster_radius_m)
                for key, at_m in zip(keys, self.cluster_centres_m, strict=True)
            )
        discs = []
        for users in self.listed:
            x_m = math.fsum(user.x_m for user in users) / len(users)
            y_m = math.fsum(user.y_m for user in users) / len(users)
            radius_m = max(math.dist((x_m, y_m), (u.x_m, u.y_m)) + u.radius_m for u in users)
            discs.append(Disc(f"users.user, cluster {users[0].cluster!r}", (x_m, y_m), radius_m))
        return tuple(discs)

    @cached_property
    def centres_m(self) -> tuple[Point, ...]:
        """Centre of the disc in which each of the U users starts, metres."""
        if self.user:
            return tuple((user.x_m, user.y_m) for user in chain(*self.listed))
        return tuple(
            chain(*((disc.centre_m,) * n for disc, n in zip(self.clusters, self.sizes, strict=True)))
        )

    @property
    def is_random(self) -> bool:
        """Whether the users' positions are drawn, at the start or later."""
        radii_m = self.radii_m
        starts_m = max(radii_m) if isinstance(radii_m, tuple) else radii_m
        moves, walks = self.moves, isinstance(self.moves, RandomWalk)
        return starts_m > 0.0 or not (isinstance(moves, Static) or (walks and not self.v_max_mps))

    @cached_property
    def radii_m(self) -> float | tuple[float, ...]:
        """Radius of the disc in which each user starts, metres; a number where all are equal."""
        return self._per_user([user.radius_m for user in chain(*self.listed)], self.cluster_radius_m or 0.0)

    def r_min_bits(self, of_mission: float) -> float | tuple[float, ...]:
        """Data at which each user counts as collected, bit; a number where all are equal."""
        return self._per_user([user.data_bits or of_mission for user in chain(*self.listed)], of_mission)

    @cached_property
    def weights(self) -> tuple[float, ...] | None:
        """Share of each user in the sum of the priorities; None: equal shares."""
        priorities = [user.priority for user in chain(*self.listed)]
        if len(set(priorities)) <= 1:
            return None
        total = math.fsum(priorities)
        return tuple(priority / total for priority in priorities)

    @cached_property
    def cluster_names(self) -> tuple[str | None, ...] | None:
        """Name of each cluster: its own, or that of its only user; None where no cluster has one."""
        names = tuple(users[0].cluster or users[0].name for users in self.listed)
        return names if any(names) else None

    @cached_property
    def names(self) -> tuple[str | None, ...] | None:
        """Name of each user; None where no user has one."""
        names = tuple(user.name for user in chain(*self.listed))
        return names if any(names) else None

    @staticmethod
    def _per_user(values: list[float], default: float) -> float | tuple[float, ...]:
        if len(set(values)) <= 1:
            return values[0] if values else default
        return tuple(values)

    def inconsistencies(self) -> Iterator[str]:
        """Errors of combined values, lazily."""
        placed = ("cluster_centres_m", "users_per_cluster", "cluster_radius_m")
        if self.file is not None:
            yield f"users.file = {self.file!r}; expected a scenario in a file, which the name is relative to"
        for name in placed:
            value = getattr(self, name)
            if self.user and value is not None:
                yield f"users.{name} = {value}; expected no such key beside users.user or users.file"
            if not self.user and value is None:
                yield f"missing key users.{name}"
        each, centres_m = self.users_per_cluster, self.cluster_centres_m
        if isinstance(each, tuple) and centres_m is not None and len(each) != len(centres_m):
            yield (
                f"users.users_per_cluster = {list(each)}; expected a number, or {len(centres_m)}: one for "
                "each of users.cluster_centres_m"
            )
        if len(self.listed) > CLUSTERS_MAX:
            yield (
                f"users.user: {len(self.listed)} clusters; expected at most {CLUSTERS_MAX}: give users of "
                "one place the same `cluster`"
            )
        seen: dict[str, int] = {}
        for i, user in enumerate(self.user):
            for key in ("name", "cluster"):
                label = getattr(user, key)
                if label is not None and not label.isprintable():
                    yield f"users.user[{i}].{key} = {label!r}; expected printable characters"
            if user.name is not None and (first := seen.setdefault(user.name, i)) != i:
                yield f"users.user[{i}].name = {user.name!r}, as of users.user[{first}]; expected another one"
        walks, model = isinstance(self.moves, RandomWalk), self.moves
        if walks and self.v_max_mps is None:
            yield "missing key users.v_max_mps"
        if not walks and self.v_max_mps is not None:
            yield (
                f"users.v_max_mps = {self.v_max_mps:g}; expected no such key with users.mobility.model = "
                f"{model.__struct_config__.tag!r}: it is the speed of the random walk"
            )
        if isinstance(model, RandomWaypoint) and model.v_min_mps > model.v_max_mps:
            yield (
                f"users.mobility.v_min_mps = {model.v_min_mps:g}; expected at most "
                f"users.mobility.v_max_mps = {model.v_max_mps:g}"
            )

    def start_discs(self) -> Iterator[Disc]:
        """The discs in which users start: one for each cluster, or for each user of the list."""
        if not self.user:
            yield from self.clusters
        for i, user in enumerate(self.user):
            name = "" if user.name is None else f" ({user.name})"
            yield Disc(f"users.user[{i}]{name}", (user.x_m, user.y_m), user.radius_m)

    def area_m(self, grid: Grid, mission_s: float) -> tuple[float, float, float, float]:
        """Where users may get to in a mission of `mission_s`, seconds: limits west, south, east, north, m."""
        reach_m = (self.v_max_mps or 0.0) * mission_s  # of the random walk
        corners_m: list[Point] = []
        for disc in self.start_discs():
            (x_m, y_m), way_m = disc.centre_m, disc.radius_m + reach_m
            corners_m += ((x_m - way_m, y_m - way_m), (x_m + way_m, y_m + way_m))
        model = self.moves
        if isinstance(model, GaussMarkov) or (
            isinstance(model, RandomWaypoint) and model.waypoints == "field"
        ):
            corners_m += grid.area_m
        x_all_m, y_all_m = zip(*corners_m, strict=True)
        return min(x_all_m), min(y_all_m), max(x_all_m), max(y_all_m)

    def outside(self, grid: Grid) -> Iterator[str]:
        """Errors of listed users outside the area of the grid's cells."""
        if not self.user:
            return
        (west_m, south_m), (east_m, north_m) = grid.area_m
        for disc in self.start_discs():
            x_m, y_m = disc.centre_m
            if not (west_m <= x_m <= east_m and south_m <= y_m <= north_m):
                yield (
                    f"{disc.key} = {list(disc.centre_m)}; expected a position over the grid: x {west_m:g} to "
                    f"{east_m:g} and y {south_m:g} to {north_m:g} m"
                )
