"""Markers of a mission for RViz and Foxglove: a serialized MarkerArray."""

import textwrap
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from enum import IntEnum

import numpy as np
from msgspec import UNSET
from visualization_msgs.msg import Marker

from uav_dc_ros.cdr import FRAME, Writer
from uav_dc_ros.core import radio
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.obstacles.mesh import faces_m
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Mission, Phase

Rgba = tuple[float, float, float, float]
Xyz = tuple[float, float, float]
ORIGIN: Xyz = (0.0, 0.0, 0.0)

# Sizes in cells of the grid.
USER_CELLS = 0.16  # diameter of a user ...
USER_SPACING = 0.6  # ... but not more than this share of the mean distance in a cluster ...
USER_CELLS_MIN = 0.03  # ... and visible
SERVED_SCALE = 1.5  # served users differ from others without colour, too
UAV_CELLS = 0.3
DOCK_CELLS = 0.5
TEXT_CELLS = 0.32  # height of a capital
TEXT_ABOVE_CELLS = 0.9
REASON_WIDTH, REASON_LINES = 40, 3  # characters: a larger text hides the scene
THIN_CELLS = 0.01  # thickness and vertical distance of flat markers, so that no two surfaces coincide


class UserState(IntEnum):
    """State of a user; the value is the id of its marker."""

    WAITING = 0
    SERVED = 1
    COLLECTED = 2


def _rgba(hex: str, alpha: float = 1.0) -> Rgba:
    red, green, blue = (value / 255.0 for value in bytes.fromhex(hex))
    return red, green, blue, alpha


# Okabe and Ito's colour-blind safe palette. The colours of users also differ in lightness (L* 54, 89, 70).
USER_COLOURS: dict[UserState, Rgba] = {
    UserState.WAITING: _rgba("D55E00"),  # vermilion
    UserState.SERVED: _rgba("F0E442"),  # yellow
    UserState.COLLECTED: _rgba("56B4E9"),  # sky blue
}
FOOTPRINT_COLOUR = _rgba("F0E442", 0.18)
CLUSTER_COLOUR = _rgba("999999", 0.35)
OBSTACLE_COLOURS = {"building": _rgba("999999", 0.9), "no_fly": _rgba("D55E00", 0.25)}
DOCK_COLOUR = _rgba("009E73", 0.9)  # bluish green
UAV_COLOUR = _rgba("CC79A7")  # reddish purple
TEXT_COLOUR = _rgba("FFFFFF")


@dataclass(frozen=True, kw_only=True)
class Scene:
    """State of a mission; unknown values are None, or empty."""

    time_ns: int  # mission time of the pose, nanoseconds
    position_m: Xyz | None  # of the UAV: x, y and altitude, metres
    users_m: Array  # positions, metres, [U, 2]
    served: Array  # bool [U]
    collected: Array  # bool [U]
    mission: Mission | None
    sum_rate_bps: float | None  # of the last step, bit/s


@dataclass(frozen=True)
class Shape:
    """The fields in use of a visualization_msgs/Marker, in frame `map`, in the order of its definition."""

    ns: str
    id: int
    type: int
    position_m: Xyz
    scale_m: Xyz
    colour: Rgba
    _: KW_ONLY
    points_m: Array = field(default_factory=lambda: np.empty((0, 3)))
    text: str = ""
    shown: bool = True


def markers(scenario: Scenario, scene: Scene) -> bytes:
    """A serialized visualization_msgs/MarkerArray that replaces all markers."""
    shapes = [*_ground(scenario), *_users(scenario, scene), *_uav(scenario, scene)]
    writer = Writer()
    writer.numbers("I", len(shapes))
    for shape in shapes:
        _write(writer, shape, scene.time_ns)
    return writer.message()


def status_text(scenario: Scenario, scene: Scene) -> str:
    """Step, state of charge by the scenario's model, users collected and sum-rate, a line each.

    Without a battery in the scenario it lacks the second; of a real vehicle it also has state and reason.
    """
    lines = []
    if (mission := scene.mission) is not None:
        is_ready = mission.phase is Phase.READY and not mission.held
        state = "" if is_ready else f": {mission.state}"
        lines.append(f"step {mission.step} of {scenario.mission.max_steps}{state}")
        if mission.reason and not is_ready:
            lines += textwrap.wrap(mission.reason, REASON_WIDTH)[:REASON_LINES]
        if mission.state_of_charge is not UNSET:
            lines.append(f"battery by the model: {mission.state_of_charge:.0%}")
    if scene.sum_rate_bps is not None:
        lines.append(f"{int(np.sum(scene.collected))} of {scenario.n_users} users collected")
        lines.append(f"{scene.sum_rate_bps / 1e6:.2f} Mbit/s")
    return "\n".join(lines)


def _ground(scenario: Scenario) -> Sequence[Shape]:
    """The start areas of the clusters, the obstacles, and the dock."""
    thin_m, side_m = THIN_CELLS * scenario.grid.cell_m, DOCK_CELLS * scenario.grid.cell_m
    dock_m = (*scenario.mission.dock_m, 0.0)
    clusters = []
    for i, disc in enumerate(scenario.users.clusters):
        width_m = max(2 * disc.radius_m, thin_m)  # RViz warns about a marker without a size
        at_m, area_m = (*disc.centre_m, -2 * thin_m), (width_m, width_m, thin_m)
        clusters.append(Shape("clusters", i, Marker.CYLINDER, at_m, area_m, CLUSTER_COLOUR))
    dock = Shape("dock", 0, Marker.CUBE, dock_m, (side_m, side_m, thin_m), DOCK_COLOUR)
    return [*clusters, *_obstacles(scenario), dock]


def _obstacles(scenario: Scenario) -> Sequence[Shape]:
    """One marker for all buildings, and one for all no-fly zones."""
    ceiling_m = scenario.grid.altitude_min_m + scenario.grid.n_z * scenario.grid.altitude_step_m
    shapes = []
    for kind, colour in OBSTACLE_COLOURS.items():
        faces = [faces_m(one, ceiling_m).reshape(-1, 3) for one in scenario.obstacles if one.kind == kind]
        if faces:
            points_m = np.concatenate(faces)
            shapes.append(
                Shape(kind, 0, Marker.TRIANGLE_LIST, ORIGIN, (1.0, 1.0, 1.0), colour, points_m=points_m)
            )
    return shapes


def _users(scenario: Scenario, scene: Scene) -> Sequence[Shape]:
    """One marker for the users of each state."""
    cell_m, clusters = scenario.grid.cell_m, zip(scenario.users.clusters, scenario.users.sizes, strict=True)
    crowded_m = min(
        USER_SPACING * (disc.radius_m / float(np.sqrt(n)) if n > 1 else cell_m) for disc, n in clusters
    )
    width_m = min(USER_CELLS * cell_m, max(crowded_m, USER_CELLS_MIN * cell_m))
    others = np.where(scene.served, UserState.SERVED, UserState.WAITING)
    states = np.where(scene.collected, UserState.COLLECTED, others)  # [U]
    shapes = []
    for state, colour in USER_COLOURS.items():
        users_m = scene.users_m[states == state]
        size_m = width_m * (SERVED_SCALE if state is UserState.SERVED else 1.0)
        sizes_m, points_m = (size_m, size_m, size_m), np.column_stack([users_m, np.zeros(len(users_m))])
        shape = Shape("users", state, Marker.SPHERE_LIST, ORIGIN, sizes_m, colour, points_m=points_m)
        shapes.append(replace(shape, shown=len(users_m) > 0))  # RViz warns about empty lists
    return shapes


def _uav(scenario: Scenario, scene: Scene) -> Sequence[Shape]:
    """The UAV, a line down to the ground, its service area, and the status text."""
    cell_m = scenario.grid.cell_m
    thin_m, width_m = THIN_CELLS * cell_m, UAV_CELLS * cell_m
    known = scene.position_m is not None
    x_m, y_m, z_m = at_m = scene.position_m or ORIGIN
    reach_m = radio.ground_reach_m(scenario.mission.d_cons_m, z_m) if known else 0.0
    area_m, below_m = (2 * reach_m, 2 * reach_m, thin_m), (x_m, y_m, -thin_m)
    uav_m, line_m = (width_m, width_m, width_m / 2), (2 * thin_m, 0.0, 0.0)
    down_m = np.array([at_m, (x_m, y_m, 0.0)])
    text, text_m = status_text(scenario, scene), (0.0, 0.0, TEXT_CELLS * cell_m)
    above_m, shown = (x_m, y_m, z_m + TEXT_ABOVE_CELLS * cell_m), known and bool(text)
    return [
        Shape("footprint", 0, Marker.CYLINDER, below_m, area_m, FOOTPRINT_COLOUR, shown=reach_m > 0),
        Shape("uav", 0, Marker.SPHERE, at_m, uav_m, UAV_COLOUR, shown=known),
        Shape("uav", 1, Marker.LINE_LIST, ORIGIN, line_m, UAV_COLOUR, points_m=down_m, shown=known),
        Shape("status", 0, Marker.TEXT_VIEW_FACING, above_m, text_m, TEXT_COLOUR, text=text, shown=shown),
    ]


def _write(writer: Writer, shape: Shape, time_ns: int) -> None:
    """Write a visualization_msgs/Marker, in the order of its definition."""
    writer.stamp(time_ns)
    writer.text(FRAME)
    writer.text(shape.ns)
    writer.numbers("i", shape.id, shape.type, Marker.ADD if shape.shown else Marker.DELETE)
    writer.numbers("d", *shape.position_m, 0.0, 0.0, 0.0, 1.0, *shape.scale_m)
    writer.numbers("f", *shape.colour)
    writer.stamp(0)  # lifetime: unlimited
    writer.numbers("?", False)  # frame_locked
    writer.points(shape.points_m)
    writer.numbers("I", 0)  # colors
    writer.text("")  # texture_resource, and texture: header, format, data
    writer.stamp(0)
    writer.text("")
    writer.text("")
    writer.numbers("I", 0)
    writer.numbers("I", 0)  # uv_coordinates
    writer.text(shape.text)
    writer.text("")  # mesh_resource, and mesh_file: filename, data
    writer.text("")
    writer.numbers("I", 0)
    writer.numbers("?", False)  # mesh_use_embedded_materials
