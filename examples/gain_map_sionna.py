"""A gain map from the ray tracer Sionna RT, for `radio.model = "gain_map"`.

pip install sionna-rt && python examples/gain_map_sionna.py SCENARIO gains.npz --scene munich --origin 100 -50

SCENARIO gives the grid and the users; its channel is not used. Each cell's centre sends to a plane of squares
around the points on the ground: the channel is reciprocal. Sionna RT needs a GPU, or LLVM on a CPU.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from uav_dc_ros import load_scenario
from uav_dc_ros.core.propagation import gain_map


def main() -> None:
    """Trace the rays of every cell, and write the map."""
    parser = argparse.ArgumentParser(description="A gain map from the ray tracer Sionna RT.")
    add = parser.add_argument
    add("scenario", metavar="NAME|FILE", help="whose grid and users")
    add("out", type=Path, metavar="OUT", help="the gain map, .npz")
    add(
        "--scene",
        default="",
        help="name of a scene of sionna.rt.scene, or a Mitsuba XML file; default: empty",
    )
    add(
        "--origin",
        type=float,
        nargs=2,
        default=(0.0, 0.0),
        metavar=("X", "Y"),
        help="of the grid, in the scene",
    )
    add("--user-height", type=float, default=1.5, metavar="M", help="of the users' antennas above z = 0, m")
    add("--spacing", type=float, default=5.0, metavar="M", help="of the points on the ground, m")
    add("--carrier-hz", type=float, default=2e9, metavar="HZ")
    add("--samples", type=int, default=1_000_000, help="rays of each cell")
    add("--max-depth", type=int, default=3, help="reflections and refractions of a ray")
    add("--floor-db", type=float, default=-200.0, metavar="DB", help="gain where no ray arrives")
    options = parser.parse_args()
    try:
        from sionna import rt
    except ImportError as error:
        parser.exit(2, f"sionna-rt is missing ({error}): pip install sionna-rt\n")

    scenario = load_scenario(options.scenario)
    mission_s = scenario.mission.max_steps * scenario.mission.step_s
    west_m, south_m, east_m, north_m = scenario.users.area_m(scenario.grid, mission_s)
    x_m = west_m + options.spacing * np.arange(int(np.ceil((east_m - west_m) / options.spacing)) + 1)
    y_m = south_m + options.spacing * np.arange(int(np.ceil((north_m - south_m) / options.spacing)) + 1)
    shift_m = np.array([*options.origin, options.user_height])

    centre_m = shift_m + np.array([(x_m[0] + x_m[-1]) / 2, (y_m[0] + y_m[-1]) / 2, 0.0])

    scene = rt.load_scene(getattr(rt.scene, options.scene, options.scene) or None)
    scene.frequency = options.carrier_hz
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    solver, gain_db = rt.RadioMapSolver(), np.empty((*scenario.grid.shape, x_m.size, y_m.size))
    for cell in np.ndindex(*scenario.grid.shape):
        uav_m = scenario.grid.centre_m(np.array(cell), like=np.zeros(3)) + shift_m
        scene.add(rt.Transmitter("uav", position=uav_m.tolist()))
        traced = solver(
            scene,
            center=centre_m.tolist(),
            orientation=[0.0, 0.0, 0.0],
            size=[x_m.size * options.spacing, y_m.size * options.spacing],
            cell_size=[options.spacing, options.spacing],
            samples_per_tx=options.samples,
            max_depth=options.max_depth,
        )
        scene.remove("uav")
        points_m = np.asarray(traced.cell_centers.numpy())  # north, east, coordinate
        assert np.allclose(points_m[0, :, 0], x_m + shift_m[0], atol=0.01)
        assert np.allclose(points_m[:, 0, 1], y_m + shift_m[1], atol=0.01)
        gain = np.asarray(traced.path_gain.numpy(), np.float64)[0].T
        gain_db[cell] = 10.0 * np.log10(np.maximum(gain, 10.0 ** (options.floor_db / 10.0)))
        print(f"\rcell {cell}", end="", file=sys.stderr, flush=True)
    gain_map.save(options.out, scenario.grid, x_m, y_m, gain_db)
    print(f"\n{options.out}: {gain_db.size:,} gains, {gain_db.min():.1f} to {gain_db.max():.1f} dB")


if __name__ == "__main__":
    main()
