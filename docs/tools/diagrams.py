"""Draws docs/figures/*.svg, and writes the tables of docs/topics.md and docs/parameters.md, from the code.

    python docs/tools/diagrams.py

Sources: the node table, the topic table, the layers contract in pyproject.toml, and the phase transitions
that `bag verify` accepts. A test compares the committed files with what these give.
"""

import re
import tomllib
from collections.abc import Iterator
from html import escape
from pathlib import Path

from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.framework.node_table import NODES, mission_rows
from uav_dc_ros.nodes.framework.parameters import COMMON, Parameter
from uav_dc_ros.phases import TRANSITIONS
from uav_dc_ros.topics import TOPICS, Topic

DOCS = Path(__file__).parents[1]
INK, PAPER, FAINT, BOX, ACCENT, WARN = "#1d2733", "#ffffff", "#c9c4b8", "#eef2f7", "#2b5f9e", "#c9502c"
FONT = "font-family='DejaVu Sans, Verdana, sans-serif'"
HIDDEN = ("bag_record", "diagnostics")  # a command of its own; a topic of every node

# What each topic holds. Everything else in the table is in `uav_dc_ros.topics` and in the node table.
CONTENT = {
    "pose": "the UAV's position and heading",
    "users": "step, time, seeds of a random channel, and of every user the cluster, x and y",
    "rates": "sum-rate; of every user SINR, rate, data, served, collected",
    "mission": "step that the vehicle is ready for, phase, reason, cell, remaining steps, steps not reached, "
    "energy used",
    "move": "the action for one step",
    "target": "the cell that the vehicle flies to",
    "ready": "a node has matched all its peers",
    "path": "the UAV's path in this mission",
    "markers": "users by state, clusters, range, dock, UAV, status text",
    "sum_rate": "sum of the rates of the served users, bit/s",
    "users_collected": "number of users whose data is collected",
    "remaining_steps": "steps that the battery still allows",
    "odom": "the pose, and the mean velocity since the one before it",
    "battery": "the vehicle's charge, or of a simulated one by the scenario's model; where there is one",
    "fix": "a real vehicle's latitude and longitude, without altitude; only where the grid has a datum",
    "tf": "`map` to `base_link`; only where tf2_msgs is installed",
    "diagnostics": "state, process, rates, latencies (p50, p99), rejected messages, restarts",
    "clock": "mission time, for nodes with `use_sim_time`",
}


def svg(width: float, height: float, body: list[str], title: str) -> str:
    """A whole picture."""
    arrow = (
        "<marker id='{0}' viewBox='0 0 8 8' refX='7' refY='4' markerWidth='7' markerHeight='7' orient='auto'>"
        "<path d='M0,0.5 L8,4 L0,7.5 z' fill='{1}'/></marker>"
    )
    marks = "".join(arrow.format(name, c) for name, c in (("ink", INK), ("accent", ACCENT), ("warn", WARN)))
    head = f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width:g} {height:g}' role='img' {FONT}>"
    head += f"<title>{escape(title)}</title><defs>{marks}</defs>"
    return "\n".join([head, f"<rect width='100%' height='100%' fill='{PAPER}'/>", *body, "</svg>\n"])


def text(x: float, y: float, words: str, size: float = 13, more: str = "") -> str:
    """One line of text."""
    return f"<text x='{x:g}' y='{y:g}' font-size='{size:g}' fill='{INK}' {more}>{escape(words)}</text>"


def box(
    x: float, y: float, width: float, height: float, words: str, fill: str = BOX, size: float = 13
) -> str:
    """A rectangle with a text in its middle."""
    place = f"x='{x:g}' y='{y:g}' width='{width:g}' height='{height:g}'"
    frame = f"<rect {place} rx='6' fill='{fill}' stroke='{INK}'/>"
    return frame + text(x + width / 2, y + height / 2 + size * 0.35, words, size, "text-anchor='middle'")


def dot(x: float, y: float, fill: str) -> str:
    """A circle where a node meets a topic."""
    return f"<circle cx='{x:g}' cy='{y:g}' r='6' fill='{fill}' stroke='{ACCENT}' stroke-width='2'/>"


def line(points: list[tuple[float, float]], colour: str, mark: str = "", dashed: bool = False) -> str:
    """A line through points, with an arrow at its end where `mark` names one."""
    path = " ".join(f"{x:g},{y:g}" for x, y in points)
    end = f" marker-end='url(#{mark})'" if mark else ""
    dash = " stroke-dasharray='5 4'" if dashed else ""
    return f"<polyline points='{path}' fill='none' stroke='{colour}' stroke-width='1.5'{end}{dash}/>"


def edges(nodes: tuple[str, ...]) -> dict[str, tuple[list[str], list[str]]]:
    """Of each topic of a mission of these nodes: who publishes it, and who subscribes to it."""
    table = {name: row for name, row in mission_rows(nodes).items() if name in nodes}
    found = {}
    for topic in TOPICS:
        publishers = [name for name, row in table.items() if topic in row.publishes]
        subscribers = [name for name, row in table.items() if topic in row.subscribes]
        if publishers and topic not in HIDDEN:
            found[topic] = (publishers, subscribers)
    return found


def node_graph(nodes: tuple[str, ...], title: str) -> str:
    """Nodes as columns, topics as rows: an arrow leaves the publishers' row and ends at each subscriber."""
    found = edges(nodes)
    left, column, row, top = 96.0, 124.0, 34.0, 62.0
    x = {name: left + column * (i + 0.5) for i, name in enumerate(nodes)}
    bottom = top + row * len(found) + 6
    body = []
    for name in nodes:
        body.append(line([(x[name], 44), (x[name], bottom)], FAINT))
        body.append(box(x[name] - 58, 14, 116, 30, name, size=12))
    for i, (topic, (publishers, subscribers)) in enumerate(found.items()):
        y = top + row * (i + 0.5)
        body.append(text(left - 12, y + 4, topic, 13, "text-anchor='end'"))
        ends = [x[name] for name in (*publishers, *subscribers)]
        body.append(line([(min(ends), y), (max(ends), y)], ACCENT))
        body += [dot(x[name], y, PAPER) for name in subscribers]
        body += [dot(x[name], y, ACCENT) for name in publishers]
    y = bottom + 22
    body += [dot(left, y, ACCENT), text(left + 12, y + 4, "publishes", 12), dot(left + 100, y, PAPER)]
    body.append(text(left + 112, y + 4, "subscribes", 12))
    body.append(text(left + 220, y + 4, "Every node also publishes diagnostics.", 12))
    return svg(left + column * len(nodes) + 16, y + 20, body, title)


def layers() -> list[str]:
    """The layers of the import contract, the highest first."""
    pyproject = tomllib.loads((DOCS.parent / "pyproject.toml").read_text("utf-8"))
    contract = pyproject["tool"]["importlinter"]["contracts"][0]
    return list(contract["layers"])


def layer_picture() -> str:
    """One row for each layer; a module imports only from rows below its own."""
    width, row = 720.0, 44.0
    body = []
    for i, layer in enumerate(layers()):
        names = re.split(r"\s*[|:]\s*", layer)
        each = (width - 90) / len(names)
        for j, name in enumerate(names):
            body.append(box(14 + each * j, 12 + row * i, each - 8, row - 10, name))
    height = 12 + row * len(layers())
    body.append(line([(width - 60, 16), (width - 60, height - 10)], INK, "ink"))
    body.append(text(width - 48, height / 2, "imports", 12))
    return svg(
        width + 10,
        height + 4,
        body,
        "The layers of the package: a module imports only from layers below its own",
    )


# Where each phase is drawn: x, y, width, height.
_ROW = ("idle", "connecting", "preflight", "takeoff", "ready", "moving")
_PLACE: dict[str, tuple[float, float, float, float]] = {
    **{name: (20 + 130 * i, 110, 104, 36) for i, name in enumerate(_ROW)},
    "aborted": (20, 24, 854, 34),
    "landing": (20, 206, 754, 34),
    "landed": (20, 290, 176, 36),
    "timeout": (214, 290, 176, 36),
}


def transitions() -> Iterator[tuple[str, str, bool]]:
    """From, to, and whether the transition begins the next step."""
    within = {(one.before, one.after) for one in TRANSITIONS if not one.steps}
    for one in TRANSITIONS:
        if not (one.steps and (one.before, one.after) in within):
            yield one.before.value, one.after.value, bool(one.steps)


def phase_picture() -> str:
    """The phases, and which may follow which."""
    body = []
    for source, target, next_step in transitions():
        points = _route(source, target)
        colour, mark = (
            (WARN, "warn") if target == "aborted" else (ACCENT, "accent") if next_step else (INK, "ink")
        )
        body.append(line(points, colour, mark, dashed=next_step))
    for name in (phase.value for phase in Phase):
        x, y, width, height = _PLACE[name]
        over = Phase(name).is_over
        body.append(
            box(x, y, width, height, name, "#f6e3dc" if name == "aborted" else "#dfeee6" if over else BOX)
        )
    body.append(text(420, 304, "solid: within one step", 12))
    body.append(text(420, 322, "dashed: with the next step", 12))
    body.append(text(630, 304, "A restarted bridge begins again", 12))
    body.append(text(630, 322, "with idle or connecting.", 12))
    return svg(894, 346, body, "The phases of a mission, and which may follow which")


def _route(source: str, target: str) -> list[tuple[float, float]]:
    """The points of an arrow from one phase to another."""
    x, y, width, height = _PLACE[source]
    to_x, to_y, to_width, to_height = _PLACE[target]
    middle = x + width / 2
    if source == "landing" and target == "aborted":
        return [(x + width, y + height / 2), (824, y + height / 2), (824, to_y + to_height)]
    if source == "landing":
        down = to_x + to_width / 2 - 30
        return [(down, y + height), (down, to_y)]
    if source in _ROW and target in _ROW:
        step = _ROW.index(target) - _ROW.index(source)
        if step == 1:
            return [(x + width, y + 12), (to_x, to_y + 12)]
        if step > 1:  # over those between
            return [(x + width - 16, y), (x + width - 16, y - 18), (to_x + 16, y - 18), (to_x + 16, to_y)]
        return [(x, y + height - 10), (to_x + to_width, to_y + height - 10)]
    if target == "aborted":
        return [(middle, y), (middle, to_y + to_height)]
    if target == "landing":
        return [(middle - 34, y + height), (middle - 34, to_y)]
    # Past landing, on the ground: straight down, behind it.
    down = min(max(middle + (20 if target == "timeout" else 0), to_x + 12), to_x + to_width - 12)
    return [(down, y + height), (down, to_y)]


def qos(topic: Topic) -> str:
    """What publishers of a topic offer."""
    durability = "transient local" if topic.latched else "volatile"
    return f"{'reliable' if topic.reliable else 'best effort'}, {durability}"


def publishers(topic: str) -> str:
    """Who publishes a topic, in words."""
    names = [row.name for row in NODES.values() if topic in row.publishes]
    if len(names) <= 2:
        return " or ".join(names)
    return "every node" if len(names) == len(NODES) else "other nodes"


def topic_table() -> list[str]:
    """The topics, one row each."""
    lines = ["| topic | type | from | QoS | content |", "|---|---|---|---|---|"]
    for name, topic in TOPICS.items():
        content = CONTENT[name] if topic.recorded else f"{CONTENT[name]} (not recorded)"
        cells = (f"`{name}`", topic.type, publishers(name), qos(topic), content)
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def parameter_tables() -> list[str]:
    """The ROS parameters of each node that is a process, then those that every node has."""
    lines = []
    tables = {f"`{row.name}`": row.parameters for row in NODES.values() if row.process}
    for name, parameters in {**tables, "Every node": COMMON}.items():
        lines += [f"## {name}", ""]
        if parameters:
            lines += ["| parameter | default | expected | meaning |", "|---|---|---|---|"]
            lines += [parameter_row(parameter) for parameter in parameters]
        else:
            lines.append("No parameters of its own.")
        lines.append("")
    return lines[:-1]


def parameter_row(parameter: Parameter) -> str:
    """One parameter."""
    default = "" if parameter.default in ("", []) else f"`{parameter.default}`"
    words = f"{parameter.description}{' (read-only)' if parameter.read_only else ''}".replace("|", "\\|")
    return f"| `{parameter.name}` | {default} | {parameter.expected} | {words} |"


def filled(path: Path, lines: list[str]) -> str:
    """A page with new lines between its two marks."""
    before, begin, rest = path.read_text("utf-8").partition("<!-- generated by docs/tools/diagrams.py -->\n")
    _, end, after = rest.partition("<!-- end -->\n")
    if not begin or not end:
        raise ValueError(f"{path}: the two marks of the generated part are missing")
    return "".join([before, begin, "\n", "\n".join(lines), "\n\n", end, after])


SIMULATED = ("world", "channel_monitor", "policy", "recorder", "visualizer", "mission_monitor")
BESIDE = ("bridge", "world", "channel_monitor", "policy", "recorder", "mission_monitor")


def contents() -> dict[Path, str]:
    """Every generated file, and its text."""
    figures = DOCS / "figures"
    return {
        figures / "nodes.svg": node_graph(SIMULATED, "Nodes and topics of a simulated mission"),
        figures / "nodes_autopilot.svg": node_graph(BESIDE, "Nodes and topics beside an autopilot"),
        figures / "layers.svg": layer_picture(),
        figures / "phases.svg": phase_picture(),
        DOCS / "topics.md": filled(DOCS / "topics.md", topic_table()),
        DOCS / "parameters.md": filled(DOCS / "parameters.md", parameter_tables()),
    }


def main() -> None:
    """Write all of them."""
    for path, words in contents().items():
        path.write_text(words, "utf-8")
        print(path)


if __name__ == "__main__":
    main()
