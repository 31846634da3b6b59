"""The rule by which one world is chosen. It was committed before the multiverse was run.

1. Only worlds in which C1 holds: the paper's own agent visits about 40 of 50 users and lands.
2. Of those, the world in which most claims hold.
3. Of equals, the most plausible one: it has the smallest root mean square, over `choices.REFERENCES`, of the
   binary logarithm of value / reference. At 1, a usual value is twice or half of what is plausible.
4. Of equals, the first.

In none of the first 64 worlds does C1 hold. So the rule was extended, before any other world was trained: C1
alone is weighed in the next worlds of the sequence whose episode ends at the time limit (where it ends on
arrival, the agent of none of the 64 lands in more than one greedy mission in ten), and every claim in those
in which it holds. Points 1 to 4 then choose among all worlds in which every claim was weighed.

It was extended again when 60 of the 176 screened worlds were known, with C1 in none of them and undecided in
five. Where it is undecided, it is weighed again in four times as many environments.

The confirming sweep uses other environments and seeds than the multiverse (`plan.ENVIRONMENTS`).
"""

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.experiments.paper.worlds.choices import REFERENCES
from uav_dc_ros.experiments.paper.worlds.draw import World
from uav_dc_ros.experiments.paper.worlds.verdicts import IDS, Multiverse


def implausibility(world: World) -> float:
    """Distance of a world from the references, in doublings."""
    ratios = [getattr(world, one.name) / one.value for one in REFERENCES]
    return float(np.sqrt(np.mean(np.log2(ratios) ** 2)))


def ranking(multiverse: Multiverse) -> Array:
    """Indices of the worlds in which C1 holds, integers `[n]`, the best first."""
    holds = multiverse.verdicts == "holds"
    eligible = np.flatnonzero(holds[:, IDS.index("C1")])
    key = [(-holds[i].sum(), implausibility(multiverse.worlds[i]), i) for i in eligible]
    return np.array([i for *_, i in sorted(key)], np.intp)


def choose(multiverse: Multiverse) -> World | None:
    """The chosen world; None if C1 holds in none."""
    ranked = ranking(multiverse)
    return multiverse.worlds[ranked[0]] if len(ranked) else None
