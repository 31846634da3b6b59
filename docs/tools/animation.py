"""Draws docs/mission.gif: one mission of a shipped policy, step by step.

    python docs/tools/animation.py

Needs the extra `train` (matplotlib, which brings Pillow). The mission with seed 0 is flown in numpy; the ROS
nodes fly the same cells and collect the same data, to the last bit.
"""

from pathlib import Path

import numpy as np
from PIL import Image

from uav_dc_ros.agents.agent import greedy_act
from uav_dc_ros.agents.policy import load
from uav_dc_ros.core.world import rollout_steps
from uav_dc_ros.env.render import picture
from uav_dc_ros.env.trajectory import Trajectory

OUT = Path(__file__).parents[1] / "mission.gif"
POLICY, SEED = "five_clusters_dueling", 0
WIDTH_PX, COLOURS, FRAME_MS, LAST_FRAME_MS = 460, 256, 110, 3000


def frames() -> list[Image.Image]:
    """A picture after each step, the start first."""
    policy = load(POLICY)
    scenario = policy.scenario
    track, images = Trajectory(scenario), []
    for state, outcome in rollout_steps(scenario, greedy_act(policy, scenario), [SEED]):
        track.add(*(alone(part) for part in (state, outcome and outcome.link)))
        image = Image.fromarray(picture(track))
        height_px = round(image.height * WIDTH_PX / image.width)
        images.append(image.resize((WIDTH_PX, height_px), Image.Resampling.LANCZOS))
    return images


def alone(batch):
    """The first of a batch of states or links, without its batch dimension."""
    if batch is None:
        return None
    return type(batch)(**{name: getattr(batch, name)[0] for name in batch.__dataclass_fields__})


def main() -> None:
    """Write the file."""
    images = frames()
    # One palette for all frames, so that an unchanged pixel costs nothing.
    few = images[:: len(images) // 4]
    strip = Image.new("RGB", (WIDTH_PX * len(few), few[0].height))
    for i, image in enumerate(few):
        strip.paste(image, (WIDTH_PX * i, 0))
    palette = strip.quantize(COLOURS, dither=Image.Dither.NONE)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    durations = [FRAME_MS] * (len(images) - 1) + [LAST_FRAME_MS]
    images[0].save(OUT, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True)
    print(f"{OUT}: {len(images)} frames, {OUT.stat().st_size / 1e3:.0f} kB, {np.sum(durations) / 1e3:.1f} s")


if __name__ == "__main__":
    main()
