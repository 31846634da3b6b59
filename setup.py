"""What pyproject.toml cannot say: where the data lies, and what colcon installs beside the Python package.

The folders `policies` and `msgs_json` stand at the top level of the repository, and inside the
package once it is installed.

pip reads pyproject.toml and builds a wheel of the Python package. colcon runs this file by its name, as
`setup.py install` or `setup.py develop`: then the package is what package.xml says, and gets what
`ros2 run` and `ros2 launch` look for. None of that goes into a wheel: commands called `world` or `policy`
have no place in a virtual environment's bin/.
"""

import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import Distribution, find_packages, setup

NAME = "uav_dc_ros"
# `colcon build --symlink-install` links the package: its data is found beside what the link leads to.
DATA_FOLDERS = () if "develop" in sys.argv else ("policies", "msgs_json")
# Tests hold it equal to the node table.
NODES = ("world", "bridge", "channel_monitor", "policy", "recorder", "visualizer", "live_view", "web_view")


class AmentDistribution(Distribution):
    """Does not read pyproject.toml.

    setuptools before 77, as on Ubuntu 24.04, refuses it; `colcon build --symlink-install` does not find it.
    """

    def parse_config_files(self, *_, **__):
        """Read nothing."""


def ament():
    """Arguments of `setup` for colcon."""
    manifest = ElementTree.parse("package.xml").getroot()
    share = Path(NAME, "share")
    folders = [folder for folder in share.iterdir() if folder.is_dir()]
    scripts = f"$base/lib/{NAME}"
    return {
        "distclass": AmentDistribution,
        "name": manifest.findtext("name"),
        "version": manifest.findtext("version"),
        "data_files": [
            ("share/ament_index/resource_index/packages", [f"{NAME}/resource/{NAME}"]),
            (f"share/{NAME}", ["package.xml"]),
            *((f"share/{NAME}/{f.name}", sorted(str(path) for path in f.iterdir())) for f in sorted(folders)),
        ],
        "entry_points": {
            "console_scripts": [
                f"run_all = {NAME}.run_all:main",
                *(f"{node} = {NAME}.nodes.executable:main" for node in (*NODES, "container")),
            ]
        },
        "options": {
            "install": {"install_scripts": scripts},
            "develop": {"script_dir": scripts},
            # The Python of the shell, not of colcon: an active virtual environment brings its packages.
            "build_scripts": {"executable": "/usr/bin/env python3"},
        },
    }


setup(
    packages=[
        *find_packages(include=[NAME, f"{NAME}.*"]),
        *(f"{NAME}.{folder}" for folder in DATA_FOLDERS),
    ],
    package_dir={f"{NAME}.{folder}": folder for folder in DATA_FOLDERS},
    package_data={
        NAME: ["py.typed", "resource/*", "share/*/*"],
        f"{NAME}.nodes.ros": ["*.xml"],
        f"{NAME}.nodes.view.web": ["*.html", "*.css", "*.js"],
        f"{NAME}.recordings.pages": ["*.html", "*.css", "*.js"],
        f"{NAME}.scenarios": ["*.toml"],
        f"{NAME}.policies": ["*/*"],
        f"{NAME}.msgs_json": ["*.json"],
    },
    **(ament() if Path(sys.argv[0]).name == "setup.py" else {}),
)
