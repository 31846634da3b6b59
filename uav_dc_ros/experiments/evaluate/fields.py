"""`evaluate --fields`: policies in many random fields, compared field by field."""

from collections.abc import Sequence

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from uav_dc_ros import __version__, scenarios
from uav_dc_ros.agents.agent import Agent
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.experiments.evaluate.evaluation import Figure, figure
from uav_dc_ros.experiments.evaluate.rollout import roll_out

# Of each figure: title, decimals.
_SHOWN = {
    "objective": ("objective J", 4),
    "landing_rate": ("landing rate", 4),
    "users_share": ("users collected, share", 4),
    "arrival_share": ("arrival, share of T_cons", 4),
}


class FieldsEvaluation(msgspec.Struct, frozen=True, kw_only=True):
    """A policy in many fields. A figure is over the fields: of each, the mean over its missions."""

    policy: str
    sha256: str | None  # of config and model; none for a planner
    objective: Figure  # J, see `core.objective`
    landing_rate: Figure  # share of the missions
    users_share: Figure  # users collected, of all users
    arrival_share: Figure  # step of the arrival, of T_cons; missions that landed only
    worst_fields: list[int]  # seeds of the ten fields with the lowest J, the lowest first


class FieldsComparison(msgspec.Struct, frozen=True, kw_only=True):
    """Two policies in the same missions, field by field."""

    policy: str
    baseline: str
    differences: dict[str, Figure]  # `policy` minus `baseline`, by the name in `FieldsEvaluation`
    better: int  # fields in which the policy has the higher J
    worse: int


class FieldsReport(msgspec.Struct, frozen=True, kw_only=True):
    """The content of a file of `python -m uav_dc_ros.evaluate --fields N --json`."""

    version: str  # of the package
    fields: tuple[int, int]  # first seed and number of the random fields
    seeds: tuple[int, int]  # first seed and number of the missions in each field
    objective_weight: float  # w in J
    evaluations: list[FieldsEvaluation]
    comparisons: list[FieldsComparison]  # every further policy with the first


def evaluate_fields(candidates: Sequence[Agent], n_fields: int, seeds: range, weight: float) -> FieldsReport:
    """Fly the missions of `seeds` in the random fields of seeds 0 to `n_fields` - 1.

    Raises:
        PolicyError: a policy does not fit a field.
    """
    found = [{name: np.full(n_fields, np.nan) for name in _SHOWN} for _ in candidates]
    for i in range(n_fields):
        scenario = scenarios.load(f"{scenarios.RANDOM}{i}")
        for candidate, values in zip(candidates, found, strict=True):
            missions = roll_out(scenario, candidate.act_in(scenario, weight), seeds, service=False)
            values["objective"][i] = missions.objective(scenario, weight).mean()
            values["landing_rate"][i] = missions.landed.mean()
            values["users_share"][i] = missions.users_collected.mean() / scenario.n_users
            if missions.landed.any():
                arrival = missions.arrival_step[missions.landed].mean()
                values["arrival_share"][i] = arrival / scenario.mission.max_steps
    return FieldsReport(
        version=__version__,
        fields=(0, n_fields),
        seeds=(seeds.start, len(seeds)),
        objective_weight=weight,
        evaluations=[_evaluation(*pair) for pair in zip(candidates, found, strict=True)],
        comparisons=[
            _comparison(candidate.name, values, candidates[0].name, found[0])
            for candidate, values in zip(candidates[1:], found[1:], strict=True)
        ],
    )


def _evaluation(candidate: Agent, values: dict[str, Array]) -> FieldsEvaluation:
    return FieldsEvaluation(
        policy=candidate.name,
        sha256=candidate.sha256,
        worst_fields=np.argsort(values["objective"], kind="stable")[:10].tolist(),
        **{name: figure(each, (0.0, 1.0)) for name, each in values.items()},
    )


def _comparison(
    name: str, values: dict[str, Array], baseline: str, of_baseline: dict[str, Array]
) -> FieldsComparison:
    differences = {key: values[key] - of_baseline[key] for key in _SHOWN}
    return FieldsComparison(
        policy=name,
        baseline=baseline,
        differences={key: figure(each) for key, each in differences.items()},
        better=int((differences["objective"] > 0).sum()),
        worse=int((differences["objective"] < 0).sum()),
    )


def show_fields(report: FieldsReport, console: Console, table: Table) -> None:
    """Print the means of all policies and their differences from the first policy's, into an empty table."""
    table.add_column("", overflow="fold")
    for title, _ in _SHOWN.values():
        table.add_column(title.replace(" ", "\n", 1), justify="right", no_wrap=True)
    for one in report.evaluations:
        table.add_row(f" {one.policy}", *(_cell(name, getattr(one, name)) for name in _SHOWN))
    if report.comparisons:
        table.add_section()
        table.add_row(f"[bold]less {report.comparisons[0].baseline}")
    for comparison in report.comparisons:
        cells = (_cell(name, comparison.differences[name], "+") for name in _SHOWN)
        table.add_row(f" {comparison.policy}", *cells)
    n_fields, n_missions = report.fields[1], report.seeds[1]
    title = f"Means and their 95% bootstrap intervals over the random fields 0 to {n_fields - 1}, "
    console.print(
        f"{title}{n_missions} missions each, w = {report.objective_weight:.3g}", style="bold", soft_wrap=True
    )
    console.print(table, "")
    for comparison in report.comparisons:
        fields = f"{comparison.better} fields, below in {comparison.worse}"
        console.print(
            f"{comparison.policy}: J above that of {comparison.baseline} in {fields}",
            markup=False,
            soft_wrap=True,
        )


def _cell(name: str, values: Figure, sign: str = "") -> str:
    if values.mean is None:
        return "-"
    decimals = _SHOWN[name][1]
    mean = f"{values.mean:{sign}z.{decimals}f}"
    if values.low is None or values.high is None:
        return mean
    return f"{mean}\n[dim]{values.low:{sign}z.{decimals}f}..{values.high:{sign}z.{decimals}f}[/dim]"
