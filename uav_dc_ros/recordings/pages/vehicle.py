"""The flight of a real vehicle as a page shows it: its phases with their reasons, and its way."""

import math
from typing import Any

import numpy as np

from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.errors import MessageError
from uav_dc_ros.phases import BEFORE_START
from uav_dc_ros.recordings.recorded_step import RecordedPose, RecordedStep, Told
from uav_dc_ros.recordings.step_reader import read_pose
from uav_dc_ros.recordings.thinning import Apart

WORDS_MAX = 1000  # phases and reasons that are shown of a mission
CELLS_MAX = 1000  # steps whose distance from the cell is shown
WAY_MAX = 3000  # poses that are drawn of a bag
APART_CELLS = 0.02  # poses that lie nearer together than this, and come sooner than that, ...
APART_NS = 10**9  # ... are one


class Way:
    """Poses of a bag, thinned out: one that grows too long loses every second of them."""

    def __init__(self, scenario: Scenario) -> None:
        self._apart_m = APART_CELLS * scenario.grid.cell_m
        self._poses: Apart[RecordedPose] = Apart(WAY_MAX)

    def add(self, pose: RecordedPose) -> None:
        """The next one, in the order in which they were received."""
        if self._poses.kept:
            last, factor = self._poses.kept[-1], self._poses.factor
            far = math.dist(pose.position_m, last.position_m) >= self._apart_m * factor
            if not far and pose.publish_ns - last.publish_ns < APART_NS * factor:
                return
        self._poses.add(pose)

    def columns(self, begun_ns: int, ended_ns: int) -> dict[str, list[float]]:
        """Seconds from `begun_ns`, x, y, altitude (m) of the poses published up to `ended_ns`."""
        shown = [pose for pose in self._poses.kept if begun_ns <= pose.publish_ns <= ended_ns]
        seconds = [round((pose.publish_ns - begun_ns) * 1e-9, 2) for pose in shown]
        places = np.round(np.asarray([pose.position_m for pose in shown]).reshape(-1, 3), 2)
        return {"s": seconds, **dict(zip("xyz", places.T.tolist(), strict=True))}


def way(reader: BagReader, namespace: str, scenario: Scenario) -> Way:
    """The way of the vehicle in a namespace of a bag: one pass over its poses."""
    found = Way(scenario)
    for _, message in reader.received([f"{namespace}/pose"]) if f"{namespace}/pose" in reader.topics else ():
        try:
            found.add(read_pose(message))
        except MessageError:
            continue  # `Steps` counts it
    return found


class Journey:
    """One mission of a real vehicle, step by step.

    Args:
        scenario: the world.

    Attributes:
        words: step, and what the vehicle told of it: the first `WORDS_MAX`.
        total: how many there were.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.words: list[tuple[int, Told]] = []
        self.total = 0
        self._scenario = scenario
        self._cells: list[tuple[int, int, Array, float | None]] = []  # time, step, centre, distance from it
        self._ended_ns = 0

    def add(self, step: RecordedStep) -> None:
        """The next step."""
        self.total += len(step.told) + step.untold
        self.words += [(step.step, told) for told in step.told[: WORDS_MAX - len(self.words)]]
        self._ended_ns = max([self._ended_ns, *(told.publish_ns for told in step.told)])
        there = [told.publish_ns for told in step.told if told.phase not in BEFORE_START]
        if step.status is None or not there or len(self._cells) >= CELLS_MAX:
            return
        centre_m = self._scenario.grid.centre_m(np.asarray(step.status.cell), like=np.zeros(1))
        off_m = None if step.position_m is None else round(math.dist(step.position_m, centre_m), 2)
        if step.is_measured:
            self._cells.append((there[0], step.step, centre_m, off_m))

    def page(self, way: Way) -> dict[str, Any]:
        """The page's data; times are seconds from the first word."""
        centres_m = np.asarray([it[2] for it in self._cells]).reshape(-1, 3)
        begun_ns = self.words[0][1].publish_ns if self.words else 0
        ends_ns = [told.publish_ns for _, told in self.words[1:]] + [self._ended_ns]

        def seconds(at_ns: int) -> float:
            return round((at_ns - begun_ns) * 1e-9, 2)

        return {
            "words": [
                {
                    "s": seconds(told.publish_ns),
                    "lasted_s": round(
                        max(0, end_ns - told.publish_ns) * 1e-9, 2
                    ),  # the clock may be set back
                    "step": step,
                    "phase": told.phase.value,
                    "reason": told.reason,
                    "held": told.held,
                }
                for (step, told), end_ns in zip(self.words, ends_ns, strict=True)
            ],
            "words_total": self.total,
            "way": way.columns(begun_ns, self._ended_ns),
            "cells": {
                "s": [seconds(at_ns) for at_ns, *_ in self._cells],
                "step": [step for _, step, *_ in self._cells],
                **dict(zip("xyz", centres_m.T.tolist(), strict=True)),
                "off_m": [it[3] for it in self._cells],
            },
        }
