"""The leaderboard in docs/leaderboard: its page is of its data, and its worst flights are explained."""

import re

import msgspec
import pytest

from tests import test_docs
from tests.conftest import ROOT
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.experiments.leaderboard import cli, page
from uav_dc_ros.experiments.leaderboard.standings import LeaderboardReport

KEPT = ROOT / "docs" / "leaderboard"


@pytest.fixture(scope="module")
def report():
    return msgspec.json.decode((KEPT / cli.REPORT_FILE).read_bytes(), type=LeaderboardReport)


def test_the_page_is_what_the_data_gives(report):
    assert (KEPT / page.PAGE_FILE).read_text("utf-8") == page.page(report)
    assert {path.name for path in KEPT.iterdir()} == {
        *(cli.REPORT_FILE, page.PAGE_FILE, page.FLIGHTS_PICTURE, page.WORST_PICTURE, "decision_times.md")
    }


def test_the_shipped_policies_are_those_that_flew(report):
    shipped = {name: policies.load(name).sha256 for name in policies.names()}
    assert shipped.items() <= report.contestants.items(), "fly again: docs/leaderboard.md has the command"


def test_each_of_the_worst_flights_is_explained(report):
    _, _, text = (ROOT / "docs" / "leaderboard.md").read_text("utf-8").partition("\n## The worst flights\n")
    explained = re.findall(r"`(random:\d+)`", text)
    assert {one.scenario for one in report.worst} <= set(explained)
    assert f"`{report.baseline}`" in text


@pytest.mark.parametrize("name", [page.PAGE_FILE, "decision_times.md"])
def test_its_links_resolve(name):
    test_docs.test_every_link_and_anchor_resolves(KEPT / name)


def test_words_of_help_are_the_field_s(capsys):
    test_docs.test_words_of_help_are_the_field_s("leaderboard", ["--help"], capsys)
