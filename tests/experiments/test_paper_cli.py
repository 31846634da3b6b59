"""`python -m uav_dc_ros.paper`: real processes, from nothing to figures and claims."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from uav_dc_ros.experiments.paper import cli
from uav_dc_ros.experiments.paper.plan import FIGURES
from uav_dc_ros.experiments.paper.results import METRICS, Results

COMMAND = [sys.executable, "-m", "uav_dc_ros.paper", "--scale", "smoke"]


def paper(*options, **how):
    return subprocess.run([*COMMAND, *map(str, options)], capture_output=True, text=True, timeout=300, **how)


def assert_equal(one, other):
    assert one.planned == other.planned
    for name in METRICS:
        np.testing.assert_array_equal(one.curves[name], other.curves[name], err_msg=name)
    for name, values in one.greedy.items():
        np.testing.assert_array_equal(values, other.greedy[name], err_msg=name)


SOME = ("Traj", "lr")  # greedy missions, and curves
ONLY = ("--only", *SOME)


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper") / "results"
    done = paper("--out", folder, "--workers", 1, *ONLY)
    assert done.returncode == 0, done.stderr
    assert str(folder / "claims.md") in done.stdout
    return folder


def test_smoke_makes_the_figures_of_only(smoke):
    check_made(smoke, SOME)


@pytest.mark.long
def test_smoke_makes_all_of_it(tmp_path):
    done = paper("--out", tmp_path / "all")
    assert done.returncode == 0, done.stderr
    check_made(tmp_path / "all", FIGURES)


def check_made(smoke, figures):
    names = {path.name for path in smoke.iterdir()}
    pictures = {name for name in names if name.endswith(".png")}
    assert pictures == {f"{figure}.png" for figure in figures}
    assert {"claims.md", "runs.parquet", "curves.parquet", "trajectories.safetensors"} <= names
    assert "shards" not in names, "what only a resumed sweep needs"
    assert all((smoke / name).stat().st_size > 10_000 for name in pictures)
    text = (smoke / "claims.md").read_text("utf-8")
    assert all(f"C{i}" in text for i in range(1, 21))


@pytest.mark.long
def test_the_same_seeds_give_the_same_curves(smoke, tmp_path):
    """Whatever the number of workers."""
    done = paper("--out", tmp_path / "again", "--workers", 2, *ONLY)
    assert done.returncode == 0, done.stderr
    assert_equal(Results.load(smoke), Results.load(tmp_path / "again"))


@pytest.mark.long
def test_the_same_command_writes_the_same_bytes(tmp_path):
    """Of a block for confirmation."""
    written = []
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        done = paper("--out", "results", "--block", 1, *ONLY, cwd=tmp_path / name)
        assert done.returncode == 0, done.stderr
        written.append({path.name: path.read_bytes() for path in (tmp_path / name / "results").iterdir()})
    assert written[0].keys() >= {"claims.md", "claims.json", "runs.parquet", "curves.parquet", "Traj.png"}
    assert written[0] == written[1]
    results = Results.load(tmp_path / "one" / "results")
    assert (results.metadata.scale.block, {run.seed for run in results.planned}) == (1, {10_000, 10_001})


def test_a_finished_sweep_is_drawn_again(smoke):
    (smoke / "lr.png").unlink()
    before = Results.load(smoke)
    done = paper("--out", smoke, "--only", "lr", "--resume")
    assert done.returncode == 0, done.stderr
    assert (smoke / "lr.png").is_file()
    assert_equal(before, Results.load(smoke))


@pytest.mark.long
def test_a_killed_sweep_goes_on_and_leaves_no_process(tmp_path):
    """Killed with shards of different lengths half done; the workers notice, and end."""
    options = ("--only", "lr", "batch", "reward3clusters", "--workers", 2)
    expected = paper("--out", tmp_path / "expected", *options)
    assert expected.returncode == 0, expected.stderr
    out = tmp_path / "killed"
    process = subprocess.Popen(
        [*COMMAND, "--out", str(out), *map(str, options)],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + 90
        while not list(out.glob("shards/*.safetensors")) and time.monotonic() < deadline:
            time.sleep(0.05)
        process.kill()
        process.wait()
        deadline = time.monotonic() + 90
        while _alive(process.pid) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not _alive(process.pid), "a worker lives on without the sweep"
    finally:
        if _alive(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
    assert not (out / "runs.parquet").exists()
    done = paper("--out", out, *options, "--resume")
    assert done.returncode == 0, done.stderr
    assert_equal(Results.load(tmp_path / "expected"), Results.load(out))


def _alive(group):
    """Whether a process of the group is left."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--only", "lrr"], "no figure 'lrr'; expected one of Traj, "),
        (["--out", "/proc/nowhere"], "/proc/nowhere cannot be made: "),
        (["--out", "."], ". exists; expected a new folder, or --resume"),
        (["--workers", "0"], "'0'; expected a whole number of at least 1"),
        (["--block", "100"], "argument --block: '100'; expected a block, 0 to 99"),
        (["--scale", "large"], "invalid choice: 'large'"),
        (["--ray", "127.0.0.1:1"], "--ray 127.0.0.1:1: no cluster answers: Connection refused"),
        (["--ray", "nonsense:port"], "expected HOST:PORT, ray://HOST:PORT or auto"),
        (["--ray", ""], "expected HOST:PORT, ray://HOST:PORT or auto"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, monkeypatch, capsys, options, complaint):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        cli.main(["--scale", "smoke", "--only", "lr", *options])
    assert ended.value.code == 2
    error = capsys.readouterr().err.strip()
    assert complaint in error
    assert error.startswith("python -m uav_dc_ros.paper: ")
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "paper_results").exists(), "nothing that would be in the way of the next command"


def test_half_a_sweep_is_resumed_with_its_own_options_only(tmp_path, monkeypatch, capsys):
    """Another --only would train other shards, and take these for done with."""
    monkeypatch.chdir(tmp_path)
    kept = tmp_path / "paper_results" / "shards" / "shard_0.safetensors"

    def interrupt(shards, folder, n_workers, on_progress):
        kept.write_bytes(b"")
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "train_locally", interrupt)
    with pytest.raises(SystemExit) as ended:
        cli.main(["--scale", "smoke", "--only", "lr", "batch"])
    assert ended.value.code == 130
    capsys.readouterr()
    with pytest.raises(SystemExit):
        cli.main(["--scale", "smoke", "--block", "1", "--only", "lr", "batch", "--resume"])
    assert 'is half of a sweep with {"scale":"smoke","block":0,' in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        cli.main(["--scale", "smoke", "--only", "lr", "--resume"])
    assert ended.value.code == 2
    assert (
        'is half of a sweep with {"scale":"smoke","block":0,"only":["batch","lr"]}' in capsys.readouterr().err
    )
    assert kept.is_file()


def test_results_of_other_runs_are_not_drawn_as_these(smoke, capsys):
    with pytest.raises(SystemExit):
        cli.main(["--scale", "full", "--only", "lr", "--out", str(smoke), "--resume"])
    error = capsys.readouterr().err
    assert "has the scale 'smoke', block 0, and is finished; expected 'full', block 0" in error
    with pytest.raises(SystemExit):
        cli.main(["--scale", "smoke", "--block", "1", "--only", "lr", "--out", str(smoke), "--resume"])
    assert "block 0, and is finished; expected 'smoke', block 1" in capsys.readouterr().err
