"""The multiverse: worlds, the runs that claims need, shares, deciding choices, the rule, the command."""

import dataclasses
import itertools
import math
import subprocess
import sys
import time

import msgspec
import numpy as np
import pytest

from tests.conftest import ROOT
from uav_dc_ros.core.scenario import parse
from uav_dc_ros.errors import TrainingError
from uav_dc_ros.experiments.paper import cli
from uav_dc_ros.experiments.paper.claims.contradictions import CONTRADICTIONS
from uav_dc_ros.experiments.paper.claims.findings import CLAIMS
from uav_dc_ros.experiments.paper.evidence import NotMeasured
from uav_dc_ros.experiments.paper.setting import HIDDEN, Setting
from uav_dc_ros.experiments.paper.shards import ShardResult, save_result, train_shard
from uav_dc_ros.experiments.paper.worlds import choose, draw, figure, page, plan, shares, verdicts
from uav_dc_ros.experiments.paper.worlds.choices import CHOICES, PLACES, Options, Span
from uav_dc_ros.experiments.paper.worlds.verdicts import IDS, VERDICTS, Multiverse, MultiverseMetadata, Row

N = 24


@pytest.fixture(scope="module")
def worlds():
    return draw.worlds(N)[0]


def multiverse(worlds, verdict):
    """A multiverse with made-up verdicts: `verdict(world, claim)`."""
    rows = [
        Row(
            world.number,
            claim,
            verdict(world, claim),
            claim not in plan.CUT,
            "a part",
            0.5,
            0.25,
            0.75,
            "r^t",
        )
        for world in worlds
        for claim in IDS
    ]
    metadata = MultiverseMetadata(scale=plan.FULL, rejected={"a reason": 2})
    return Multiverse(metadata=metadata, worlds=tuple(worlds), rows=tuple(rows))


# Worlds.


def test_worlds_are_always_the_same_and_more_of_them_begin_with_these(worlds):
    assert draw.worlds(5)[0] == worlds[:5]
    # Frozen: another Sobol sequence, range or order of the choices makes other worlds.
    assert [world.scenario("five_clusters").fingerprint for world in worlds[:2]] == FROZEN


FROZEN = ["6b7eaa601634", "dac5c7c377a4"]


def test_every_value_is_in_its_range_and_every_option_occurs(worlds):
    for choice in CHOICES:
        drawn = [getattr(world, choice.name) for world in worlds]
        if isinstance(choice.values, Options):
            assert set(drawn) == set(choice.values.values), choice.name
        else:
            low, high, log, _ = choice.values
            assert low <= min(drawn), choice.name
            assert max(drawn) <= high, choice.name
            middle = math.sqrt(low * high) if log else (low + high) / 2
            assert 0.3 < np.mean([value < middle for value in drawn]) < 0.7, choice.name


def test_both_settings_of_a_world_differ_in_their_layout_only(worlds):
    for world in worlds:
        five, three = (msgspec.to_builtins(world.scenario(name)) for name in plan.SCENARIOS)
        assert len(five["users"].pop("cluster_centres_m")) == 5
        assert len(three["users"].pop("cluster_centres_m")) == 3
        assert (five.pop("name"), three.pop("name")) == plan.SCENARIOS
        assert five == three


def test_clusters_do_not_touch_and_the_dock_is_far(worlds):
    for world in worlds:
        width_m = (world.cells - 1) * world.cell_m
        assert math.hypot(*world.dock_m) >= width_m / 2
        for centres_m in (world.five_clusters_m, world.three_clusters_m):
            apart_m = min(math.dist(a, b) for a, b in itertools.combinations(centres_m, 2))
            assert apart_m >= 2 * world.cluster_radius_m


def test_a_candidate_that_cannot_exist_is_replaced_by_the_next_point():
    found, rejected = draw.worlds(64)
    points = [world.point for world in found]
    assert [world.number for world in found] == list(range(64))
    assert points == sorted(set(points))
    assert sum(rejected.values()) == points[-1] + 1 - 64 > 0


def test_a_dock_out_of_reach_and_a_full_field_are_reasons():
    index = {choice.name: i for i, choice in enumerate(CHOICES)}
    u = [0.5] * (len(CHOICES) + sum(place.n for place in PLACES))
    u[index["time_per_tour"]] = 0.0
    # The dock in the far corner and the clusters in a column on the way: the tour is as long as the way.
    u[len(CHOICES) :] = [0.999, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5]
    assert draw._candidate(u, 0, 0) == "the dock is more than T_cons moves from the start"
    u[index["cells"]] = u[index["cell_m"]] = 0.0
    u[index["cluster_radius_m"]] = 0.999
    assert draw._candidate(u, 0, 0) == "no place is left for a cluster at least 2 C from the others"


def test_a_tour_is_the_shortest_of_all_orders():
    """East to 300 m past both on the axis, back to (200, 100), and on to the dock."""
    assert draw.tour_m([(300.0, 0.0), (100.0, 0.0), (200.0, 100.0)], (300.0, 300.0)) == 300 + 200 + 300


def test_data_is_of_order_one_in_every_reading(worlds):
    """The data term of a usual mission is the inverse of the drawn scale."""
    for world in worlds:
        scenario = world.scenario("five_clusters")
        per_step = draw._hover_bits(scenario)
        assert world.r_min_bits == pytest.approx(world.r_min_steps * per_step, rel=0.01)
        counted = per_step / 5 if world.data == "step" else max(world.r_min_bits, per_step)
        assert counted / world.data_scale_bits == pytest.approx(1 / world.data_scale, rel=0.02)


# Runs.


def test_the_plan_is_what_claims_read():
    assert plan.settings([CLAIMS[0]], plan.FULL) == [Setting()]
    assert len(plan.settings([CLAIMS[IDS.index("C20")]], plan.FULL)) == 4
    assert not {run.environment for run in plan.planned(plan.FULL)} & set(range(100)), "of the sweep"
    seeds = {}
    for run in plan.planned(plan.FULL):
        seeds.setdefault(run.setting, set()).add(run.environment)
    assert len(seeds.pop(Setting())) == 10
    assert {len(environments) for environments in seeds.values()} == {5}


def made_up(scale):
    """Results of every planned run without training: episodes and missions of random numbers."""
    rng = np.random.default_rng(0)
    planned = plan.planned(scale)
    from uav_dc_ros.experiments.evaluate.rollout import Missions
    from uav_dc_ros.experiments.train.episode_stats import CURVES

    shape = (scale.episodes, len(planned))
    missions = {field.name: rng.random((len(planned), 20)) for field in dataclasses.fields(Missions)}
    missions["landed"] = missions["landed"] > 0.5
    result = ShardResult(
        curves={name: rng.random(shape).astype(np.float32) for name in CURVES},
        greedy=Missions(**missions),
        parameters=[],
    )
    return {run: (result, i) for i, run in enumerate(planned)}


def test_every_claim_but_the_cut_ones_is_weighed_and_a_missing_run_is_noticed(worlds):
    found = made_up(plan.SMOKE)
    rows = verdicts.rows(worlds[0], plan.findings(worlds[0], plan.SMOKE, found))
    assert [row.claim for row in rows] == list(IDS)
    assert {row.claim for row in rows if not row.tested} == set(plan.CUT)
    for row in rows:
        assert row.verdict in VERDICTS
        assert math.isnan(row.estimate) == (not row.tested)
        assert row.tested or row.verdict == "undecided"
    del found[next(run for run in found if run.setting.scenario == "three_clusters")]
    with pytest.raises((KeyError, NotMeasured)):
        plan.findings(worlds[0], plan.SMOKE, found)


def test_runs_are_of_their_world(worlds):
    world = next(world for world in worlds if world.data == "step" and world.layers != HIDDEN)
    runs = plan.planned(plan.SMOKE)[:3]
    population = plan.population(world, "five_clusters", runs, plan.SMOKE)
    assert population.scenario == world.scenario("five_clusters")
    assert population.hidden == world.layers
    for run, planned in zip(population.runs, runs, strict=True):
        assert (run.reward.data, run.reward.data_scale_bits) == ("step", world.data_scale_bits)
        assert (run.reward.form, run.reward.r_plus) == (planned.setting.form, planned.setting.r_plus)
        learning = run.hyperparameters
        assert (learning.target_every, learning.buffer_size) == (world.target_every, world.buffer_size)
        assert (run.seed, run.environment) == (planned.environment, planned.environment)


# Verdicts.


def test_verdicts_are_read_as_they_were_written(worlds, tmp_path):
    made = multiverse(worlds, lambda world, claim: VERDICTS[(world.number + len(claim)) % 3])
    made.save(tmp_path)
    assert Multiverse.load(tmp_path) == made
    content = (tmp_path / verdicts.WORLDS_FILE).read_bytes()
    made.save(tmp_path)
    assert (tmp_path / verdicts.WORLDS_FILE).read_bytes() == content
    (tmp_path / verdicts.WORLDS_FILE).write_bytes(content[:-100])
    with pytest.raises(TrainingError, match=r"worlds\.parquet cannot be read"):
        Multiverse.load(tmp_path)


def test_screened_worlds_can_be_chosen_and_count_in_no_share(worlds, tmp_path):
    """The first half of the worlds was drawn; one of the others was found by C1."""

    def verdict(world, claim):
        return "holds" if world.number >= N // 2 and claim == "C1" else "undecided"

    found, screened = worlds[N // 2 + 3], worlds[N // 2 :]
    made = multiverse([*worlds[: N // 2], found], verdict)
    made = dataclasses.replace(
        made,
        metadata=msgspec.structs.replace(made.metadata, n_drawn=N // 2),
        screened=tuple(row for row in multiverse(screened, verdict).rows if row.claim == "C1"),
    )
    made.save(tmp_path)
    assert Multiverse.load(tmp_path) == made
    assert made.drawn.worlds == tuple(worlds[: N // 2])
    assert all(one.shares[0].share == 0.0 for one in shares.summaries(made.drawn))
    assert choose.choose(made) == found
    text = page.worlds_md(made)
    assert "12 worlds were drawn over all of them" in text
    assert "C1 alone was weighed in the next 12 worlds" in text
    assert f"World {found.number} is chosen" in text
    assert "--worlds 12 --screen 12\n" in text
    page.write(made, tmp_path)  # the figure is that of the drawn worlds
    (tmp_path / verdicts.SCREENED_FILE).unlink()
    with pytest.raises(TrainingError, match=r"screened\.parquet"):
        Multiverse.load(tmp_path)


def test_worlds_are_screened_whose_episode_ends_at_the_time_limit(worlds):
    found = plan.screening_worlds(4, 6)
    assert found == [world for world in worlds[4:] if world.episode_end == "at_time_limit"][:6]
    ((shard, runs),) = plan.make_screening_shards(found[0], plan.FULL, plan.wide(plan.FULL))
    assert {run.setting for run in runs} == {Setting(scenario="five_clusters")}
    assert [run.environment for run in runs] == list(range(100, 110))
    assert shard.population.n_episodes == plan.FULL.episodes


def test_verdicts_that_lack_a_claim_are_refused(worlds):
    made = multiverse(worlds, lambda world, claim: "holds")
    with pytest.raises(TrainingError, match="479 verdicts; expected one on each of 20 claims in each of 24"):
        dataclasses.replace(made, rows=made.rows[1:])


# Shares and deciding choices.


@pytest.mark.parametrize(("n", "low", "high"), [(0, 0, 0.2775), (5, 0.2366, 0.7634), (10, 0.7225, 1)])
def test_the_interval_of_a_share_is_wilson_s(n, low, high):
    """The ends are the published ones for 0, 5 and 10 of 10."""
    assert shares.share(n, 10)[2:] == pytest.approx((low, high), abs=1e-4)


def test_the_choice_that_decides_a_claim_is_found_and_no_other(worlds):
    made = multiverse(worlds, lambda world, claim: "holds" if world.data == "step" else "does not hold")
    of_c4 = shares.summaries(made)[IDS.index("C4")]
    assert [one.name for one in of_c4.deciders] == ["data"]
    assert of_c4.deciders[0].measure == pytest.approx(1.0)
    assert of_c4.deciders[0].shares == (("so_far", 0.0), ("step", 1.0))


def test_a_number_that_decides_is_found_in_its_classes(worlds):
    made = multiverse(worlds, lambda world, claim: "holds" if world.d_cons_m > 333 else "undecided")
    (best, *_) = shares.summaries(made)[0].deciders
    assert best.name == "d_cons_m"
    assert [share for _, share in best.shares] == pytest.approx([0.0, 0.0, 1.0], abs=0.15)


def test_equal_verdicts_are_decided_by_nothing(worlds):
    made = multiverse(worlds, lambda world, claim: "holds")
    assert {one.deciders for one in shares.summaries(made)} == {()}


def test_chance_is_named_as_rarely_as_stated():
    """Twelve columns that decide nothing: about one of twenty such claims names one."""
    rng = np.random.default_rng(1)
    named, means = 0, []
    for _ in range(20):
        columns = [rng.integers(0, 4, 64) for _ in range(12)]
        measures, null = shares.information(rng.choice(VERDICTS, 64), columns)
        named += max(measures) > null
        means += measures
    assert named <= 4
    assert abs(np.mean(means)) < 0.015, "adjusted for chance: four classes look like something otherwise"


# The rule of choice.


def test_the_rule_takes_most_claims_of_the_worlds_in_which_c1_holds(worlds):
    def verdict(world, claim):
        if world.number == 3:  # most claims, but not C1
            return "does not hold" if claim == "C1" else "holds"
        if world.number in (5, 7):
            return "holds" if claim in ("C1", "C4", "C9") else "undecided"
        return "holds" if world.number == 9 and claim in ("C1", "C2") else "does not hold"

    made = multiverse(worlds, verdict)
    nearer, farther = sorted((worlds[5], worlds[7]), key=choose.implausibility)
    assert choose.implausibility(nearer) < choose.implausibility(farther)
    assert list(choose.ranking(made)) == [nearer.number, farther.number, 9]
    assert choose.choose(made) == nearer
    # Equally plausible: the first.
    twins = [*worlds[:5], worlds[5], msgspec.structs.replace(worlds[5], number=6), *worlds[7:]]
    made = multiverse(twins, lambda world, claim: "holds" if world.number in (5, 6) else "undecided")
    assert choose.choose(made).number == 5


def test_without_c1_no_world_is_chosen(worlds):
    made = multiverse(worlds, lambda world, claim: "undecided" if claim == "C1" else "holds")
    assert choose.choose(made) is None
    assert "C1 holds in no world: none is chosen." in page.worlds_md(made)


def test_plausibility_counts_in_doublings(worlds):
    values = {"speed_mps": 16.0, "cell_m": 100.0, "altitude_min_m": 100.0, "cluster_radius_m": 100.0}
    world = msgspec.structs.replace(worlds[0], **values, tx_power_w=0.2, v_max_mps=1.4, max_steps=192)
    assert world.mission_s == 1200
    assert choose.implausibility(world) == pytest.approx(math.sqrt(1 / 6))


# The page and the figure.


def test_the_page_has_every_claim_choice_and_contradiction(worlds, tmp_path):
    made = multiverse(worlds, lambda world, claim: "holds" if world.data == "step" else "does not hold")
    page.write(made, tmp_path)
    text = (tmp_path / page.PAGE_FILE).read_text("utf-8")
    row = next(line for line in text.splitlines() if line.startswith("| C10 |"))
    assert "arithmetic, C11 |" in row
    assert "R in eq. 7 (1.00)" in row
    assert "54% [35%, 72%]" in row
    assert all(f"| {one.title} | {one.values} |" in text for one in (*CHOICES, *PLACES))
    assert "24 points" not in text
    assert "Of 26 points\n  2 were rejected (a reason: 2)" in text
    chosen = choose.choose(made)
    for name in plan.SCENARIOS:
        assert parse((tmp_path / f"chosen_{name}.toml").read_text("utf-8"), "test") == chosen.scenario(name)
    assert set(CONTRADICTIONS) <= set(IDS)
    png = (tmp_path / page.FIGURE_FILE).read_bytes()
    page.write(made, tmp_path)
    assert (tmp_path / page.FIGURE_FILE).read_bytes() == png


def test_the_kept_page_is_what_its_data_gives_in_the_worlds_as_they_are():
    kept = ROOT / "docs" / "paper"
    made = Multiverse.load(kept)
    assert made.metadata.scale == plan.FULL
    sequence = draw.worlds(1 + max(world.number for world in made.worlds))[0]
    assert list(made.drawn.worlds) == sequence[: len(made.drawn.worlds)]
    assert all(world == sequence[world.number] for world in made.worlds)
    assert (kept / page.PAGE_FILE).read_text("utf-8") == page.worlds_md(made)


def test_worlds_of_the_figure_are_sorted(worlds):
    made = multiverse(
        worlds, lambda world, claim: "holds" if int(claim[1:]) <= world.number % 7 else "undecided"
    )
    holds = (made.verdicts == "holds").sum(axis=1)
    assert list(holds[figure.order(made)]) == sorted(holds, reverse=True)


def test_verdict_colours_differ_in_lightness():
    """So the figure is readable in print, and for a reader who sees no colour at all."""
    from matplotlib.colors import to_rgb

    light = sorted(np.dot(to_rgb(colour), (0.2126, 0.7152, 0.0722)) for colour in figure.COLOURS.values())
    assert min(np.diff(light)) > 0.1


# The command.


def in_process(stop_after=None):
    """Trains shards here and now, as the workers do; stops after some of them."""

    def train(shards, folder, *_):
        for i, shard in enumerate(shards):
            if i == stop_after:
                raise KeyboardInterrupt
            save_result(folder, shard, train_shard(shard).to_bytes())

    return train


@pytest.mark.usefixtures("one_thread")
def test_an_interrupted_command_goes_on_and_gives_the_same_bytes(tmp_path, monkeypatch, capsys):
    scale = msgspec.structs.replace(plan.SMOKE, episodes=2)
    monkeypatch.setitem(plan.SCALES, "smoke", scale)
    # Two claims, one of each setting: fewer runs.
    monkeypatch.setattr(plan, "CUT", dict.fromkeys(set(IDS) - {"C1", "C2"}, "a test"))

    def command(out, stop_after=None):
        monkeypatch.setattr(cli, "train_locally", in_process(stop_after))
        with pytest.raises(SystemExit) as ended:
            cli.main(["--worlds", "1", "--screen", "1", "--scale", "smoke", "--out", str(out), "--resume"])
        return ended.value.code

    assert command(tmp_path / "whole") == 0
    assert command(tmp_path / "pieces", stop_after=1) == 130
    kept = sorted((tmp_path / "pieces" / "shards").glob("*.safetensors"))
    assert len(kept) == 1
    assert command(tmp_path / "pieces") == 0
    whole, pieces = (
        {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in ("whole", "pieces")
    )
    assert whole == pieces
    assert {page.PAGE_FILE, page.FIGURE_FILE, *verdicts.FILES} <= whole.keys()
    capsys.readouterr()
    with pytest.raises(SystemExit):
        cli.main(["--worlds", "2", "--scale", "smoke", "--out", str(tmp_path / "whole"), "--resume"])
    complaint = "has 1 worlds and 1 screened ones of the scale 'smoke' and is finished; expected 2 and 0 of"
    assert complaint in capsys.readouterr().err


@pytest.mark.long
def test_a_killed_command_goes_on_and_gives_the_same_bytes(tmp_path):
    """With real workers, and another number of them."""

    def command(out, *options):
        words = [sys.executable, "-m", "uav_dc_ros.paper", "--worlds", "2", "--scale", "smoke", *options]
        return [*words, "--out", str(tmp_path / out)]

    subprocess.run(command("whole", "--workers", "1"), check=True, timeout=300)
    killed = subprocess.Popen(command("killed", "--workers", "2"))
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("killed/shards/shard_*[0-9a-f].safetensors")):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    killed.kill()
    killed.wait()
    assert not (tmp_path / "killed" / verdicts.VERDICTS_FILE).exists()
    subprocess.run(command("killed", "--workers", "2", "--resume"), check=True, timeout=300)
    whole, killed_files = (
        {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in ("whole", "killed")
    )
    assert whole == killed_files


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--worlds", "0"], "'0'; expected a whole number of at least 1"),
        (["--worlds", "2", "--only", "lr"], "--worlds with --only or --block; expected neither"),
        (["--worlds", "2", "--block", "1"], "--worlds with --only or --block; expected neither"),
        (["--screen", "2"], "--screen without --worlds; expected both"),
        (["--worlds", "2", "--out", "."], ". exists; expected a new folder, or --resume"),
    ],
)
def test_a_mistake_is_one_line(options, complaint, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        cli.main(options)
    assert ended.value.code == 2
    error = capsys.readouterr().err.strip()
    assert complaint in error
    assert len(error.splitlines()) == 1


def test_numbers_are_spread_over_their_range():
    assert [Span(1, 4, whole=True).at(u) for u in (0.0, 0.25, 0.99)] == [1, 2, 4]
    assert Span(1, 100, log=True).at(0.5) == 10
    assert Options(("a", "a", "b", "c")).at(0.49) == "a"
    assert str(Options(("a", "a", "b", "c"))) == "a (2/4), b (1/4), c (1/4)"
