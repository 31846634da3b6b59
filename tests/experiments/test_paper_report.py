"""The document of a sweep, made from made-up results."""

import dataclasses
import re

import msgspec
import pytest

from tests.experiments.paper_sweeps import WORLDS, of_the_data_of_the_step, realistic, sweep
from uav_dc_ros.experiments.paper.claims.findings import CLAIMS, check
from uav_dc_ros.experiments.paper.plan import FIGURES
from uav_dc_ros.experiments.paper.report import CLAIMS_FILE, VERDICTS_FILE, claims_md, write
from uav_dc_ros.experiments.paper.setting import FULL, SMOKE


@pytest.fixture(scope="module")
def text():
    results = realistic(FULL)
    return claims_md(results, check(results), list(FIGURES))


def test_it_says_where_it_comes_from(text):
    for fact in (
        "a test",
        f"{FULL.repeats} run(s)",
        "block 0, ",
        "environments 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, in each",
        f"{FULL.episodes} episodes",
        WORLDS["five_clusters"].fingerprint,
    ):
        assert fact in text


@pytest.mark.parametrize("data", ["so_far", "step"])
def test_it_names_the_reward_that_it_compares(data):
    results = realistic(SMOKE)
    results = of_the_data_of_the_step(results) if data == "step" else results
    text = claims_md(results, check(results), [])
    words, reading = {
        "so_far": ("r^t at the end", "`three_clusters` data so far, `five_clusters` data so far"),
        "step": (
            "r^t, mean over the steps",
            "`three_clusters` data of the step, `five_clusters` data of the step",
        ),
    }[data]
    assert f"- data in r^t (eq. 7): {reading}\n" in text
    titles = re.findall(r"^\*\*Reward .*\*\*$|(?<=\| )[^|]*\breward\b[^|]*(?= \|.*\n\|---)", text, re.M)
    assert len(titles) > 10
    assert all(words in title for title in titles), titles


@pytest.mark.long
def test_it_shows_what_changes_with_the_papers_five_environments(tmp_path):
    """C9 is true in the first five environments, and its opposite in the others by as much."""

    def between(setting, environment):
        return 0.1 * (setting.form == "episode") * (1 if environment < 5 else -1)

    results = sweep(scale=msgspec.structs.replace(SMOKE, environments=tuple(range(10))), between=between)
    write(results, [], tmp_path, only=["lr"])
    text = (tmp_path / CLAIMS_FILE).read_text("utf-8")
    assert re.search(r"^\| \[C9\].* \| \*\*undecided\*\* \| .* \| holds \|$", text, re.M)
    assert re.search(
        r"^In the first five environments alone, .* The verdicts on .*\bC9\b.* differ\.$", text, re.M
    )
    assert re.search(r"^\| episode above immediate; .* \| undecided \| 0\.\d.* share: holds \|$", text, re.M)
    five = check(results.in_first(5))
    assert all(one.of_five is None for one in five)
    kept = msgspec.json.decode((tmp_path / VERDICTS_FILE).read_bytes())
    assert [one["verdict_of_five"] for one in kept] == [one.verdict for one in five]
    (part,) = kept[8]["parts"]
    assert part["of_five"]["effect"] == five[8].criteria[0].effect._asdict()
    assert "with the paper's five" not in claims_md(results.in_first(5), five, [])


@pytest.mark.parametrize(("block", "words"), [(0, "had a part in choosing"), (1, "no choice has seen")])
def test_it_names_the_block(block, words):
    results = sweep(scale=SMOKE.in_block(block))
    assert re.search(rf"; block {block}, .* {words}", claims_md(results, check(results), []))


def test_every_claim_has_its_row_and_its_section(text):
    for claim in CLAIMS:
        assert re.search(
            rf"^\| \[{claim.id}\]\(#{claim.id.lower()}\) \| .* \| \*\*[a-z ]+\*\* \| .+ \|$", text, re.M
        )
        assert f"\n### {claim.id}\n" in text
        assert all(note in text for note in claim.notes)


def test_tables_have_as_many_cells_in_every_row(text):
    tables = re.findall(r"(?:^\|.*\n)+", text, re.M)
    assert len(tables) > 60
    for table in tables:
        assert len({row.count("|") for row in table.splitlines()}) == 1, table


def test_links_lead_somewhere(text):
    headings = {line.lstrip("# ").lower() for line in text.splitlines() if line.startswith("#")}
    links = re.findall(r"\]\(#([^)]+)\)", text)
    assert len(links) >= 40
    assert set(links) <= headings
    assert set(re.findall(r"\]\(([^#)]+\.png)\)", text)) == {f"{name}.png" for name in FIGURES}


def test_a_smoke_test_says_that_it_means_nothing(text):
    results = realistic(SMOKE)
    assert "mean nothing" in claims_md(results, check(results), []).split("##")[0].replace("\n", " ")
    assert "mean nothing" not in text


def test_the_verdicts_are_there_for_programs(tmp_path):
    results = sweep(scale=SMOKE)
    write(results, [], tmp_path, only=["lr"])
    assert {path.name for path in tmp_path.iterdir()} == {CLAIMS_FILE, VERDICTS_FILE, "lr.png"}
    found = msgspec.json.decode((tmp_path / VERDICTS_FILE).read_bytes())
    assert [one["id"] for one in found] == [claim.id for claim in CLAIMS]
    assert [one["verdict"] for one in found] == [one.verdict for one in check(results)]
    assert set(found[0]["parts"][0]["effect"]) == {"mean", "low", "high"}
    assert "lr.png" in (tmp_path / CLAIMS_FILE).read_text("utf-8")


def test_what_was_not_measured_is_not_judged():
    results = sweep(scale=SMOKE)
    kept = [i for i, run in enumerate(results.planned) if run.setting.scenario == "three_clusters"]
    some = dataclasses.replace(
        results,
        planned=tuple(results.planned[i] for i in kept),
        curves={name: values[kept] for name, values in results.curves.items()},
        greedy={name: values[kept] for name, values in results.greedy.items()},
    )
    written = claims_md(some, check(some), [])
    assert "16 were not tested." in written
    assert re.search(r"^\| \[C1\]\(#c1\) .* \| \*\*not tested\*\* \|  \|  \|$", written, re.M)
