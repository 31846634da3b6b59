"""What all commands share: mistakes are one line and status 2, whatever the output and the folder are."""

import json
import os
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT
from tests.recordings import report_bags
from uav_dc_ros import scenarios, uav_dc

COMMANDS = (
    ("run_all", "--help"),
    ("train", "--help"),
    ("evaluate", "--help"),
    ("optimum", "--help"),
    ("leaderboard", "--help"),
    ("paper", "--help"),
    ("bag", "--help"),
    ("bag", "info", "--help"),
    ("scenario", "--help"),
    ("uav_dc", "--help"),
    ("nodes.world", "--help"),
)
# A command that prints `argv[1]` lines, and returns 1: of `bag verify`, that something differs.
PRINTS = """
import sys
from uav_dc_ros import cli

def command():
    for i in range(int(sys.argv[1])):
        print("line", i)
    return 1

cli.run(command, "prog")
"""
# Commands in one process, one after another.
HELPS = """
import json, runpy, sys

for module, *arguments in json.loads(sys.argv[1]):
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(f"uav_dc_ros.{module}", run_name="__main__")
    except SystemExit as end:
        print("ended with", end.code)
"""


def run(*arguments: object, env: dict[str, str] | None = None, **options: Any) -> tuple[int, str, str]:
    """Runs Python; exit status, standard output, and standard error."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(ROOT), **(env or {})},
        stdin=subprocess.DEVNULL,
        text=True,
        errors="surrogateescape",
        check=False,
        **({"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options),
    )
    return done.returncode, done.stdout or "", done.stderr or ""


@pytest.mark.parametrize("verb", uav_dc.VERBS)
def test_both_forms_of_a_command_print_the_same_help(
    verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    outputs = []
    for name, given in (({"fly": "run_all"}.get(verb, verb), ()), ("uav_dc", (verb,))):
        monkeypatch.setattr(sys, "argv", [name, *given, "--help"])
        monkeypatch.delitem(sys.modules, f"uav_dc_ros.{name}", raising=False)  # as `python -m` finds it
        with pytest.raises(SystemExit) as end:
            runpy.run_module(f"uav_dc_ros.{name}", run_name="__main__")
        assert end.value.code == 0
        outputs.append(capsys.readouterr())
    assert outputs[0] == outputs[1]
    assert "usage: " in outputs[0].out


def test_scenarios_are_listed_shown_and_checked(tmp_path: Path) -> None:
    def uav_dc(*arguments: object) -> tuple[int, str, str]:
        return run("-m", "uav_dc_ros.uav_dc", "scenario", *arguments, cwd=tmp_path)

    status, out, _ = uav_dc("list")
    assert status == 0
    assert [line.partition(":")[0] for line in out.splitlines()] == scenarios.names()
    status, shown, _ = uav_dc("show", "three_clusters_hover")
    assert status == 0
    file = tmp_path / "own.toml"
    file.write_text(shown)
    status, out, _ = uav_dc("check", file)
    assert status == 0
    assert "30 users in 3 clusters" in out
    assert "three_clusters_hover_dueling" in out
    file.write_text(shown.replace("max_steps = ", "max_steps = -"))
    status, out, err = uav_dc("check", file)
    assert (status, out) == (2, "")
    line = 1 + shown.split("\n").index("max_steps = 45")
    assert err == f"{file}:{line}: mission.max_steps = -45; expected int >= 1\n"
    file.write_text(shown.replace("max_steps = ", "max_steps = -").replace("zeta", "seta"))
    status, out, err = uav_dc("check", file)
    assert (status, out, len(err.splitlines())) == (2, "", 2)


def test_an_unknown_verb_is_one_line(tmp_path: Path) -> None:
    status, _, err = run("-m", "uav_dc_ros.uav_dc", "fli", cwd=tmp_path)
    assert (status, err) == (2, f"uav-dc: 'fli'; expected a verb: {', '.join(uav_dc.VERBS)}\n")


def test_help_without_docstrings(tmp_path: Path) -> None:
    status, out, err = run("-c", HELPS, json.dumps(COMMANDS), env={"PYTHONOPTIMIZE": "2"}, cwd=tmp_path)
    assert (status, err) == (0, "")
    assert out.count("usage: ") == out.count("ended with 0") == len(COMMANDS)


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("lines", [1, 100_000])
def test_a_full_disk_is_no_result(lines: int, unbuffered: str) -> None:
    with open("/dev/full", "w") as full:
        status, _, err = run("-c", PRINTS, lines, stdout=full, env={"PYTHONUNBUFFERED": unbuffered})
    assert (status, err) == (2, "prog: the output cannot be written: No space left on device\n")


@pytest.mark.parametrize("command", [("run_all", "--help"), ("bag",)], ids=" ".join)
def test_help_on_a_full_disk(command: tuple[str, ...]) -> None:
    module, *arguments = command
    with open("/dev/full", "w") as full:
        env = {"PYTHONUNBUFFERED": ""}  # argparse itself ignores what a print without a buffer tells it
        status, _, err = run("-m", f"uav_dc_ros.{module}", *arguments, stdout=full, env=env)
    assert status == 2
    assert err == f"python -m uav_dc_ros.{module}: the output cannot be written: No space left on device\n"


@pytest.mark.parametrize("lines", [1, 100_000])
def test_a_reader_that_went_away_is_no_mistake(lines: int) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        assert run("-c", PRINTS, lines, stdout=writer) == (141, "", "")
    finally:
        os.close(writer)


def test_standard_error_on_a_full_disk_keeps_the_status() -> None:
    with open("/dev/full", "w") as full:
        assert run("-m", "uav_dc_ros.run_all", "--sead", stderr=full)[0] == 2
        assert run("-m", "uav_dc_ros.bag", "info", "nowhere", stderr=full)[0] == 2


def closing(*descriptors: int) -> Callable[[], None]:
    """To be called in a child before it starts its program."""

    def close() -> None:
        for descriptor in descriptors:
            os.close(descriptor)

    return close


def test_streams_that_are_closed_are_not_reused(tmp_path: Path) -> None:
    """Otherwise the next file that is opened, such as a bag, gets what others print."""
    program = (
        "import os, sys\nfrom uav_dc_ros import cli\n"
        "def command():\n"
        "    with open('x', 'w') as file:\n"
        "        print('printed', input, file=sys.stderr)\n"
        "        os.write(1, b'1'), os.write(2, b'2'), print('printed')\n"
        "    return 7\n"
        "cli.run(command, 'prog')"
    )
    assert run("-c", program, preexec_fn=closing(0, 1, 2), cwd=tmp_path)[0] == 7
    assert (tmp_path / "x").read_bytes() == b""


def test_a_working_directory_that_was_deleted_is_reported(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    program = (
        f"import os; os.chdir({str(gone)!r}); os.rmdir({str(gone)!r})\n"
        "from uav_dc_ros import bag; bag.main(['report', 'bag'])"
    )
    status, out, err = run("-c", program)
    assert (status, out) == (2, "")
    assert (
        err
        == "python -m uav_dc_ros.bag report: the working directory was deleted; expected one that exists\n"
    )


ASCII = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.parametrize("env", [ASCII, {}], ids=["ASCII", "UTF-8"])
def test_any_name_can_be_printed(tmp_path: Path, env: dict[str, str]) -> None:
    name = os.fsdecode(b"b\xc3\xa4g\xff")  # its last byte is no UTF-8
    status, out, err = run("-m", "uav_dc_ros.bag", "info", tmp_path / name, env=env)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert ("b\\udcc3\\udca4g\\udcff" if env else "bäg\\udcff") in err


@pytest.mark.parametrize("env", [ASCII, {}], ids=["ASCII", "UTF-8"])
def test_a_bag_may_have_any_name(tmp_path: Path, env: dict[str, str]) -> None:
    name = os.fsdecode(b"b\xc3\xa4g\xff")
    report_bags.write(tmp_path / name, scenarios.load("three_clusters_hover"), steps=3)
    for verb in (("info", "--json", "info.json"), ("verify",), ("report", "--out", "page.html")):
        status, _, err = run("-m", "uav_dc_ros.bag", verb[0], name, *verb[1:], env=env, cwd=tmp_path)
        assert (status, err) == (0, ""), verb
    path = json.loads((tmp_path / "info.json").read_bytes())["path"]
    assert path == ("b\\udcc3\\udca4g\\udcff" if env else "bäg\\udcff")
