"""A wheel, installed elsewhere, brings everything that flying needs; and importing stays light."""

import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.conftest import copy_repository
from uav_dc_ros import scenarios

ROOT = Path(__file__).parent.parent
# One worker builds the wheel, once.
pytestmark = pytest.mark.xdist_group("packaging")

TOP_LEVEL = {
    ".ci",
    ".devcontainer",
    ".gitignore",
    "CHANGELOG.md",
    "CITATION.cff",
    "CONTRIBUTING.md",
    "LICENSE",
    "README.md",
    "benchmarks",
    "docs",
    "examples",
    "mkdocs.yml",
    "msgs_json",
    "package.xml",
    "policies",
    "pyproject.toml",
    "setup.py",
    "tests",
    "uav_dc_ros",
}
QUIET = os.environ | {"PIP_NO_INDEX": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}


def pip(*arguments):
    done = subprocess.run(
        [sys.executable, "-m", "pip", *map(str, arguments)],
        env=QUIET,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory, repository_files):
    """A wheel built from a copy of the repository, without what git ignores."""
    folder = tmp_path_factory.mktemp("wheel")
    copy_repository(repository_files, folder / "copy")
    pip("wheel", "--no-deps", "--no-build-isolation", "-w", folder, folder / "copy")
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The folder in which the wheel is installed, apart from the environment and its editable install."""
    target = tmp_path_factory.mktemp("site")
    pip("install", "--no-deps", "--target", target, wheel)
    return target


def run_installed(program, installed, cwd):
    """What `program` prints as JSON, run from `cwd` with the installed package first on the path."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(installed), "PYTHONSAFEPATH": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_top_level_of_the_repository(repository_files):
    assert {Path(name).parts[0] for name in repository_files} <= TOP_LEVEL


def test_the_wheel_holds_the_package_and_its_data_and_nothing_else(wheel, repository_files):
    wanted = {
        name if name.startswith("uav_dc_ros/") else f"uav_dc_ros/{name}"
        for name in repository_files
        if re.match(r"uav_dc_ros/|policies/|msgs_json/", name)
    }
    for kind in ("scenarios/three_clusters_hover.toml", "py.typed", "core/world.py"):
        assert f"uav_dc_ros/{kind}" in wanted
    with zipfile.ZipFile(wheel) as archive:
        about = {name.partition(".dist-info/")[2] for name in archive.namelist()} - {""}
        expected = {"METADATA", "RECORD", "WHEEL", "licenses/LICENSE", "top_level.txt", "entry_points.txt"}
        assert about == expected
        # The executables `world`, `policy` ... are for ROS only.
        (commands,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
        assert archive.read(commands).decode().split() == [
            *("[console_scripts]", "uav-dc", "=", "uav_dc_ros.uav_dc:main")
        ]
        found = {name for name in archive.namelist() if ".dist-info/" not in name}
        assert found == wanted
        for name in found:
            source = ROOT / name
            if not source.is_file():
                source = ROOT / name.removeprefix("uav_dc_ros/")
            assert archive.read(name) == source.read_bytes(), name


def test_what_flying_needs_brings_no_torch_and_no_ros(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        lines = archive.read(metadata).decode().splitlines()
    needs = [line.removeprefix("Requires-Dist: ") for line in lines if line.startswith("Requires-Dist: ")]
    base = {re.match(r"[\w.-]+", need)[0] for need in needs if "extra ==" not in need}
    assert "numpy" in base
    assert not {name for name in base if re.match(r"torch|gymnasium|matplotlib|ros-", name)}


def test_scenarios_policies_and_schemas_come_from_the_installed_place(installed, tmp_path):
    program = """
import json
import uav_dc_ros
from uav_dc_ros import files, scenarios
print(json.dumps({
    "package": uav_dc_ros.__file__,
    "scenarios": {name: scenarios.load(name).n_users for name in scenarios.names()},
    "policies": str(files.shipped_folder("policies")),
    "schemas": str(files.shipped_folder("msgs_json")),
}))
"""
    answer = run_installed(program, installed, tmp_path)
    package = installed / "uav_dc_ros"
    assert Path(answer["package"]) == package / "__init__.py"
    assert answer["scenarios"] == {name: scenarios.load(name).n_users for name in scenarios.names()}
    assert Path(answer["policies"]) == package / "policies"
    assert Path(answer["schemas"]) == package / "msgs_json"
    for folder in ("policies", "schemas"):
        here = Path(answer[folder])
        names = {path.name for path in here.iterdir() if path.name != "__pycache__"}
        assert names, folder
        assert names == {path.name for path in (ROOT / here.name).iterdir() if path.name != "__pycache__"}
    for policy in Path(answer["policies"]).iterdir():
        assert (policy / "model.safetensors").is_file(), policy.name
        assert (policy / "README.md").is_file(), policy.name


def test_the_installed_package_flies_from_an_empty_folder(installed, ros):
    ros.environment |= {"PYTHONPATH": str(installed), "PYTHONSAFEPATH": "1"}
    status, output = ros.run_all("--scenario", "three_clusters_hover", "--pace", "lockstep")
    assert status == 0, output
    assert "landed" in output
    assert "error" not in output.lower(), output
    (bag,) = (ros.folder / "bags").iterdir()
    assert (bag / "metadata.yaml").is_file()


def test_gymnasium_makes_the_installed_environment(installed, tmp_path):
    program = """
import json
import uav_dc_ros
import gymnasium
env = gymnasium.make("uav_dc_ros/DataCollection-v0", scenario="three_clusters_hover")
print(json.dumps([uav_dc_ros.__file__, int(env.reset(seed=1)[1]["step"])]))
"""
    assert run_installed(program, installed, tmp_path) == [str(installed / "uav_dc_ros" / "__init__.py"), 0]


def test_the_core_imports_nothing_heavy():
    program = """
import json, sys
import uav_dc_ros.core.world, uav_dc_ros.scenarios, uav_dc_ros.core.observations
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(json.loads(answer.stdout))
    assert "numpy" in loaded
    assert not loaded & {"torch", "rclpy", "std_msgs", "gymnasium", "matplotlib", "mcap", "rosbags"}


def normal(requirement):
    """A requirement's distribution, as package indexes spell it."""
    return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", requirement)[0]).lower()


def test_the_constraints_pin_everything_the_project_names():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    named = {normal(r) for r in project["dependencies"]} | {
        normal(r) for extra in project["optional-dependencies"].values() for r in extra
    }
    lines = (ROOT / "tests" / "constraints.txt").read_text("utf-8").splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", pin) for pin in pins)
    assert sorted(normal(pin) for pin in pins) == sorted(named - {"uav-dc-ros"})
