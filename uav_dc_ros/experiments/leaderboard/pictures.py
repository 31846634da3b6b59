"""Pictures of the flights that a leaderboard lists. Needs matplotlib, and Pillow, which comes with it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from uav_dc_ros import files, scenarios
from uav_dc_ros.agents.agent import Agent
from uav_dc_ros.env.render import picture
from uav_dc_ros.experiments.evaluate.rollout import roll_out_trajectory
from uav_dc_ros.experiments.leaderboard.page import FLIGHTS_PICTURE, WORST_PICTURE
from uav_dc_ros.experiments.leaderboard.standings import LeaderboardReport, ListedFlight

_COLUMNS = 5  # of the worst flights
# A palette takes a quarter of the bytes; that of the octree keeps the few points of a rare colour.
_PALETTE = Image.Quantize.FASTOCTREE


def draw(report: LeaderboardReport, agent: Agent, folder: Path) -> None:
    """Fly the listed flights of the baseline again, and draw them."""
    if report.best is None or report.median is None:
        return
    _sheet([report.best, report.median, report.worst[0]], 3, 0.75, agent, report, folder / FLIGHTS_PICTURE)
    _sheet(report.worst, _COLUMNS, 0.5, agent, report, folder / WORST_PICTURE)


def _sheet(
    flights: Sequence[ListedFlight],
    columns: int,
    scale: float,
    agent: Agent,
    report: LeaderboardReport,
    path: Path,
) -> None:
    pictures = []
    for one in flights:
        scenario = scenarios.load(one.scenario)
        act = agent.act_in(scenario, report.objective_weight)
        full = Image.fromarray(picture(roll_out_trajectory(scenario, act, one.seed)))
        size = round(full.width * scale), round(full.height * scale)
        pictures.append(full.resize(size, Image.Resampling.LANCZOS))
    wide, high = (max(side) for side in zip(*(one.size for one in pictures), strict=True))
    n_rows = -(-len(pictures) // columns)
    corner = np.asarray(pictures[0])[0, 0]  # the paper's colour
    sheet = Image.new("RGB", (wide * columns, high * n_rows), tuple(corner.tolist()))
    for i, tile in enumerate(pictures):
        sheet.paste(tile, (i % columns * wide, i // columns * high))
    with files.replacing(path) as partial:
        sheet.quantize(256, _PALETTE, dither=Image.Dither.NONE).save(partial, "PNG", optimize=True)
