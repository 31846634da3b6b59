"""What decides a mission's moves, by name: policies and planners."""

import shutil

import pytest

from tests.support.worlds import saved, tiny
from uav_dc_ros.agents import agent as agents
from uav_dc_ros.agents import policy as policies
from uav_dc_ros.errors import PolicyError
from uav_dc_ros.planners import PLANNERS


def test_each_name_is_one_agent():
    assert not set(policies.names()) & set(PLANNERS)
    planner, policy = agents.load("search"), agents.load("three_clusters_dueling")
    assert (planner.argument, planner.sha256, planner.home, planner.policy) == ("search", None, None, None)
    assert planner.knows_positions
    assert planner.weighs
    assert (policy.home.name, policy.sha256) == ("three_clusters", policy.policy.sha256)
    assert not policy.knows_positions
    assert not policy.weighs
    assert agents.load(policy.argument).sha256 == policy.sha256
    assert not agents.load("tour").knows_positions
    with pytest.raises(PolicyError, match=r"policy 'serch': no such name or folder"):
        agents.load("serch")


def test_a_folder_with_a_planner_s_name_is_no_guess(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = saved(tmp_path / "tour", tiny())
    with pytest.raises(PolicyError, match=r"'tour' is a planner, and a policy's folder .* such as \./tour"):
        agents.load("tour")
    assert agents.load("./tour").policy is not None
    shutil.rmtree(folder)
    folder.mkdir()  # of something else
    assert agents.load("tour").policy is None
