"""Shards: one result, from a process here, from one that was killed on the way, from a Ray cluster."""

import logging
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import uav_dc_ros
from tests.support.worlds import tiny
from uav_dc_ros import __version__
from uav_dc_ros.agents.policy import Hyperparameters
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments import code_hash, processes
from uav_dc_ros.experiments.paper import shards, workers
from uav_dc_ros.experiments.paper.shards import Shard
from uav_dc_ros.experiments.paper.workers import train_locally
from uav_dc_ros.experiments.train.population import Population, Run

pytestmark = pytest.mark.usefixtures("one_thread")


def shard(seed, episodes=40, scenario=None):
    scenario = scenario or tiny()
    values = Hyperparameters(episodes=episodes, batch_size=8, buffer_size=200, target_every=20)
    runs = [
        Run(seed=seed + i, environment=i, algorithm=algorithm, reward=scenario.reward, hyperparameters=values)
        for i, algorithm in enumerate(("dqn", "dueling_dqn"))
    ]
    population = Population(scenario=scenario, observation="position", hidden=(8,), runs=tuple(runs))
    return Shard(population=population, greedy_seeds=(7, 3))


def nothing(name, n_flown):
    pass


def content(folder, one):
    return shards.result_file(folder, one).read_bytes()


@pytest.fixture(scope="module")
def expected():
    """Three shards, and what each is when it is trained in this process."""
    made = [shard(seed) for seed in (0, 10, 20)]
    return {one: shards.train_shard(one).to_bytes() for one in made}


@pytest.mark.long
def test_workers_bring_what_one_process_brings(tmp_path, expected):
    reports, two = [], list(expected)[:2]
    train_locally(two, tmp_path, 2, lambda name, n_flown: reports.append((name, n_flown)))
    assert all(content(tmp_path, one) == expected[one] for one in two)
    assert {name for name, n_flown in reports if n_flown == 40} == {one.name for one in two}
    assert not multiprocessing.active_children()
    assert sorted(os.listdir(tmp_path)) == sorted(shards.result_file(tmp_path, one).name for one in two)


@pytest.mark.long
def test_a_killed_worker_is_replaced(tmp_path, expected, monkeypatch):
    killed = []

    def kill(name, n_flown):
        if n_flown >= 5 and not killed:
            (child,) = multiprocessing.active_children()
            killed.append(child.pid)
            os.kill(child.pid, signal.SIGKILL)

    train_locally(list(expected)[:1], tmp_path, 1, kill)
    assert killed
    one = next(iter(expected))
    assert content(tmp_path, one) == expected[one]


def test_a_shard_resumes_from_its_checkpoint(tmp_path, expected, monkeypatch):
    """Interrupted three times, each time with the last episode not yet saved, it ends as if it never was."""
    one, result = next(iter(expected.items()))
    monkeypatch.setattr(shards, "_CHECKPOINT_EVERY_S", 0.0)
    checkpoint = shards.checkpoint_file(tmp_path, one)
    flown = []
    for stop in (3, 17, 30):

        def interrupt(n_flown, stop=stop):
            flown.append(n_flown)
            if n_flown == stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            shards.train_shard(one, checkpoint, interrupt)
    assert shards.train_shard(one, checkpoint).to_bytes() == result
    assert flown == [1, 2, 3, *range(3, 18), *range(17, 31)], "only the lost episode is flown twice"


@pytest.mark.long
def test_a_shard_whose_worker_always_dies_is_given_up(tmp_path, monkeypatch):
    one = shard(0)

    def kill(name, n_flown):
        for child in multiprocessing.active_children():
            os.kill(child.pid, signal.SIGKILL)

    with pytest.raises(TrainingError, match=rf"{one.name} died 3 times.*exit code -9.*--resume"):
        train_locally([one], tmp_path, 1, kill)
    assert not multiprocessing.active_children()
    assert processes._TRIES == 3


@pytest.mark.long  # an error ends the workers in the same way: see below
def test_ctrl_c_leaves_no_worker(tmp_path):
    def interrupt(name, n_flown):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_locally([shard(0), shard(1)], tmp_path, 1, interrupt)
    assert not multiprocessing.active_children()


def test_an_error_in_a_worker_is_reported(tmp_path):
    one = shard(0)
    shards.checkpoint_file(tmp_path, one).write_bytes(b"no checkpoint")
    with pytest.raises(TrainingError, match=f"{one.name} failed: .*cannot be read"):
        train_locally([one], tmp_path, 1, nothing)


def test_names_differ_with_the_content():
    assert shard(0).name == shard(0).name
    others = [shard(1), shard(0, episodes=41), shard(0, scenario=tiny(mission={"max_steps": 9}))]
    assert len({one.name for one in (shard(0), *others)}) == 4


def copy_of_package(tmp_path):
    package = Path(uav_dc_ros.__file__).parent
    shutil.copytree(package, tmp_path / "uav_dc_ros", ignore=shutil.ignore_patterns("__pycache__", "share"))
    assert code_hash.code_hash_of(tmp_path, shards.ROOTS) == shards.code_hash()
    return tmp_path / "uav_dc_ros"


def name_after_a_change(package, *files):
    for path in (package / f"{file}.py" for file in files):
        path.write_text(path.read_text("utf-8") + "# changed\n", "utf-8")
    return code_hash.code_hash_of(package.parent, shards.ROOTS)


def test_only_code_that_trains_changes_the_name(tmp_path):
    package = copy_of_package(tmp_path)
    others = ("nodes/world", "bags/read", "offboard/frames", "planners/__init__")
    found = {shards.code_hash(), name_after_a_change(package, *others, "experiments/paper/claims/reward")}
    assert len(found) == 1
    trains = ("core/world", "core/radio", "agents/dqn", "core/mobility", "experiments/train/training")
    for name in trains:
        found.add(name_after_a_change(package, name))
    assert len(found) == 1 + len(trains), "each of them"


def test_the_closure_has_what_training_really_imports():
    code = (
        "import sys, uav_dc_ros.experiments.paper.shards, uav_dc_ros.experiments.train.checkpoint\n"
        "import uav_dc_ros.experiments.train.training\n"
        "print(*[name for name in sys.modules if name.startswith('uav_dc_ros')])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    root = Path(uav_dc_ros.__file__).parent.parent
    real = {name for name in done.stdout.split() if code_hash.file_of(root, name).name != "__init__.py"}
    assert real <= code_hash.import_closure(root, shards.ROOTS)


@pytest.mark.parametrize("damage", [lambda b: b[:-40], lambda b: b"", lambda b: b[:8] + b"[" + b[9:]])
def test_a_damaged_result_is_named(tmp_path, expected, damage):
    one, result = next(iter(expected.items()))
    shards.result_file(tmp_path, one).write_bytes(damage(result))
    with pytest.raises(TrainingError, match=f"{one.name}.safetensors: cannot be read.*delete it"):
        shards.load_result(tmp_path, one)


@pytest.mark.long
def test_a_ray_cluster_that_loses_a_node_brings_the_same(tmp_path, expected):
    """A real cluster of two nodes on this machine; one is killed while it works."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    logging.getLogger("ray").setLevel(logging.ERROR)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        second = cluster.add_node(num_cpus=1)
        reports = []

        def kill(name, n_flown):
            reports.append(name)
            if len(reports) == 1:  # two shards are left, one on each node
                cluster.remove_node(second, allow_graceful=False)

        workers.train_on_ray(list(expected), tmp_path, cluster.address, kill)
    finally:
        cluster.shutdown()
    assert sorted(reports) == sorted(one.name for one in expected)
    assert all(content(tmp_path, one) == result for one, result in expected.items())


def test_an_address_without_a_cluster_is_one_line(tmp_path):
    pytest.importorskip("ray")
    with pytest.raises(TrainingError, match=r"^--ray 127.0.0.1:1: no cluster answers: Connection refused$"):
        workers.train_on_ray([shard(0)], tmp_path, "127.0.0.1:1", nothing)


def test_a_node_with_other_code_is_refused():
    with pytest.raises(TrainingError, match=f"has uav_dc_ros {__version__} with code .*; expected code 0123"):
        workers._work_on_node(shard(0), "0123")
