"""The front: users against arrival for every weight of the objective. Needs matplotlib."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure as Canvas

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import UavDcError
from uav_dc_ros.experiments.optimum.cli import OptimumReport

_SIZE_IN = (7.0, 4.5)
_ROUNDING = 1e-9


def greatest_users(reports: Sequence[OptimumReport], arrival_step: Array) -> Array:
    """Mean users that no planner exceeds at a mean arrival step, both `[n]`, if all missions land.

    For each weight w, the mean of J = w users / U + (1 - w) (1 - arrival / T_cons) is at most the mean bound.
    """
    most = np.full(np.shape(arrival_step), float(reports[0].users_total))
    for report in reports:
        w = report.objective_weight
        left = report.bound - (1.0 - w) * (1.0 - arrival_step / report.max_steps)
        if w > 0.0:
            most = np.minimum(most, report.users_total * np.maximum(left, 0.0) / w)
        else:
            most = np.where(left >= -_ROUNDING, most, 0.0)
    return most


def draw_front(reports: Sequence[OptimumReport], path: Path) -> None:
    """Draw the best missions of each weight, the bound, and the policies, all as means over the seeds.

    Raises UavDcError if the picture cannot be written.
    """
    first = reports[0]
    canvas = Canvas(figsize=_SIZE_IN, layout="constrained")
    axes = canvas.subplots()
    steps = np.linspace(0.0, first.max_steps, 400)
    most = greatest_users(reports, steps)
    axes.fill_between(steps, most, first.users_total, color="0.88", label="no planner gets here")
    axes.plot(steps, most, color="0.4", linewidth=1)
    means = [
        (np.mean([m.arrival_step for m in one.missions]), np.mean([m.users_collected for m in one.missions]))
        for one in reports
    ]
    axes.plot(*zip(*means, strict=True), "o-", markersize=4, label="best missions found, w from 0 to 1")
    for standing in first.policies:
        if standing.arrival_step is not None:
            axes.plot(standing.arrival_step, standing.users_collected, "s", label=standing.policy)
    soonest = means[0][0]
    axes.set(
        xlabel=f"arrival step, of {first.max_steps}",
        ylabel=f"users collected, of {first.users_total}",
        title=f"{first.scenario}, means over {len(first.missions)} missions with the walks known",
        xlim=(0.9 * soonest, first.max_steps),
        ylim=(0.0, 1.03 * first.users_total),
    )
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    try:
        canvas.savefig(path, dpi=130, metadata={"Software": None})
    except (OSError, ValueError) as error:
        raise UavDcError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from None
