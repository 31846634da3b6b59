"""What the paper leaves open: each value and reading with its range, the reason, and the paper's words.

Equation and section numbers are the paper's. Where a value matters only relative to another one, the relative
value is drawn, so that no range is wasted on worlds in which it decides nothing.
"""

from typing import NamedTuple, TypeAlias

Value: TypeAlias = str | float | int


class Span(NamedTuple):
    """Numbers from `low` to `high`; each is equally likely, or each factor with `log`."""

    low: float
    high: float
    log: bool = False
    whole: bool = False

    def at(self, u: float) -> Value:
        """The number at quantile u in [0, 1), whole or with three digits."""
        low, high = self.low, self.high + self.whole
        value = low * (high / low) ** u if self.log else low + (high - low) * u
        return int(value) if self.whole else float(f"{value:.3g}")

    def __str__(self) -> str:
        """The range in words."""
        return f"{self.low:g} to {self.high:g}{', logarithmic' * self.log}"


class Options(NamedTuple):
    """Some values; one that stands twice is twice as likely."""

    values: tuple[Value, ...]

    def at(self, u: float) -> Value:
        """The value at quantile u in [0, 1)."""
        return self.values[int(u * len(self.values))]

    def __str__(self) -> str:
        """The values in words."""
        words = [value if isinstance(value, str) else f"{value:g}" for value in self.values]
        share = {word: f" ({words.count(word)}/{len(words)})" for word in words}
        equal = len(set(share.values())) == 1
        return ", ".join(word if equal else word + of_all for word, of_all in share.items())


class Choice(NamedTuple):
    """One open value or reading."""

    name: str  # field of `draw.World`
    title: str  # in words, with its unit
    values: Span | Options
    paper: str  # section or equation, and what it states
    reason: str  # why this range


CHOICES = (
    Choice(
        "cells",
        "grid, cells per side",
        Span(9, 13, whole=True),
        'I-B, II-B: "the area is divided into a grid to enable fast convergence"; no size',
        "Fewer leave no choice of a way between five clusters; more need over 24 moves to the far corner.",
    ),
    Choice(
        "cell_m",
        "size of a cell, m",
        Options((75.0, 100.0, 125.0, 150.0)),
        "II-B: no size",
        "From half of a reach d_cons down to a fifth; the field is 0.6 to 1.8 km wide.",
    ),
    Choice(
        "speed_mps",
        "speed of the UAV, m/s: the step is cell / speed",
        Span(4, 16),
        "II-B: steps without a duration",
        "Multirotors that stop at every cell average 4 m/s; 16 m/s is the top speed of small ones.",
    ),
    Choice(
        "altitude_min_m",
        "lowest layer, m",
        Options((50.0, 100.0, 150.0)),
        "Table II: the start is at 200 m; II: 3D, without layers",
        "From above roofs to a layer below the start. Layers are 50 m apart.",
    ),
    Choice(
        "altitude_max_m",
        "highest layer, m",
        Options((200.0, 250.0, 300.0)),
        "Table II: the start is at 200 m; II: 3D, without layers",
        "The start is the highest layer, or the UAV may climb from it.",
    ),
    Choice(
        "cluster_radius_m",
        "radius C of a cluster, m",
        Span(50, 150),
        'II: "distributed randomly within the coverage radius of C"; no value',
        "Below 50 m a cluster is a point to a UAV at 200 m; above 150 m five discs fill a square kilometre.",
    ),
    Choice(
        "v_max_mps",
        "greatest speed v of a user, m/s",
        Span(0.1, 3),
        'II: "random walk model with the maximum velocity v"; no value',
        "From things that hardly move to people who run.",
    ),
    Choice(
        "tx_power_w",
        "transmit power p of a user, W",
        Span(0.1, 5, log=True),
        'Table II: "UAV transmission power 5 W"; eq. 3 needs the users\' power',
        "From the 20 dBm of a small IoT device to the table's 5 W, read as the users'.",
    ),
    Choice(
        "d_cons_m",
        "reach d_cons, m",
        Span(200, 400),
        "eq. 10: d <= d_cons; no value",
        "Below 200 m no user is in reach at the start's altitude; at 400 m two clusters often are.",
    ),
    Choice(
        "r_min_steps",
        "r_min, in steps of hovering over the user's cluster",
        Span(0.25, 4, log=True),
        "II-B, eq. 10: R >= r_min; no value",
        "Up to 1, passing by collects a user; at 4 only hovering does. In bits it follows from the radio.",
    ),
    Choice(
        "time_per_tour",
        "T_cons, relative to the moves of the shortest tour past five clusters",
        Span(0.9, 1.6),
        'eq. 10: T <= T_cons; VI: "it is challenging to expect the UAV to visit all users"',
        "Below 0.9 a cluster must be left out; at 1.6 there is time to hover a few steps over each.",
    ),
    Choice(
        "data_scale",
        "scale of the data in eq. 7, relative to a usual mission's",
        Span(0.4, 2.5, log=True),
        "eq. 7 adds bits and a number of at most 1; no unit",
        "At 1 both terms are of order one; the range shifts their balance like beta/zeta from 2:5 to 5:2.",
    ),
    Choice(
        "data",
        "R in eq. 7",
        Options(("step", "so_far")),
        'eq. 7: R without a time; "the average throughput of all users"; eq. 4 integrates over time',
        "Both readings have words of the paper behind them.",
    ),
    Choice(
        "interference",
        "users that transmit",
        Options(("all", "all", "associated", "none")),
        "eq. 3: the sum is over all users; P(m, k) of eq. 7 associates some",
        "Eq. 3 as written weighs as much as both departures: associated users only, or orthogonal channels.",
    ),
    Choice(
        "episode_end",
        "end of an episode",
        Options(("at_time_limit", "on_arrival")),
        'III: "ends when the UAV reaches the final destination"; algorithms: until then "or T <= T_cons"',
        "The prose and the loop contradict each other.",
    ),
    Choice(
        "hidden",
        "hidden layers",
        Options(("32-32", "64-64", "128")),
        "IV to VI: no layers",
        "Ample for a position of three numbers; two layers of 128 take three times as long as two of 64.",
    ),
    Choice(
        "target_every",
        "iterations between copies to the target network",
        Span(50, 2000, log=True, whole=True),
        'IV: "after a number of iterations"',
        "From about one mission to about fifty.",
    ),
    Choice(
        "buffer_size",
        "transitions in the replay buffer",
        Span(1000, 20000, log=True, whole=True),
        'IV: "the finite buffer size ... allows it to be always up-to-date"; no size',
        "From about 25 missions to all of a training of 400.",
    ),
)


class Place(NamedTuple):
    """Positions, drawn as the u-th free one of a raster in a world whose other values are known."""

    name: str  # field of `draw.World`
    title: str
    values: str  # the range in words
    paper: str
    reason: str
    n: int  # positions, each with its own dimension of the Sobol sequence


PLACES = (
    Place(
        "dock_m",
        "dock",
        "any cell at least half of the field's width from the start",
        'II-B: "the UAV has to move a long distance to reach the final destination"; no position',
        "A dock beside the start would make the way home no matter at all.",
        1,
    ),
    Place(
        "five_clusters_m",
        "layout of five clusters",
        "centres on a raster of 10 m, discs inside the field, at least 2 C apart",
        "VI: the figure is not in the source; its text names no position",
        "Discs that do not touch are what a cluster is.",
        5,
    ),
    Place(
        "three_clusters_m",
        "layout of three clusters",
        "likewise",
        "VI: the figure is not in the source; its text names no position",
        "Likewise. All other values are those of the five clusters, since the paper has one table for both.",
        3,
    ),
)


class Reference(NamedTuple):
    """A physically plausible value."""

    name: str  # field or property of `draw.World`
    value: float
    reason: str


# Breaks ties in the rule of choice, see `choose.py`.
REFERENCES = (
    Reference("speed_mps", 8, "usual cruising speed of a small multirotor"),
    Reference("altitude_min_m", 100, "below the 120 m that the EU and the FAA allow, above trees and roofs"),
    Reference("mission_s", 1200, "20 minutes: a multirotor's endurance with a reserve"),
    Reference(
        "cluster_radius_m", 100, "a village square, a field, a plant: what one calls a cluster of users"
    ),
    Reference("tx_power_w", 0.2, "23 dBm, power class 3 of LTE and NB-IoT devices"),
    Reference("v_max_mps", 1.4, "walking"),
)

# Given by the paper (Table II, section VI), equal in all worlds.
GIVEN = {
    "users_per_cluster": 10,
    "start_m": (0.0, 0.0, 200.0),
    "radio": {
        "bandwidth_hz": 1e6,
        "noise_power_dbm": -110.0,
        "ref_gain_db": -50.0,
        "path_loss_exponent": 2.0,
    },
}
ALTITUDE_STEP_M = 50.0

# Open too, but without a choice in this package.
FIXED = (
    "beta and zeta are those of the ratio as the paper writes it: 2:1 is 2 and 1",
    "every mission of a run begins with the same layout of users; five layouts are the paper's environments",
    "the distance in the exponential R_plus (eq. 9) is in cells: in metres it is zero in floating point",
    "activation (ReLU), initialisation, and the input's scale (each index to 0 to 1)",
    "learning begins with the first transition, and theta' as a copy of theta",
    "dueling subtracts the mean, as in algorithm 2; eq. 29 with the maximum is not taken",
)
