"""Conversion between payloads and the core's arrays, and checks of payloads against the scenario."""

from functools import lru_cache
from typing import Any

import numpy as np
from msgspec import UNSET

from uav_dc_ros import messages
from uav_dc_ros.core import energy, world
from uav_dc_ros.core import mission as core_mission
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.propagation import stochastic
from uav_dc_ros.core.propagation.stochastic import Realization, Seeds, Shadowing
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.core.world import Link
from uav_dc_ros.errors import MessageError


def users(
    scenario: Scenario,
    users_m: Array,
    *,
    mission: int,
    step: int,
    time_ns: int,
    run: str = "",
    seeds: Seeds | None = None,
) -> messages.Users:
    """Users' positions, metres `[U, 2]`, as a payload. Where the channel is random, it needs its `seeds`."""
    radio = scenario.radio
    assert seeds is not None or not radio.is_random, "a random channel has seeds"
    return messages.Users(
        run=run,
        mission=mission,
        step=step,
        stamp_ns=time_ns,
        cluster=scenario.user_cluster.tolist(),
        x_m=users_m[:, 0].tolist(),
        y_m=users_m[:, 1].tolist(),
        shadowing_seed=seeds.shadowing if seeds and radio.shadowing else UNSET,
        link_seed=seeds.link if seeds and radio.draws_links else UNSET,
    )


def users_m(payload: messages.Users, scenario: Scenario) -> Array:
    """Users' positions, metres, `[U, 2]`; raises MessageError as `check` does."""
    check(payload, scenario)
    return np.asarray([payload.x_m, payload.y_m], dtype=np.float64).T


def realization(payload: messages.Users, scenario: Scenario) -> Realization | None:
    """What the channel has drawn in a step with users that `check` accepts; None: it is not random."""
    if not scenario.radio.is_random:
        return None
    shadowing, seed = scenario.radio.shadowing, payload.shadowing_seed
    waves = np.zeros(0) if shadowing is None or seed is UNSET else _waves(shadowing, seed)
    return Realization(waves, np.asarray(0 if payload.link_seed is UNSET else payload.link_seed))


@lru_cache(maxsize=4)  # one in each step of a mission
def _waves(shadowing: Shadowing, seed: int) -> Array:
    return stochastic.waves(shadowing, np.asarray(seed), like=np.zeros(0))


def rates(
    link: Link, data_bits: Array, collected: Array, *, mission: int, step: int, run: str = ""
) -> messages.Rates:
    """The channel of a step and the data after it, `[U]` each, as a payload."""
    return messages.Rates(
        run=run,
        mission=mission,
        step=step,
        sum_rate_bps=float(link.sum_rate_bps),
        sinr=link.sinr.tolist(),
        rate_bps=link.rate_bps.tolist(),
        data_bits=data_bits.tolist(),
        served=link.served.tolist(),
        collected=collected.tolist(),
    )


def collection(payload: messages.Rates, scenario: Scenario) -> tuple[Array, Array]:
    """`data_bits` and `collected`, `[U]` each; raises MessageError as `check` does."""
    check(payload, scenario)
    return np.asarray(payload.data_bits, dtype=np.float64), np.asarray(payload.collected, dtype=bool)


def delivered_bits(payload: messages.Rates, scenario: Scenario) -> Array:
    """Data that each user delivered in a step, bit, `[U]`; none in the first, which measures the channel.

    Raises MessageError as `check` does.
    """
    check(payload, scenario)
    served, rate_bps = np.asarray(payload.served), np.asarray(payload.rate_bps, dtype=np.float64)
    delivered = core_mission.delivered(served, rate_bps, scenario.mission.step_s)
    return delivered if payload.step else np.zeros_like(delivered)


def counted_data(payload: messages.Rates, scenario: Scenario) -> Array:
    """R of each user in r^t (eq. 7), bit, `[U]`; raises MessageError as `check` does.

    Not of step 0, which measures the channel and collects nothing.
    """
    data_bits, _ = collection(payload, scenario)
    rate_bps = np.asarray(payload.rate_bps, dtype=np.float64)
    return world.counted_data(scenario, np.asarray(payload.served), rate_bps, data_bits)


def total_reward(status: messages.Mission, payload: messages.Rates, scenario: Scenario) -> float:
    """r^t (eq. 7) of a step but the first; raises MessageError as `check` does for rates."""
    return float(world.total_reward(scenario, np.asarray(status.cell), counted_data(payload, scenario)))


def battery(scenario: Scenario, energy_used_j: Array) -> dict[str, Any]:
    """Fields of the battery in a mission's payload, after energy `[]`; none in a scenario without one."""
    if scenario.energy is None:
        return {}
    charge = energy.state_of_charge(scenario.energy, energy_used_j)
    return {"energy_used_j": float(energy_used_j), "state_of_charge": float(charge)}


def battery_diagnostics(scenario: Scenario, energy_used_j: Array) -> dict[str, str]:
    """The battery by the scenario's model for `/diagnostics`, after energy `[]`; none without a battery."""
    fields = battery(scenario, energy_used_j)
    return {"battery by the model": f"{fields['state_of_charge']:.0%}"} if fields else {}


def energy_used_j(status: messages.Mission) -> Array:
    """Energy used in a mission, joules, `[]`; 0 in a scenario without a battery."""
    return np.asarray(0.0 if status.energy_used_j is UNSET else status.energy_used_j)


def check(payload: messages.Payload, scenario: Scenario) -> None:
    """Raise MessageError for a payload of another world.

    That is a mission with another fingerprint, a cell outside the grid, more steps than the battery
    allows, or no battery where the scenario has one; users, or rates of users, other than the scenario's; and
    users without the seeds of a random channel.
    """
    match payload:
        case messages.Mission() if payload.fingerprint != scenario.fingerprint:
            raise MessageError(
                "scenario",
                f"the mission flies {payload.scenario!r} ({payload.fingerprint}); expected "
                f"{scenario.name!r} ({scenario.fingerprint}): start this node with the mission's scenario",
            )
        case messages.Mission():
            outside = any(i > last for i, last in zip(payload.cell, scenario.grid.last_cell, strict=True))
            if outside or payload.remaining_steps > scenario.mission.max_steps:
                raise MessageError(
                    "layout",
                    f"cell {payload.cell}, {payload.remaining_steps} remaining steps; expected a cell up to "
                    f"{scenario.grid.last_cell} and at most {scenario.mission.max_steps} steps",
                )
            if (payload.energy_used_j is UNSET) is not (scenario.energy is None):
                given, expected = ("no ", "one") if scenario.energy else ("", "none")
                raise MessageError(
                    "layout", f"{given}energy_used_j; expected {expected} in scenario {scenario.name!r}"
                )
        case messages.Users() if payload.cluster != scenario.user_cluster.tolist():
            raise MessageError(
                "layout",
                f"{len(payload.cluster)} users in {len(set(payload.cluster))} clusters; expected the "
                f"{scenario.n_users} in {scenario.n_clusters} of scenario {scenario.name!r}, in its order",
            )
        case messages.Users():
            radio = scenario.radio
            for name, needed in (("shadowing_seed", radio.shadowing), ("link_seed", radio.draws_links)):
                if (getattr(payload, name) is UNSET) is bool(needed):
                    given, expected = ("no ", "one") if needed else ("", "none")
                    raise MessageError(
                        "layout", f"{given}{name}; expected {expected} in scenario {scenario.name!r}"
                    )
        case messages.Rates() if len(payload.data_bits) != scenario.n_users:
            raise MessageError(
                "layout",
                f"{len(payload.data_bits)} users; expected the {scenario.n_users} of {scenario.name!r}",
            )
