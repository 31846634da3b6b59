"""The documents: commands parse, links resolve, generated parts are current, and the site builds."""

import importlib.util
import itertools
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from ruamel.yaml import YAML

from tests.conftest import PATIENCE_S, ROOT
from tests.doc_commands import blocks, commands, parameter, parsed
from uav_dc_ros import bag, files, scenarios
from uav_dc_ros.core.energy import EnergySettings
from uav_dc_ros.core.scenario import Scenario
from uav_dc_ros.messages import Phase
from uav_dc_ros.nodes.framework import node_main
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.phases import TRANSITIONS
from uav_dc_ros.topics import TOPICS

DOCS, PACKAGE = ROOT / "docs", ROOT / "uav_dc_ros"
WRITTEN = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(
    DOCS.glob("*.md")
)
LINKED = [*WRITTEN, *sorted(DOCS.glob("paper/*.md"))]
COMMANDS = [(path.name, words) for path in WRITTEN for words in commands(path.read_text("utf-8"))]
# The glossary's worst: words that a reader has to interpret.
REFUSED = re.compile(
    r"\b(told|wish(es)?|utter(s|ed)?|heard|hearing|hears|nobody|somebody|whoever|falls? behind)\b",
    re.IGNORECASE,
)
# Programs of others, which are not run here.
OTHERS = {
    *(
        "docker",
        "pip",
        "python",
        "python3",
        "source",
        "sudo",
        "cd",
        "export",
        "touch",
        "rosdep",
        "ros2",
        "zensical",
    ),
    *(
        "sim_vehicle.py",
        "build/sitl/bin/arducopter",
        "make",
        "MicroXRCEAgent",
        "mavproxy.py",
        ".",
        ".venv/bin/pip",
    ),
    *(".venv/bin/python",),
}


def name(path: Path) -> str:
    """A document's name, as a test's."""
    return str(path.relative_to(ROOT))


def prose(path: Path) -> str:
    """A document without its code."""
    text = re.sub(r"^```.*?^```", "", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"`[^`\n]*`", "", text)


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub and the site make it."""
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text).strip())


def anchors(path: Path) -> set[str]:
    """Every anchor of a document."""
    text = re.sub(r"^```.*?^```", "", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    named = set(re.findall(r"<a (?:id|name)=\"([^\"]+)\"", text))
    return named | {slug(heading) for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE)}


@pytest.mark.parametrize("path", LINKED, ids=name)
def test_every_link_and_anchor_resolves(path: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(path)):
        if re.match(r"https?://", link):
            continue
        target, _, anchor = link.partition("#")
        file = (path.parent / target).resolve() if target else path
        assert file.exists(), link
        assert not anchor or anchor in anchors(file), link


@pytest.mark.parametrize(
    ("where", "words"), COMMANDS, ids=lambda value: value if isinstance(value, str) else ""
)
def test_every_command_parses(where: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    module = words[0]
    assert (ROOT / Path(*module.split("."))).with_suffix(".py").is_file(), where
    if module == "uav_dc_ros.nodes.container":
        assert set(words[1 : words.index("--ros-args")]) <= set(NODES)
    elif module.startswith("uav_dc_ros.nodes."):
        given = [value for flag, value in itertools.pairwise(words) if flag == "-p"]
        for assignment in given:
            parameter(module.removeprefix("uav_dc_ros.nodes."), assignment)
    else:
        parsed(monkeypatch, words)


def test_there_are_commands_of_every_kind() -> None:
    modules = {words[0].removeprefix("uav_dc_ros.") for _, words in COMMANDS}
    assert {"run_all", "train", "evaluate", "paper", "bag", "scenario", "nodes.world"} <= modules
    verbs = {words[1] for _, words in COMMANDS if words[0] == "uav_dc_ros.bag"}
    assert verbs == set(bag.VERBS)


@pytest.mark.parametrize("path", WRITTEN, ids=name)
def test_every_shell_block_is_a_shell_s(path: Path) -> None:
    for block in blocks(path.read_text("utf-8"), "sh"):
        done = subprocess.run(["bash", "-n"], input=block, text=True, capture_output=True, check=False)
        assert (done.returncode, done.stderr) == (0, ""), block
        for line in block.replace("\\\n", " ").splitlines():
            for command in line.partition("  #")[0].split(" && "):
                assert command.split()[0] in OTHERS, command


@pytest.mark.parametrize(
    "path", [path for path in WRITTEN if blocks(path.read_text("utf-8"), "python")], ids=name
)
def test_python_blocks_run(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for block in blocks(path.read_text("utf-8"), "python"):
        exec(compile(block, str(path), "exec"), {})
    if path.name == "README.md":
        assert capsys.readouterr().out.rstrip() in path.read_text("utf-8")


@pytest.mark.parametrize("path", WRITTEN, ids=name)
def test_words_are_the_field_s(path: Path) -> None:
    found = [(match[0], line) for line in prose(path).splitlines() if (match := REFUSED.search(line))]
    assert found == []


def helps() -> Iterator[tuple[str, list[str]]]:
    """Each command's module, and the arguments that show its help."""
    for module in ("run_all", "train", "evaluate", "optimum", "paper", "bag"):
        yield module, ["--help"]
    for verb in bag.VERBS:
        yield "bag", [verb, "--help"]
    for verb in ("list", "show", "new", "random", "import", "check", "draw"):
        yield "scenario", [verb, "--help"]


@pytest.mark.parametrize(("module", "arguments"), list(helps()), ids=str)
def test_words_of_help_are_the_field_s(
    module: str, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        importlib.import_module(f"uav_dc_ros.{module}").main(arguments)
    assert REFUSED.findall(capsys.readouterr().out) == []


@pytest.mark.parametrize("node", [row.name for row in NODES.values() if row.process])
def test_words_of_a_node_s_help_are_the_field_s(node: str) -> None:
    assert REFUSED.findall(node_main.parser(node, "").format_help()) == []


def test_generated_files_are_current() -> None:
    tool = diagrams()
    stale = [path.name for path, text in tool.contents().items() if path.read_text("utf-8") != text]
    assert stale == [], "run python docs/tools/diagrams.py"


def diagrams():  # type: ignore[no-untyped-def]
    """The script that writes them."""
    spec = importlib.util.spec_from_file_location("docs_diagrams", DOCS / "tools" / "diagrams.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_diagrams_show_every_row_of_the_tables() -> None:
    tool = diagrams()
    assert set(tool.CONTENT) == set(TOPICS)
    assert {row.name for row in NODES.values()} - {*tool.SIMULATED, *tool.BESIDE} == {
        "bag_record",
        "live_view",
        "web_view",
    }
    drawn = {(source, target) for source, target, _ in tool.transitions()}
    assert drawn == {(one.before.value, one.after.value) for one in TRANSITIONS}
    picture = (DOCS / "figures" / "phases.svg").read_text("utf-8")
    assert all(f">{phase.value}</text>" in picture for phase in Phase)
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    layers = pyproject["tool"]["importlinter"]["contracts"][0]["layers"]
    picture = (DOCS / "figures" / "layers.svg").read_text("utf-8")
    assert all(f">{module}</text>" in picture for layer in layers for module in re.findall(r"\w+", layer))


def test_every_key_in_the_symbol_table_is_a_scenario_s() -> None:
    scenario: Scenario = msgspec.structs.replace(
        scenarios.load("five_clusters_hover"), energy=EnergySettings(battery_j=1e5)
    )
    keys = re.findall(
        r"`((?:grid|users|mission|radio|reward|energy)\.\w+)`", (DOCS / "symbols.md").read_text("utf-8")
    )
    assert len(keys) >= 15
    for key in keys:
        section, attribute = key.split(".")
        assert hasattr(getattr(scenario, section), attribute), key


def test_every_shipped_policy_is_described() -> None:
    shipped = {path.parent.name for path in files.shipped_folder("policies").glob("*/config.json")}
    rows = re.findall(r"^\| `(\w+)` \| `\w+` \| ", (DOCS / "training.md").read_text("utf-8"), re.MULTILINE)
    assert shipped == set(rows)


def test_every_benchmark_that_is_named_exists() -> None:
    named = re.findall(r"benchmarks/(\w+\.py)", (DOCS / "performance.md").read_text("utf-8"))
    assert len(set(named)) >= 8
    assert all((ROOT / "benchmarks" / script).is_file() for script in named)


def test_every_page_is_in_the_navigation() -> None:
    config = YAML(typ="safe", pure=True).load((ROOT / "mkdocs.yml").read_text("utf-8"))

    def pages(entry: object) -> Iterator[str]:
        if isinstance(entry, str):
            yield entry
        for one in entry if isinstance(entry, list) else entry.values() if isinstance(entry, dict) else ():
            yield from pages(one)

    listed = sorted(pages(config["nav"]))
    assert listed == sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))
    assert config["theme"]["font"] is False, "fonts would come from another host"


@pytest.mark.skipif(importlib.util.find_spec("zensical") is None, reason="the extra docs is not installed")
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    shutil.copytree(DOCS, tmp_path / "docs")  # it follows no links to folders
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    (tmp_path / "uav_dc_ros").symlink_to(PACKAGE)
    command = [sys.executable, "-m", "zensical", "build", "--strict"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "No issues found" in said
    # Its strict mode lets warnings of the API reference pass.
    assert "griffe:" not in said
    assert "mkdocstrings:" not in said
    site = tmp_path / "site"
    api = (site / "api.html").read_text("utf-8")
    assert "Maximum 3D distance at which a user is served, metres" in api, "comments beside fields are shown"
    pages = list(site.rglob("*.html"))
    assert len(pages) >= 15
    fetched = r"<(?:script|img|iframe)[^>]+src=\"?https?:|<link[^>]+rel=\"?stylesheet[^>]+href=\"?https?:"
    assert [page.name for page in pages if re.search(fetched, page.read_text("utf-8"))] == []
