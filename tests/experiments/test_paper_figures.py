"""The paper's figures, drawn from made-up results."""

import dataclasses
from dataclasses import fields

import matplotlib.image
import numpy as np
import pytest
from matplotlib.axes import Axes

from tests.experiments.paper_sweeps import of_the_data_of_the_step, realistic
from uav_dc_ros import scenarios
from uav_dc_ros.core.world import rollout_steps
from uav_dc_ros.env.trajectory import Trajectory
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper.figures import draw, drawable
from uav_dc_ros.experiments.paper.plan import FIGURES, runs
from uav_dc_ros.experiments.paper.setting import FULL, SMOKE
from uav_dc_ros.planners import PLANNERS


@pytest.fixture(scope="module")
def results():
    return realistic(SMOKE)


@pytest.fixture(scope="module")
def tracks():
    scenario = scenarios.load("five_clusters")

    def first(batch):
        return type(batch)(**{f.name: getattr(batch, f.name)[0] for f in fields(batch)})

    made = []
    for seed in range(2):
        track = Trajectory(scenario)
        for state, outcome in rollout_steps(scenario, PLANNERS["tour"](scenario), [seed]):
            track.add(first(state), first(outcome.link) if outcome else None)
        made.append(track)
    return made


DRAWN = ("Traj", "reward5clusters", "throughput3clusters", "lr")


@pytest.mark.parametrize(
    "figure", [*DRAWN, *(pytest.param(n, marks=pytest.mark.long) for n in FIGURES if n not in DRAWN)]
)
def test_every_figure_is_drawn(results, tracks, figure, tmp_path):
    path = tmp_path / f"{figure}.png"
    draw(figure, results, tracks, path)
    image = matplotlib.image.imread(path)
    assert min(image.shape[:2]) > 600
    colours = np.rint(255 * image[..., :3]).astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    assert len(np.unique(colours)) > 50, "not a blank page"
    assert list(tmp_path.iterdir()) == [path], "no partial file is left"


@pytest.mark.parametrize("figure", ["reward5clusters", "reward5clusters3", "lr", "exp"])
def test_the_axis_names_the_reward(results, figure, tmp_path, monkeypatch):
    titles = []
    monkeypatch.setattr(Axes, "set_ylabel", lambda _, text, **how: titles.append(text))
    monkeypatch.setattr(Axes, "text", lambda _, x, y, text, **how: titles.append(text))
    for made, words in (
        (results, "$r^t$ at the end"),
        (of_the_data_of_the_step(results), "$r^t$, mean over"),
    ):
        titles.clear()
        draw(figure, made, [], tmp_path / "figure.png")
        assert any(text.startswith("reward") for text in titles)
        assert all(words in text for text in titles if text.startswith("reward"))


def test_the_full_sweep_is_drawn(tmp_path):
    draw("throughput3clusters", realistic(FULL), [], tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 50_000


def test_a_figure_shows_the_results(results, tmp_path):
    other = dataclasses.replace(
        results, curves=results.curves | {"reward": results.curves["reward"][:, ::-1]}
    )
    for name, made in (("one", results), ("two", other), ("again", results)):
        draw("lr", made, [], tmp_path / f"{name}.png")
    one, two, again = ((tmp_path / f"{name}.png").read_bytes() for name in ("one", "two", "again"))
    assert one == again
    assert one != two


def test_what_cannot_be_drawn(results, tmp_path):
    kept = [i for i, run in enumerate(results.planned) if run in set(runs(SMOKE, ["lr"]))]
    some = dataclasses.replace(
        results,
        planned=tuple(results.planned[i] for i in kept),
        curves={name: values[kept] for name, values in results.curves.items()},
        greedy={name: values[kept] for name, values in results.greedy.items()},
    )
    assert drawable(some) == ["Traj", "lr"], "the trajectory is of a setting that the learning rates have"
    assert drawable(results) == list(FIGURES)
    for figure, tracks, complaint in (
        ("batch", [], "figure batch: the results lack some of its runs"),
        ("Traj", [], "0 missions to draw; expected at least 1"),
        ("lrr", [], "no figure 'lrr'; expected one of Traj, "),
    ):
        with pytest.raises(TrainingError, match=complaint):
            draw(figure, some, tracks, tmp_path / "figure.png")
    with pytest.raises(TrainingError, match=r"figure\.png cannot be written: No such file or directory"):
        draw("lr", some, [], tmp_path / "nowhere" / "figure.png")
    assert list(tmp_path.iterdir()) == []
