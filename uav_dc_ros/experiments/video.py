"""The verb `video`: a mission of a bag as a GIF, or as MP4 with the encoder of imageio-ffmpeg.

A frame shows the field after a step, as the environment draws it. Steps without a recorded status have none.
A long mission has every second step, or fewer.
"""

import argparse
import importlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from uav_dc_ros import cli, files, payloads
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core import world
from uav_dc_ros.core.arrays import Array
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.env.trajectory import Trajectory
from uav_dc_ros.errors import BagError, MessageError, UavDcError
from uav_dc_ros.messages import printable
from uav_dc_ros.recordings import step_reader
from uav_dc_ros.recordings.export.tables import check_new
from uav_dc_ros.recordings.recorded_step import RecordedStep, mission_name
from uav_dc_ros.recordings.step_reader import Steps

FROM_VIDEO = 'is not installed; expected it from: pip install "uav_dc_ros[video]"'
FRAMES_MAX = 600
LAST_S = 3.0  # for which the last frame stays
COLOURS = 256
# Neither the encoder's version nor the time: the same bag gives the same bytes.
EXACT = ["-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact", "-threads", "1"]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="folder of a bag, or one of its files")
    out = "new file, .gif, or .mp4 with the extra `video` (default: BAG.gif in the current folder)"
    add("--out", type=Path, metavar="FILE", help=out)
    add("--mission", type=cli.whole_number(0), metavar="N", help="its index (default: the bag's first)")
    add(
        "--flight",
        type=cli.whole_number(0),
        default=0,
        metavar="N",
        help="run in the bag (default: %(default)d)",
    )
    fps = cli.number(0.5, 50.0, "a number from 0.5 to 50")
    add("--fps", type=fps, default=8.0, metavar="X", help="steps a second (default: %(default)g)")
    width = cli.whole_number(160, 1440, "a whole number from 160 to 1440")
    add("--width", type=width, default=480, metavar="PX", help="of the picture (default: %(default)d)")
    add("--scenario", metavar="NAME|FILE", help="the world, for a bag without one")
    add("--namespace", metavar="NAME", help="of the mission, for a bag with several")


def run(options: argparse.Namespace) -> int:
    """Write the file; the exit status."""
    out: Path = options.out or Path(f"{options.bag.absolute().stem}.gif")
    check_new(out, ".gif", ".mp4")
    write = _write_gif if out.suffix == ".gif" else _write_mp4
    _module("PIL.Image", "Pillow", FROM_VIDEO)
    with BagReader(options.bag) as reader:
        namespace = step_reader.namespace(reader, options.namespace)
        scenario = step_reader.scenario(reader, namespace, options.scenario)
        steps = _mission(reader, namespace, scenario, options)
        stride = -(-len(steps) // FRAMES_MAX)
        name = mission_name(steps[-1].mission, steps[-1].flight)
    try:
        with files.replacing(out) as partial:
            write(partial, _frames(scenario, steps, stride, options.width), options.fps)
    except OSError as error:
        raise BagError(f"{out} cannot be written: {error.strerror or error}") from None
    n = len(range(0, len(steps), stride))
    size = out.stat().st_size / 1e6
    print(
        f"{out}: {name} of {printable(str(options.bag))}, {n} frames, {n / options.fps:.1f} s, {size:.2f} MB"
    )
    return 0


def _mission(
    reader: BagReader, namespace: str, scenario: Scenario, options: argparse.Namespace
) -> list[RecordedStep]:
    """The steps of a mission that can be drawn; raises BagError if there are none."""
    recorded = Steps(reader, namespace, scenario.step_ns)
    found: list[RecordedStep] = []
    wanted: int | None = options.mission
    for step in recorded:
        if step.flight != options.flight or step.status is None:
            continue
        wanted = step.mission if wanted is None else wanted
        if step.mission == wanted:
            found.append(step)
        elif found:
            break
    if found and any(step.users is not None for step in found):
        return found
    why = "; ".join(recorded.rejected.lines()) or "expected its users and status"
    name = mission_name(wanted or 0, options.flight)
    raise BagError(f"bag {reader.path}: nothing of {name} can be drawn; {why}")


def _frames(scenario: Scenario, steps: Iterable[RecordedStep], stride: int, width_px: int) -> Iterator[Any]:
    """A picture (Pillow) of every `stride`-th step, and of the last one."""
    image_module = _module("PIL.Image", "Pillow", FROM_VIDEO)
    render = _module("uav_dc_ros.env.render", "matplotlib", FROM_VIDEO)
    trajectory = Trajectory(scenario)
    recorded = list(steps)
    for number, (state, link) in enumerate(_states(scenario, recorded)):
        trajectory.add(state, link)
        # The last step is drawn, whatever the stride.
        if (len(recorded) - 1 - number) % stride == 0:
            image = image_module.fromarray(render.picture(trajectory))
            height_px = round(image.height * width_px / image.width / 2) * 2  # encoders need even numbers
            yield image.resize((width_px // 2 * 2, height_px), image_module.Resampling.LANCZOS)


def _states(
    scenario: Scenario, steps: Iterable[RecordedStep]
) -> Iterator[tuple[world.State, world.Link | None]]:
    """The world at each step; users and data that are not recorded are those of the step before."""
    draws = np.zeros(scenario.draws_shape)
    state = world.initial(scenario, draws)
    users_m, data_bits, collected = state.users_m, state.data_bits, state.collected
    for step in steps:
        assert step.status is not None, "only such steps are drawn"
        link: world.Link | None = None
        try:
            payloads.check(step.status, scenario)
            if step.users is not None:
                users_m = payloads.users_m(step.users, scenario)
            if step.rates is not None:
                data_bits, collected = payloads.collection(step.rates, scenario)
                if step.step:
                    link = _link(step.rates)
        except MessageError as error:
            raise BagError(f"{step.name}: {error}") from None
        cell = np.asarray(step.status.cell)
        changed = {"step": np.asarray(step.step), "cell": cell, "users_m": users_m}
        yield _replaced(state, **changed, data_bits=data_bits, collected=collected), link


def _link(rates: Any) -> world.Link:
    columns = {
        name: np.asarray(getattr(rates, name)) for name in ("sinr", "rate_bps", "served", "sum_rate_bps")
    }
    return world.Link(**columns)


def _replaced(state: world.State, **values: Array) -> world.State:
    return world.State(**{name: getattr(state, name) for name in state.__dataclass_fields__} | values)


def _write_gif(path: Path, frames: Iterator[Any], fps: float) -> None:
    """One palette for all frames: an unchanged pixel costs nothing."""
    image_module = _module("PIL.Image", "Pillow", FROM_VIDEO)
    images = list(frames)
    few = [images[0], images[len(images) // 2], images[-1]]
    strip = image_module.new("RGB", (few[0].width * len(few), few[0].height))
    for i, image in enumerate(few):
        strip.paste(image, (i * image.width, 0))
    palette = strip.quantize(COLOURS, dither=image_module.Dither.NONE)
    drawn = [image.quantize(palette=palette, dither=image_module.Dither.NONE) for image in images]
    durations = [round(1000 / fps)] * (len(drawn) - 1) + [round(LAST_S * 1000)]
    drawn[0].save(
        path, format="GIF", save_all=True, append_images=drawn[1:], duration=durations, loop=0, optimize=True
    )


def _write_mp4(path: Path, frames: Iterator[Any], fps: float) -> None:
    """H.264, which browsers and presentations play."""
    ffmpeg = _module("imageio_ffmpeg", "imageio-ffmpeg", FROM_VIDEO)
    encoder: Any = None
    try:
        for image in frames:
            if encoder is None:
                encoder = ffmpeg.write_frames(
                    str(path), image.size, fps=fps, codec="libx264", macro_block_size=2, quality=8,
                    output_params=[*EXACT, "-f", "mp4"],
                )  # fmt: skip
                encoder.send(None)
            encoder.send(np.asarray(image).tobytes())
        for _ in range(round(LAST_S * fps)):
            encoder.send(np.asarray(image).tobytes())
    except RuntimeError as error:
        raise BagError(f"{path.name} cannot be encoded: {str(error).splitlines()[0]}") from None
    finally:
        if encoder is not None:
            encoder.close()


def _module(name: str, package: str, help: str) -> Any:
    """A module that not every installation has; raises UavDcError without it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UavDcError(f"{package} {help}") from None
