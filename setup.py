"""Everything is in pyproject.toml; here is only what it cannot say.

The folders `policies` and `msgs_json` stand at the top level of the repository, and inside the
package once it is installed. (colcon asks for this file, too.)
"""

from setuptools import find_packages, setup

DATA_FOLDERS = ("policies", "msgs_json")

setup(
    packages=[
        *find_packages(include=["uav_dc_ros", "uav_dc_ros.*"]),
        *(f"uav_dc_ros.{f}" for f in DATA_FOLDERS),
    ],
    package_dir={f"uav_dc_ros.{folder}": folder for folder in DATA_FOLDERS},
    package_data={
        "uav_dc_ros": ["py.typed", "share/foxglove/*.json"],
        "uav_dc_ros.nodes": ["*.xml"],
        "uav_dc_ros.scenarios": ["*.toml"],
        "uav_dc_ros.policies": ["*/*"],
        "uav_dc_ros.msgs_json": ["*.json"],
    },
)
