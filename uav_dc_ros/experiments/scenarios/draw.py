"""The verb `draw`: a picture or a page of a scenario."""

import argparse
import sys
from pathlib import Path

from uav_dc_ros import files, scenarios
from uav_dc_ros.errors import FROM_TRAIN, ParameterError

FORMATS = (".png", ".html")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("scenario", metavar="FILE|NAME|random:SEED")
    out = "a picture (.png) or a page (.html), which replaces an existing file"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=out)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Write the picture or page; the exit status."""
    out: Path = options.out
    if out.suffix.lower() not in FORMATS:
        raise ParameterError(f"--out {out}; expected a name that ends in {' or '.join(FORMATS)}")
    scenario = scenarios.load(options.scenario)
    files.check_writable(out)
    if out.suffix.lower() == ".html":
        from uav_dc_ros.experiments.scenarios import page

        files.write(out, page.content(scenario))
    else:
        try:
            from uav_dc_ros.experiments.scenarios import picture
        except ModuleNotFoundError as error:
            raise ParameterError(f"{error.name} {FROM_TRAIN}") from None
        picture.save(scenario, out)
    print(out, file=sys.stdout if files.is_replaced(out) else sys.stderr)
    return 0
