"""`evaluate --fields`: many random fields, compared field by field."""

import json

import pytest

from uav_dc_ros import planners, scenarios
from uav_dc_ros.experiments.evaluate.cli import main
from uav_dc_ros.experiments.evaluate.rollout import roll_out

COMMAND = ["--policy", "tour", "nearest"]


def test_each_field_counts_once_and_policies_are_paired(tmp_path, capsys):
    path = tmp_path / "fields.json"
    with pytest.raises(SystemExit) as exit:
        main([*COMMAND, "--fields", "2", "--seeds", "3", "--objective", "0.7", "--json", str(path)])
    assert exit.value.code == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "over the random fields 0 to 1, 3 missions each, w = 0.7" in printed
    report = json.loads(path.read_bytes())
    expected = {name: [] for name in COMMAND[1:]}
    for seed in range(2):
        scenario = scenarios.load(f"random:{seed}")
        for name, values in expected.items():
            missions = roll_out(scenario, planners.PLANNERS[name](scenario, 0.7), range(3))
            values.append(missions.objective(scenario, 0.7).mean())
    for one in report["evaluations"]:
        own = expected[one["policy"]]
        assert one["objective"]["mean"] == pytest.approx(sum(own) / 2)
        assert (one["objective"]["min"], one["objective"]["max"]) == pytest.approx((min(own), max(own)))
        assert one["worst_fields"] == sorted(range(2), key=lambda i: own[i])
    (comparison,) = report["comparisons"]
    differences = [b - a for a, b in zip(expected["tour"], expected["nearest"], strict=True)]
    assert comparison["differences"]["objective"]["mean"] == pytest.approx(sum(differences) / 2)
    assert comparison["better"] == sum(one > 0 for one in differences)


@pytest.mark.parametrize(
    "more", [["--scenario", "farm"], ["--picture", "a.png"], ["--shift", "mission.max_steps=+1"]]
)
def test_one_field_s_options_are_refused(more, capsys):
    with pytest.raises(SystemExit) as exit:
        main([*COMMAND, "--fields", "2", *more])
    assert exit.value.code == 2
    assert capsys.readouterr().err.endswith(f"--fields 2 beside {more[0]}; expected one or the other\n")
