"""Pages about bags: what they hold is what was flown, however large, torn or hostile the bag."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from tests.conftest import read_bag
from tests.nodes.conftest import SMALL
from tests.recordings import report_bags
from tests.support.worlds import saved, tiny
from uav_dc_ros import bag, files, scenarios
from uav_dc_ros.core import world
from uav_dc_ros.core.energy import EnergySettings
from uav_dc_ros.env.gym_env import DataCollectionEnv
from uav_dc_ros.nodes.view import markers
from uav_dc_ros.recordings.pages import page as pages

HOSTILE = "</script><script>window.hacked=1</script><img src=x onerror=window.hacked=1>"
LIMIT = 3_000_000


def report(*arguments):
    """Exit status of the verb."""
    with pytest.raises(SystemExit) as ended:
        bag.main(["report", *map(str, arguments)])
    return ended.value.code


@pytest.fixture
def made(tmp_path):
    """A function: write a bag, make its page, unpack it."""

    def make(scenario, *options, **how):
        folder = report_bags.write(tmp_path / f"bag{len(list(tmp_path.iterdir()))}", scenario, **how)
        out = folder.with_suffix(".html")
        assert report(folder, "--out", out, *options) == 0
        assert out.stat().st_size < LIMIT
        return report_bags.unpacked(out)

    return make


def whats(data):
    return [(fault["source"], fault["what"]) for fault in data["data"]["health"]["faults"]]


def action(scenario, cell, after):
    """An action that moves the UAV from one cell to another."""
    return next(
        each for each in range(7) if scenario.grid.move(np.asarray(cell), np.asarray(each)).tolist() == after
    )


@pytest.mark.parametrize("reading", ["step", pytest.param("so_far", marks=pytest.mark.long)])
def test_the_page_of_missions_equals_the_summary_of_run_all(ros, reading):
    """And both the environment, by each reading of the reward. A file without one is of the data so far."""
    scenario_file = ros.folder / "small.toml"
    scenario_file.write_text(SMALL if reading == "so_far" else f'{SMALL}data = "{reading}"\n')
    scenario = scenarios.load(scenario_file)
    saved(ros.folder / "untrained", scenario, name="untrained")
    # Two seconds: long enough for every node to publish its diagnostics.
    flown = ("--scenario", "small.toml", "--policy", "untrained", "--pace", 300, "--missions", 2, "--compose")
    status, printed = ros.run_all(*flown, "--bag", "flown", "--summary", "summary.json")
    assert status == 0, printed
    status, output = ros.run("uav_dc_ros.bag", "report", "flown")
    assert status == 0, output
    assert re.fullmatch(r"flown\.html: 2 missions, \d\.\d\d MB\n", output)

    data = report_bags.unpacked(ros.folder / "flown.html")
    summaries = json.loads((ros.folder / "summary.json").read_text())
    assert len(data["data"]["missions"]) == len(summaries) == 2
    for summary, wanted in zip(data["data"]["missions"], summaries, strict=True):
        for key in ("seed", "outcome", "steps", "users_collected", "users_total"):
            assert summary[key] == wanted[key], key
        for key in ("data_bits", "sum_rate_bps", "distance_m", "reward"):
            assert summary[key] == pytest.approx(wanted[key], rel=1e-12), key
    assert data["data"]["policy"] == "untrained"
    env = DataCollectionEnv(scenario)
    cells = {(m["mission"], m["step"]): m["cell"] for _, m in read_bag(ros.folder / "flown", "/mission")}
    for seed, summary in enumerate(summaries):
        steps = data[f"mission-{seed}"]["steps"]
        assert [step["step"] for step in steps] == list(range(31))
        env.reset(seed=seed)
        totals = []
        for step in range(
            1, 31
        ):  # as it was flown: on a busy machine the vehicle hovers where no move came in time
            _, total, *_ = env.step(action(scenario, cells[seed, step - 1], cells[seed, step]))
            totals.append(total)  # the form is the episode's
        assert [step["reward"][2] for step in steps[1:]] == totals
        expected = totals[-1] if reading == "so_far" else np.mean(totals)
        assert summary["reward"] == pytest.approx(expected, rel=1e-12)
        assert summary["reward_data"] == reading
    status, verified = ros.run("uav_dc_ros.bag", "verify", "flown")
    assert status == 0, verified
    words = {"so_far": "r^t at the end", "step": "r^t, mean over the steps"}[reading]
    assert f"\nreward: {words}\n" in printed

    health = data["data"]["health"]
    latencies = {topic["name"]: topic for topic in health["topics"]}
    for topic, count in (("/users", 62), ("/rates", 62), ("/mission", 62), ("/move", 60), ("/pose", 62)):
        assert latencies[topic]["count"] >= count, topic  # a lockstep that stands still repeats its step
        assert 0 < latencies[topic]["p50_ms"] <= latencies[topic]["p99_ms"] <= latencies[topic]["max_ms"]
    chain = {row["name"]: row for row in health["chain"]}
    assert chain["users → rates"]["count"] == 62
    assert chain["users → move"]["p50_ms"] > chain["rates → move"]["p50_ms"] > 0
    assert {node["name"] for node in health["nodes"]} >= {"world", "channel_monitor", "policy", "recorder"}
    # On a busy machine steps start late, and a node reports it; nothing else may go wrong.
    assert all("step" in fault["what"] and fault["source"] == "world" for fault in health["faults"])

    text = (ros.folder / "flown.html").read_text("utf-8")
    assert "default-src 'none'" in text
    assert not re.search(r"""(src|href)\s*=|url\(|https?:|//\w+\.\w+/|@import""", text), "a network address"


@pytest.mark.parametrize("reading", ["so_far", "step"])
def test_users_and_rewards_are_those_of_the_core(made, reading):
    scenario = tiny(mission={"r_min_bits": 4e6, "d_cons_m": 150.0}, reward={"data": reading})
    data = made(scenario, seeds=(5,))
    course, table = data["mission-0"]["steps"], data["mission-0"]["table"]
    flown = list(report_bags.states(scenario, 5))
    collected_at = np.full(scenario.n_users, -1)
    for step, (state, link, _) in zip(course, flown, strict=True):
        collected_at[(collected_at < 0) & state.collected] = int(state.step)
        assert step["uav_m"] == scenario.grid.centre_m(state.cell, like=state.users_m).tolist()
        np.testing.assert_allclose(np.transpose(step["users_m"]), state.users_m, atol=0.051)
        np.testing.assert_allclose(step["data_bits"], state.data_bits, rtol=1e-3)
        wanted = np.where(state.collected, 2, np.where(link.served, 1, 0))
        assert [int(letter) for letter in step["state"]] == wanted.tolist()
        by_data, by_place, total = step["reward"]
        assert total == pytest.approx(by_data + by_place, rel=1e-12)
        counted = np.zeros(scenario.n_users)  # nothing is collected before the first move
        if state.step:
            counted = world.counted_data(scenario, link.served, link.rate_bps, state.data_bits)
            assert total == float(state.total_reward)
        assert total == pytest.approx(float(world.total_reward(scenario, state.cell, counted)))
    assert {letter for step in course for letter in step["state"]} == set("012"), "every state was seen"
    assert [at if at is not None else -1 for at in table["collected_at"]] == collected_at.tolist()
    served = np.asarray([link.served for _, link, _ in flown[1:]])
    rates = np.asarray([link.rate_bps for _, link, _ in flown[1:]])
    sinr = np.asarray([link.sinr for _, link, _ in flown[1:]])
    assert table["served_steps"] == served.sum(axis=0).tolist()
    for user in np.flatnonzero(served.any(axis=0)):
        mine = served[:, user]
        assert table["rate_bps"][user] == pytest.approx(rates[mine, user].mean())
        assert table["sinr_db"][user] == pytest.approx(10 * np.log10(sinr[mine, user].mean()), abs=0.01)


def test_faults_are_reported_and_a_good_bag_has_none(made):
    scenario = tiny()
    assert whats(made(scenario)) == []
    bad_text = ("/rates", "std_msgs/msg/String", b"\0\1\0\0\5\0\0\0nope\0")
    values = {"restarts": "0", "rates rejected: stale_step": "0"}
    extra = (
        bad_text,
        ("/diagnostics", "", report_bags.diagnostics("policy", 0, "active", values)),
        ("/diagnostics", "", report_bags.diagnostics("policy", 1, "late", {"restarts": "2"})),
        ("/diagnostics", "", report_bags.diagnostics("policy", 1, "late", {"restarts": "2"})),
        ("/diagnostics", "", b"\0\1\0\0garbage"),
    )
    lost = (("pose", 2), *((topic, 4) for topic in ("pose", "users", "rates", "mission", "move")))
    data = made(scenario, leave_out=lost, steps=6, extra=extra)
    assert sorted(whats(data)) == [
        ("diagnostics", "unreadable messages: 1"),
        ("mission 0", "its end is not in the bag, after step 6"),
        ("mission 0", "steps that are not in the bag: 1"),
        ("mission 0", "steps without pose: 1"),
        ("policy", "late; restarts: 2"),
        ("rates", "unreadable messages (malformed): 1: JSON is malformed: invalid character (byte 4)"),
    ]
    (node,) = data["data"]["health"]["nodes"]
    assert (node["warnings"], node["restarts"], node["reports"]) == (2, "2", 3)
    assert data["data"]["missions"][0]["outcome"] == "unfinished"


@pytest.mark.parametrize("reading", ["so_far", "step"])
def test_without_rates_the_data_so_far_is_the_last_known_and_that_of_the_step_unknown(made, reading):
    scenario = tiny(reward={"data": reading})
    data = made(scenario, leave_out=(("rates", 3),))
    totals = [float(state.total_reward) for state, _, _ in report_bags.states(scenario, 0)]
    found = [step["reward"][2] for step in data["mission-0"]["steps"]]
    assert found[4:] == totals[4:]
    summary = data["data"]["missions"][0]
    assert summary["reward_data"] == reading
    if reading == "so_far":
        assert found[3] is not None
        assert summary["reward"] == totals[-1]
    else:
        assert found[3] is None
        assert summary["reward"] == pytest.approx(np.mean(totals[1:3] + totals[4:]), rel=1e-12)


def test_latencies_are_those_of_the_recording(made):
    data = made(tiny())["data"]["health"]
    for row in data["topics"]:
        assert row["p50_ms"] == row["p99_ms"] == row["max_ms"] == report_bags.LATENCY_NS * 1e-6
        assert row["rate_hz"] == 100
        assert row["longest_gap_ms"] == 10


def test_a_long_mission_is_thinned_out_and_its_figures_are_not(made):
    scenario = tiny(mission={"max_steps": 1301}, grid={"n_x": 9, "n_y": 9})
    data = made(scenario)
    mission = data["mission-0"]
    steps = [step["step"] for step in mission["steps"]]
    assert mission["stride"] > 1
    assert len(steps) <= 402
    assert (steps[0], steps[1], steps[-1]) == (0, mission["stride"], 1301), "first and last are there"
    flown = list(report_bags.states(scenario, 0))
    cells = [scenario.grid.centre_m(state.cell, like=state.users_m) for state, _, _ in flown]
    distance_m = np.linalg.norm(np.diff(cells, axis=0), axis=1).sum()
    summary = data["data"]["missions"][0]
    assert summary["distance_m"] == pytest.approx(distance_m)
    sum_rate_bps = np.mean([link.sum_rate_bps for _, link, _ in flown[1:]])
    assert summary["sum_rate_bps"] == pytest.approx(sum_rate_bps)


def test_a_mission_of_many_users_fits(made):
    scenario = tiny(
        grid={"n_x": 30, "n_y": 30},
        users={"cluster_centres_m": [[100.0 * i, 1000.0] for i in range(20)], "users_per_cluster": 150},
        mission={"max_steps": 40, "dock_m": [2000.0, 2000.0]},
    )
    data = made(scenario)
    assert len(data["mission-0"]["table"]["user"]) == 2000
    assert data["mission-0"]["table"]["user"][-1] == scenario.n_users - 1


def test_as_many_missions_as_fit_and_the_others_on_request(tmp_path, capsys, monkeypatch):
    folder = report_bags.write(tmp_path / "bag", scenarios.load("five_clusters_hover"), seeds=tuple(range(8)))
    out = tmp_path / "page.html"
    monkeypatch.setattr(pages, "PAGE_MAX", 2_250_000)  # some of eight
    assert report(folder, "--out", out) == 0
    data, printed = report_bags.unpacked(out), capsys.readouterr().out
    shown = data["data"]["shown"]
    assert shown == list(range(len(shown)))
    assert 0 < len(shown) < 8
    assert out.stat().st_size <= 2_250_000
    assert set(data) == {"data", *(f"mission-{i}" for i in shown)}
    assert len(data["data"]["missions"]) == data["data"]["missions_total"] == 8
    assert f"{len(shown)} of 8 (as many as fit; --mission N shows others) missions" in printed
    assert report(folder, "--out", out, "--mission", 7) == 0
    assert [summary["mission"] for summary in report_bags.unpacked(out)["data"]["missions"]] == [7]


def test_equal_bags_make_equal_pages(tmp_path):
    scenario = tiny()
    written = []
    for place in ("a", "b"):
        folder = report_bags.write(tmp_path / place / "bag", scenario)
        assert report(folder, "--out", tmp_path / f"{place}.html") == 0
        written.append((tmp_path / f"{place}.html").read_bytes())
    assert written[0] == written[1]


def test_no_text_of_a_bag_becomes_markup(tmp_path):
    folder = report_bags.write(
        tmp_path / "<b>bag<i>",
        tiny(),
        about={"policy": HOSTILE, "pace": HOSTILE},
        extra=(("/diagnostics", "", report_bags.diagnostics(HOSTILE, 2, HOSTILE, {HOSTILE: HOSTILE})),),
    )
    out = tmp_path / "page.html"
    assert report(folder, "--out", out) == 0
    text = out.read_text("utf-8")
    assert "hacked" not in text
    assert "<b>bag" not in text
    assert "tiny: &lt;b&gt;bag&lt;i&gt;" in text
    assert report_bags.unpacked(out)["data"]["policy"] == HOSTILE


def test_a_comparison_pairs_equal_seeds(tmp_path, capsys):
    scenario = tiny(mission={"max_steps": 20})
    first = report_bags.write(tmp_path / "first", scenario, seeds=(1, 2, 3, 4))
    same = report_bags.write(tmp_path / "same", scenario, seeds=(4, 3, 2, 1), about={"policy": "p"})
    other = report_bags.write(tmp_path / "other", scenario, seeds=(7, 8))
    out = tmp_path / "page.html"
    assert report(first, "--compare", same, other, "--out", out) == 0
    assert "8 missions in 3 groups" not in capsys.readouterr().out
    groups = report_bags.unpacked(out)["data"]["groups"]
    assert [group["label"] for group in groups] == ["first", "same", "other"]
    assert [group["missions"] for group in groups] == [4, 4, 2]
    assert groups[1]["policy"] == "p"
    assert groups[1]["paired"]["seeds"] == 4
    for difference in groups[1]["paired"]["differences"].values():
        assert difference == {"mean": 0.0, "low": 0.0, "high": 0.0}
    assert groups[2]["paired"] is None, "no seed in common"
    ends = [list(report_bags.states(scenario, seed))[-1][0] for seed in (1, 2, 3, 4)]
    collected = [int(state.collected.sum()) for state in ends]
    interval = groups[0]["metrics"]["users_collected"]
    assert interval["mean"] == pytest.approx(np.mean(collected))
    assert interval["low"] <= interval["mean"] <= interval["high"]
    assert 0.0 <= groups[0]["metrics"]["landed"]["low"] <= groups[0]["metrics"]["landed"]["high"] <= 1.0
    curve = groups[0]["curves"]["n_collected"]
    assert len(curve["mean"]) == 21
    assert curve["mean"][-1] == pytest.approx(np.mean(collected), rel=1e-3)


def test_a_comparison_has_the_state_of_charge_where_there_is_a_battery(tmp_path):
    plain = tiny(mission={"max_steps": 12})
    battery = EnergySettings(battery_j=40e3)
    flown = [
        report_bags.write(tmp_path / name, world, seeds=(1, 2))
        for name, world in (("battery", replace(plain, energy=battery)), ("none", plain))
    ]
    out = tmp_path / "page.html"
    assert report(flown[0], "--compare", flown[1], "--out", out) == 0
    with_battery, without = report_bags.unpacked(out)["data"]["groups"]
    assert "state_of_charge" not in without["curves"]
    charge = with_battery["curves"]["state_of_charge"]["mean"]
    used_j = with_battery["metrics"]["energy_used_j"]["mean"]
    assert charge[0] == 1.0
    assert charge == sorted(charge, reverse=True)
    assert charge[-1] == pytest.approx(1.0 - used_j / battery.battery_j, rel=1e-3)


def test_missions_of_a_bag_side_by_side(tmp_path):
    folder = report_bags.write(tmp_path / "bag", tiny(), seeds=tuple(range(9)))
    out = tmp_path / "page.html"
    assert report(folder, "--compare", "--mission", 0, 3, 8, "--out", out) == 0
    groups = report_bags.unpacked(out)["data"]["groups"]
    assert [group["label"] for group in groups] == ["mission 0", "mission 3", "mission 8"]
    assert [group["seeds"] for group in groups] == ["0", "3", "8"]
    assert groups[0]["metrics"]["reward"]["low"] is None, "of one mission there is no interval"


def test_other_readings_of_the_reward_are_reported(tmp_path):
    bags = [
        report_bags.write(tmp_path / reading, tiny(reward={"data": reading}), seeds=(1, 2))
        for reading in ("step", "so_far")
    ]
    out = tmp_path / "page.html"
    for compared, words in (
        (bags, "r^t, mean over the steps or r^t at the end"),
        (bags[1:], "r^t at the end"),
    ):
        out.unlink(missing_ok=True)
        assert report(compared[0], "--compare", *compared[1:], "--out", out) == 0
        data = report_bags.unpacked(out)["data"]
        assert (data["reward_words"], data["rewards_differ"]) == (words, len(compared) > 1)


def test_other_worlds_are_reported_and_not_paired(tmp_path):
    first = report_bags.write(tmp_path / "first", tiny(), seeds=(1, 2))
    other = report_bags.write(tmp_path / "other", tiny(mission={"max_steps": 9}), seeds=(1, 2))
    out = tmp_path / "page.html"
    assert report(first, "--compare", other, "--out", out) == 0
    data = report_bags.unpacked(out)["data"]
    assert data["worlds_differ"]
    assert data["groups"][1]["paired"] is None


def test_bad_input_gets_one_line(tmp_path, capsys):
    good = report_bags.write(tmp_path / "good", tiny(), seeds=tuple(range(9)))
    precious = tmp_path / "precious.txt"
    precious.write_text("mine")
    cases = {
        (tmp_path / "none",): "no such folder",
        (good, "--mission", 99): "no step of a mission 99",
        (good, "--out", precious): "exists and is not a report",
        (good, "--out", tmp_path): "exists and is not a report",
        (good, "--out", tmp_path / "no" / "page.html"): "expected a file in an existing folder",
        (good, "--namespace", "other"): "no mission in namespace 'other'",
        (good, "--compare"): "more missions than a picture shows",
        (good, *["--compare", *[good] * 8]): "9 bags; expected at most 8",
    }
    for arguments, wanted in cases.items():
        out = () if "--out" in arguments else ("--out", tmp_path / "page.html")
        assert report(*arguments, *out) == 2, arguments
        error = capsys.readouterr().err
        assert wanted in error
        assert error.count("\n") == 1, error
    assert precious.read_text() == "mine"
    assert not (tmp_path / "page.html").exists()


def test_a_report_may_be_made_again(tmp_path):
    out = tmp_path / "page.html"
    for name in ("a", "b"):
        assert report(report_bags.write(tmp_path / name, tiny()), "--out", out) == 0
    assert report_bags.unpacked(out)["data"]["bag"] == "b"


def test_without_plotly_the_extra_is_named(tmp_path, capsys, monkeypatch):
    folder = report_bags.write(tmp_path / "bag", tiny())
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    assert report(folder, "--out", tmp_path / "page.html") == 2
    assert "pip install 'uav_dc_ros[report]'" in capsys.readouterr().err


def test_the_verb_needs_plotly_only_to_write(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "plotly", None)
    assert report("--help") == 0
    assert "--compare" in capsys.readouterr().out


def test_users_have_the_colours_of_the_view_in_rviz():
    style = (files.shipped_folder("recordings") / "pages" / "style.css").read_text("utf-8")
    found = dict(re.findall(r"--(\w+): #([0-9a-f]{6});", style.partition("@media")[0]))

    def rgb(name):
        return tuple(value / 255 for value in bytes.fromhex(found[name]))

    for state, colour in markers.USER_COLOURS.items():
        assert rgb(state.name.lower()) == colour[:3]
    assert rgb("dock") == markers.DOCK_COLOUR[:3]
    assert rgb("uav") == markers.UAV_COLOUR[:3]


@pytest.mark.long
def test_a_very_long_mission_is_read_in_bounded_memory(tmp_path):
    """Forty thousand steps take no more memory than two thousand: all of them would be 100 MB."""
    peaks_mb = []
    for steps in (2_000, 40_000):
        folder = report_bags.write(tmp_path / f"bag{steps}", tiny(mission={"max_steps": steps}))
        command = [sys.executable, "-m", "uav_dc_ros.bag", "report", folder, "--out", f"{folder}.html"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = status
        assert status == 0
        assert Path(f"{folder}.html").stat().st_size < LIMIT
        peaks_mb.append(used.ru_maxrss / 1024)
    print(f"peaks: {peaks_mb} MB")
    assert peaks_mb[1] < peaks_mb[0] + 40
