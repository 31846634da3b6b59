"""The flight of a real vehicle as page data: its phases with their reasons, and its path."""

import math
from typing import Any

import numpy as np

from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.phases import BEFORE_START
from uav_dc_ros.recordings.recorded_step import PhaseReport, RecordedPose, RecordedStep
from uav_dc_ros.recordings.step_reader import read_pose
from uav_dc_ros.recordings.thinning import SpacedSeries

REPORTS_MAX = 1000  # phase reports shown of a mission
CELLS_MAX = 1000  # steps whose distance from the cell is shown
PATH_MAX = 3000  # poses drawn of a bag
# A pose is kept if it is this far from the last one, or published this much later.
SPACING_CELLS = 0.02
SPACING_NS = 10**9


class VehiclePath:
    """Poses of a bag, thinned when there are many."""

    def __init__(self, scenario: Scenario) -> None:
        self._spacing_m = SPACING_CELLS * scenario.grid.cell_m
        self._poses: SpacedSeries[RecordedPose] = SpacedSeries(PATH_MAX)

    def add(self, pose: RecordedPose) -> None:
        """Add the next pose in the order of receipt."""
        if self._poses.kept:
            last, factor = self._poses.kept[-1], self._poses.factor
            far = math.dist(pose.position_m, last.position_m) >= self._spacing_m * factor
            if not far and pose.publish_ns - last.publish_ns < SPACING_NS * factor:
                return
        self._poses.add(pose)

    def columns(self, start_ns: int, end_ns: int) -> dict[str, list[float]]:
        """Seconds from `start_ns`, x, y, altitude (m) of the poses published up to `end_ns`."""
        shown = [pose for pose in self._poses.kept if start_ns <= pose.publish_ns <= end_ns]
        seconds = [round((pose.publish_ns - start_ns) * 1e-9, 2) for pose in shown]
        positions = np.round(np.asarray([pose.position_m for pose in shown]).reshape(-1, 3), 2)
        return {"s": seconds, **dict(zip("xyz", positions.T.tolist(), strict=True))}


def read_path(reader: BagReader, namespace: str, scenario: Scenario) -> VehiclePath:
    """The path of the vehicle in a namespace of a bag."""
    path = VehiclePath(scenario)
    for _, message in reader.received([f"{namespace}/pose"]) if f"{namespace}/pose" in reader.topics else ():
        try:
            path.add(read_pose(message))
        except MessageError:
            continue  # `Steps` counts it
    return path


class VehicleTimeline:
    """Phases and cells of a mission of a real vehicle; `reports`: step and phase report."""

    def __init__(self, scenario: Scenario) -> None:
        self.reports: list[tuple[int, PhaseReport]] = []
        self._total = 0
        self._scenario = scenario
        self._cells: list[tuple[int, int, Array, float | None]] = []  # time, step, centre, distance from it
        self._end_ns = 0

    def add(self, step: RecordedStep) -> None:
        """Add the next step."""
        reports = step.phase_reports
        self._total += len(reports) + step.n_dropped_reports
        self.reports += [(step.step, report) for report in reports[: REPORTS_MAX - len(self.reports)]]
        self._end_ns = max([self._end_ns, *(report.publish_ns for report in reports)])
        started_ns = [report.publish_ns for report in reports if report.phase not in BEFORE_START]
        if step.status is None or not started_ns or len(self._cells) >= CELLS_MAX or not step.is_measured:
            return
        centre_m = self._scenario.grid.centre_m(np.asarray(step.status.cell), like=np.zeros(1))
        distance_m = None if step.position_m is None else round(math.dist(step.position_m, centre_m), 2)
        self._cells.append((started_ns[0], step.step, centre_m, distance_m))

    def data(self, path: VehiclePath) -> dict[str, Any]:
        """Page data; times are seconds from the first phase report."""
        centres_m = np.asarray([it[2] for it in self._cells]).reshape(-1, 3)
        start_ns = self.reports[0][1].publish_ns if self.reports else 0
        ends_ns = [report.publish_ns for _, report in self.reports[1:]] + [self._end_ns]

        def seconds(at_ns: int) -> float:
            return round((at_ns - start_ns) * 1e-9, 2)

        return {
            "phases": [
                {
                    "s": seconds(report.publish_ns),
                    # Not below 0: the clock may be set back.
                    "lasted_s": round(max(0, end_ns - report.publish_ns) * 1e-9, 2),
                    "step": step,
                    "phase": report.phase.value,
                    "reason": report.reason,
                    "held": report.held,
                }
                for (step, report), end_ns in zip(self.reports, ends_ns, strict=True)
            ],
            "phases_total": self._total,
            "path": path.columns(start_ns, self._end_ns),
            "cells": {
                "s": [seconds(at_ns) for at_ns, *_ in self._cells],
                "step": [step for _, step, *_ in self._cells],
                **dict(zip("xyz", centres_m.T.tolist(), strict=True)),
                "distance_m": [it[3] for it in self._cells],
            },
        }
