"""The sweep that is kept in docs/paper is of this package's worlds and plan, and its document of its data."""

from pathlib import Path

import msgspec
import pytest

from uav_dc_ros import scenarios
from uav_dc_ros.experiments.paper import report
from uav_dc_ros.experiments.paper.claims.findings import check
from uav_dc_ros.experiments.paper.plan import FIGURES, runs
from uav_dc_ros.experiments.paper.results import Results
from uav_dc_ros.experiments.paper.setting import FULL
from uav_dc_ros.experiments.paper.worlds.verdicts import Multiverse

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "docs" / "paper"


@pytest.fixture(scope="module")
def results():
    return Results.load(KEPT)


def test_it_is_the_whole_plan_in_the_worlds_as_they_are(results):
    scale = results.metadata.scale
    free = {"block": scale.block, "environments": scale.environments, "repeats": scale.repeats}
    assert scale == msgspec.structs.replace(FULL, **free)
    assert results.planned == tuple(runs(scale))
    for name, world in results.metadata.worlds.items():
        assert world.fingerprint == scenarios.load(name).fingerprint


def test_the_document_is_what_the_data_gives(results):
    findings = check(results)
    drawn = [name for name in FIGURES if (KEPT / f"{name}.png").is_file()]
    assert drawn == list(FIGURES)
    written = report.claims_md(results, findings, drawn, Multiverse.load(KEPT))
    assert (KEPT / report.CLAIMS_FILE).read_text("utf-8") == written
    assert "36% [25%, 48%]" in written, "the share of worlds"
    kept = msgspec.json.decode((KEPT / report.VERDICTS_FILE).read_bytes())
    assert {one["id"]: one["verdict"] for one in kept} == {one.claim.id: one.verdict for one in findings}


def test_the_readme_counts_the_verdicts_as_they_are(results):
    """`Of 20 claims ...` stands in both."""
    lines = (KEPT / report.CLAIMS_FILE).read_text("utf-8").splitlines()
    (counts,) = [line for line in lines if line.startswith("Of ")]
    assert counts.rstrip(".") in (ROOT / "README.md").read_text("utf-8").replace("\n", " ")
