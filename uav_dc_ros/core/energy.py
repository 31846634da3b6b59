"""Energy of a rotary-wing UAV: propulsion power, the energy of a step, and the battery.

Level flight is the model of Zeng, Xu and Zhang, "Energy Minimization for Wireless Communication with
Rotary-Wing UAV", IEEE Transactions on Wireless Communications 18(4), 2019: blade profile, induced and
parasite power. Vertical flight is axial flight by momentum theory, with a fit to measurements in descent:
Leishman, "Principles of Helicopter Aerodynamics", 2nd ed., 2006, section 2.13. Both agree in hover.

Powers are those at the rotors. Left out: acceleration, wind, the radio and other electronics, and losses in
motors and battery; `battery_j` is what the battery delivers to the rotors.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Literal, NamedTuple, TypeAlias

import msgspec
from msgspec import Meta

from uav_dc_ros.core.arrays import Array, array_namespace, constant
from uav_dc_ros.core.grid import Grid

MissionEnd: TypeAlias = Literal["steps", "battery", "both"]
Positive: TypeAlias = Annotated[float, Meta(gt=0)]

# Induced velocity in descent, in units of that in hover: coefficients of V, V^2, V^3, V^4, where V is
# the vertical speed in the same unit, from -2 to 0. The constant term is the correction of the induced power.
_DESCENT_FIT = (-1.125, -1.372, -1.718, -0.655)
DESCENT_MAX = 2.0  # end of the fit: vertical speed in units of the induced velocity in hover


class StepEnergies(NamedTuple):
    """Energy of a step by its move, joules."""

    hover: float
    level: float
    climb: float
    descent: float


class EnergySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The battery and the UAV's propulsion; the defaults are the table of Zeng, Xu and Zhang (2019)."""

    battery_j: Positive  # energy at the start of a mission, joules
    # `steps`: a mission ends as without a battery. `battery`: also when the battery is spent, see
    # `world.end_of_mission`, and `max_steps` is long enough to end none. `both`: whichever comes first.
    ends: MissionEnd = "steps"
    # Speeds of a move, m/s; the UAV hovers for the rest of the step. Without one, the move takes all of it.
    cruise_mps: Positive | None = None
    climb_mps: Positive | None = None
    descent_mps: Positive | None = None
    weight_n: Positive = 20.0  # W, newtons
    air_density_kgpm3: Positive = 1.225  # rho, kg/m^3
    disc_area_m2: Positive = 0.503  # A, of all rotors, m^2
    tip_speed_mps: Positive = 120.0  # U_tip, of the blades, m/s
    solidity: Annotated[float, Meta(gt=0, le=1)] = 0.05  # s, blade area over disc area
    profile_drag: Positive = 0.012  # delta, coefficient of the blades
    fuselage_drag: Annotated[float, Meta(ge=0)] = 0.6  # d_0, fuselage drag ratio
    induced_correction: Annotated[float, Meta(ge=0)] = 0.1  # k, induced power is 1 + k times the ideal

    @property
    def induced_mps(self) -> float:
        """Mean induced velocity v_0 of the rotors in hover, m/s."""
        return math.sqrt(self.weight_n / (2.0 * self.air_density_kgpm3 * self.disc_area_m2))

    @property
    def profile_w(self) -> float:
        """Blade profile power P_0 in hover, watts."""
        blades = self.air_density_kgpm3 * self.solidity * self.disc_area_m2
        return self.profile_drag / 8.0 * blades * self.tip_speed_mps**3

    @property
    def induced_w(self) -> float:
        """Induced power P_i in hover, watts."""
        return (1.0 + self.induced_correction) * self.weight_n * self.induced_mps

    def level_w(self, speed_mps: float) -> float:
        """Propulsion power P(V) in level flight at a constant speed, watts; in hover at 0."""
        tip, ratio = speed_mps / self.tip_speed_mps, speed_mps / self.induced_mps
        # sqrt(sqrt(1 + r^4 / 4) - r^2 / 2), as a quotient: the difference loses all digits at high speed.
        half = ratio * ratio / 2.0
        induced = 1.0 / math.sqrt(math.hypot(1.0, half) + half)
        drag = self.fuselage_drag * self.air_density_kgpm3 * self.solidity * self.disc_area_m2
        parasite_w = 0.5 * drag * speed_mps**3
        return self.profile_w * (1.0 + 3.0 * tip * tip) + self.induced_w * induced + parasite_w

    def vertical_w(self, speed_mps: float) -> float:
        """Propulsion power at a vertical speed (negative in descent), watts; in hover at 0, never negative.

        `P_0 + W (V + v_i)`. In climb the induced velocity v_i is that of momentum theory times 1 + k. In
        descent, where momentum theory has no valid flow down to -2 v_0 (vortex ring state), it is the fit.

        Raises:
            ValueError: a descent faster than `DESCENT_MAX` times v_0.
        """
        hover_mps, factor = self.induced_mps, 1.0 + self.induced_correction
        ratio = speed_mps / hover_mps
        if ratio < -DESCENT_MAX:
            raise ValueError(f"speed is {speed_mps:g} m/s; expected at least {-DESCENT_MAX * hover_mps:g}")
        if ratio >= 0.0:
            induced = factor * (math.hypot(1.0, ratio / 2.0) - ratio / 2.0)
        else:
            induced = factor + sum(c * ratio**i for i, c in enumerate(_DESCENT_FIT, start=1))
        return max(self.profile_w + self.weight_n * hover_mps * (ratio + induced), 0.0)

    def step_energies_j(self, grid: Grid, step_s: float) -> StepEnergies:
        """Energy of each kind of step in a grid, joules; a move off the grid is a hover."""
        hover_w = self.level_w(0.0)
        level_mps, climb_mps, descent_mps = self._speeds_mps(grid, step_s)

        def energy_j(power_w: float, distance_m: float, speed_mps: float) -> float:
            flown_s = min(distance_m / speed_mps, step_s)
            return power_w * flown_s + hover_w * (step_s - flown_s)

        hover_j = hover_w * step_s
        level_j = energy_j(self.level_w(level_mps), grid.cell_m, level_mps)
        if grid.n_z == 1:
            return StepEnergies(hover_j, level_j, hover_j, hover_j)
        return StepEnergies(
            hover=hover_j,
            level=level_j,
            climb=energy_j(self.vertical_w(climb_mps), grid.altitude_step_m, climb_mps),
            descent=energy_j(self.vertical_w(-descent_mps), grid.altitude_step_m, descent_mps),
        )

    def _speeds_mps(self, grid: Grid, step_s: float) -> tuple[float, float, float]:
        """Speeds of level moves, climbs and descents, m/s."""
        level_mps, vertical_mps = grid.cell_m / step_s, grid.altitude_step_m / step_s
        return self.cruise_mps or level_mps, self.climb_mps or vertical_mps, self.descent_mps or vertical_mps

    def inconsistencies(self, grid: Grid, step_s: float, max_steps: int, moves: int) -> Iterator[str]:
        """Errors of the values in a world, lazily; `moves`: from start to dock."""
        lengths_m = {"cruise": grid.cell_m, "climb": grid.altitude_step_m, "descent": grid.altitude_step_m}
        for name, length_m in lengths_m.items():
            speed_mps = getattr(self, f"{name}_mps")
            if speed_mps is not None and speed_mps * step_s < length_m * (1.0 - 1e-9):
                yield (
                    f"energy.{name}_mps = {speed_mps:g}; expected at least {length_m / step_s:g}, or a move "
                    f"of {length_m:g} m does not fit into a step of {step_s:g} s"
                )
        descent_mps, max_mps = self._speeds_mps(grid, step_s)[2], DESCENT_MAX * self.induced_mps
        if grid.n_z > 1 and descent_mps > max_mps:
            yield (
                f"energy.descent_mps = {descent_mps:g}; expected at most {max_mps:g}, twice the induced "
                "velocity in hover, where the model of descents ends"
            )
            return  # no step has an energy
        if self.ends == "steps":
            return
        energies_j = self.step_energies_j(grid, step_s)
        if self.battery_j < moves * energies_j.level:
            yield (
                f"energy.battery_j = {self.battery_j:g}; expected at least {moves * energies_j.level:.6g}, "
                f"the energy of the {moves} moves from start to dock"
            )
        n_steps = self.battery_j / min(energies_j) if min(energies_j) > 0.0 else math.inf
        if self.ends == "battery" and max_steps < n_steps:
            yield (
                f"mission.max_steps = {max_steps}; expected at least {n_steps:.0f}, the steps that "
                "energy.battery_j lasts, so that the battery ends every mission; or energy.ends = 'both'"
            )


def of_step(energies_j: StepEnergies, cell: Array, after: Array, like: Array) -> Array:
    """Energy of a step from a cell to the same or a neighbouring one, both `[..., 3]`, joules, `[...]`.

    The dtype is that of `like`.
    """
    xp = array_namespace(cell)
    moved = after - cell
    # -2 in a descent, 0 in a hover, 1 in a level move, 2 in a climb
    kind = abs(moved[..., 0]) + abs(moved[..., 1]) + 2 * moved[..., 2]
    hover, level, climb, descent = energies_j
    table = constant((descent, hover, hover, level, climb), like)
    return xp.take(table, (kind + 2).reshape((-1,)), axis=0).reshape(kind.shape)


def per_mbit_j(used_j: Array, data_bits: Array) -> Array:
    """Energy for each megabit collected, joules, both `[...]`; NaN where nothing was collected."""
    xp = array_namespace(used_j)
    return used_j / xp.where(data_bits > 0.0, data_bits / 1e6, math.nan)


def state_of_charge(settings: EnergySettings, used_j: Array) -> Array:
    """Share of the battery that is left, from 1 to 0, after `used_j` joules `[...]`; `[...]`."""
    left = 1.0 - used_j / settings.battery_j
    return left * (left > 0.0)
