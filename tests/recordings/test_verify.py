"""`bag verify`: a clean flight verifies to the last bit, and whatever is changed in it is found."""

import json
import os
import re
import shutil
import signal
import time

import msgspec
import numpy as np
import pytest

from tests.conftest import WITHOUT_VISUALIZER, Ros, finish, wait_for
from tests.core.test_gain_map import X_M, Y_M, free_space_db
from tests.core.test_gain_map import toml as mapped_toml
from tests.recordings.made import about, bag_message, changing, copy, flight, nudged, pose, write
from tests.support.worlds import saved, tiny
from uav_dc_ros import bag as command
from uav_dc_ros import cdr, files, messages, payloads, scenarios
from uav_dc_ros.bags.read import BagReader
from uav_dc_ros.core import world
from uav_dc_ros.core.propagation import gain_map
from uav_dc_ros.core.scenario import from_values
from uav_dc_ros.messages import Phase

TINY = tiny()
POLICY = "five_clusters_hover_dueling"


def verify(capsys, bag, *options):
    """Exit status and output of `bag verify`; of an error its line."""
    with pytest.raises(SystemExit) as exit:
        command.main(["verify", str(bag), *map(str, options)])
    out, err = capsys.readouterr()
    if exit.value.code == 2:
        assert not out
        assert len(err.splitlines()) == 1, err
        return 2, err
    assert not err
    return exit.value.code, out


@pytest.fixture(scope="module")
def flown(module_ros: Ros):
    """A bag of two missions that real nodes flew in lockstep."""
    bag = module_ros.folder / "bag"
    world = ("--scenario", "five_clusters_hover", "--policy", POLICY)
    given = ("--missions", 2, "--seed", 7, "--pace", "lockstep", "--bag", bag)
    status, output = module_ros.run_all(*world, *given, *WITHOUT_VISUALIZER)
    assert status == 0, output
    return bag


def payload(bag, topic, mission, step):
    """The first payload of a step on a topic."""
    with BagReader(bag) as reader:
        for message in reader.messages([f"/{topic}"]):
            found = messages.decode(cdr.decode_string(message.data), messages.PAYLOADS[topic])
            if (found.mission, found.step) == (mission, step):
                return found
    raise AssertionError(f"no {topic} of mission {mission}, step {step}")


def test_a_clean_flight_verifies_to_the_last_bit(flown, capsys):
    status, out = verify(capsys, flown, "--complete")
    assert status == 0
    assert out.splitlines()[1:] == [
        "channel: 122 of 122 steps recomputed, equal to the last bit",
        "world: 122 of 122 steps recomputed, equal to the last bit",
        "decisions: 120 of 120 steps recomputed, equal to the last bit",
        "users: age of information 252.1 s, fairness 0.981, last user collected at step 37.0 (means of 2 "
        "missions)",
        "verified",
    ]
    assert (
        "2 missions, 122 steps in scenario 'five_clusters_hover', policy 'five_clusters_hover_dueling' (sha"
        in out
    )


MOVED = {"left": "hover", "right": "hover", "hover": "left"}


def too_early(payload):
    """A user counts as collected before it is."""
    user = payload.collected.index(False)
    collected = [one or i == user for i, one in enumerate(payload.collected)]
    return msgspec.structs.replace(payload, collected=collected)


def higher(column, by=1):
    return lambda payload: msgspec.structs.replace(payload, **{column: getattr(payload, column) + by})


def upward(payload):
    east, north, up = payload.cell
    return msgspec.structs.replace(payload, cell=(east, north, (up + 1) % 5))


@pytest.mark.parametrize(
    ("topic", "column", "change", "expected"),
    [
        ("rates", "sinr", nudged("sinr", 13), "rates: mission 1, step 31, user 13, sinr"),
        ("rates", "rate_bps", nudged("rate_bps", 0), "rates: mission 1, step 31, user 0, rate_bps"),
        ("rates", "data_bits", nudged("data_bits", 9), "rates: mission 1, step 31, user 9, data_bits"),
        ("rates", "collected", too_early, "collected: recorded True, recomputed False"),
        ("rates", "sum_rate_bps", higher("sum_rate_bps", 1e-9), "rates: mission 1, step 31, sum_rate_bps"),
        ("users", "x_m", nudged("x_m", 41), "users: mission 1, step 31, user 41, x_m"),
        ("users", "stamp_ns", higher("stamp_ns", -1), "users: mission 1, step 31, stamp_ns"),
        (
            "mission",
            "remaining_steps",
            higher("remaining_steps"),
            "step 31, remaining_steps: recorded 30, re",
        ),
        ("mission", "cell", upward, "mission: mission 1, step 31, cell: recorded ["),
        ("mission", "seed", higher("seed"), "step 31, seed: recorded 9, recomputed 8"),
        (
            "mission",
            "phase",
            lambda payload: msgspec.structs.replace(payload, phase=Phase.LANDED),
            "phase: recorded 'landed', recomputed 'ready'",
        ),
        (
            "mission",
            "fingerprint",
            lambda payload: msgspec.structs.replace(payload, fingerprint="0" * 12),
            "fingerprint: recorded '000000000000'",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) and len(value) < 16 else "",
)
def test_one_value_changed_is_found(flown, tmp_path, capsys, topic, column, change, expected):
    bag = copy(flown, tmp_path / "bag", changing(topic, 1, 31, change))
    before, after = payload(flown, topic, 1, 31), payload(bag, topic, 1, 31)
    assert getattr(before, column) != getattr(after, column)
    status, out = verify(capsys, bag)
    assert status == 1
    assert expected in out
    assert out.splitlines()[-1] == "differs"
    values = [getattr(one, column) for one in (after, before)]
    if isinstance(values[0], list):
        values = next((a, b) for a, b in zip(*values, strict=True) if a != b)
    if column not in ("cell", "phase", "fingerprint"):
        assert f"recorded {values[0]!r}, recomputed {values[1]!r}" in out, "both values"


def test_a_pose_changed_in_its_last_bit_is_found(flown, tmp_path, capsys):
    time_ns = payload(flown, "users", 1, 31).stamp_ns
    cell = payload(flown, "mission", 1, 31).cell
    x_m, y_m, z_m = (100.0 * cell[0], 100.0 * cell[1], 100.0 + 50.0 * cell[2])
    true, false = pose((x_m, y_m, z_m), time_ns), pose((x_m, y_m, np.nextafter(z_m, 0.0)), time_ns)
    changed = []

    def change(message):
        if message.topic != "/pose" or message.data != true:
            return message
        changed.append(message)
        return message._replace(data=false)

    bag = copy(flown, tmp_path / "bag", change)
    assert changed
    status, out = verify(capsys, bag)
    assert status == 1
    assert f"pose: mission 1, step 31, z_m: recorded {np.nextafter(z_m, 0.0)}, recomputed {z_m}" in out
    assert "channel: 122 of 122 steps recomputed, 1 differ" in out


def test_a_move_changed_is_found_by_the_decision_and_by_the_way_flown(flown, tmp_path, capsys):
    true = payload(flown, "move", 1, 31).action
    other = "hover" if true != "hover" else "left"
    change = changing("move", 1, 31, lambda move: msgspec.structs.replace(move, action=other))
    status, out = verify(capsys, copy(flown, tmp_path / "bag", change))
    assert status == 1
    assert f"move: mission 1, step 31, action: recorded '{other}', recomputed '{true}'" in out
    assert "decisions: 120 of 120 steps recomputed, 1 differ" in out
    cells = [payload(flown, "mission", 1, step).cell for step in (31, 32)]
    assert ("mission: mission 1, step 32, cell: recorded" in out) == (
        cells[0] != cells[1] or other != "hover"
    )


def test_a_user_collected_early_is_one_difference_and_what_follows_stands_on_what_is_recorded(
    flown, tmp_path, capsys
):
    """The next step was served as before: with the changed flag it would not have been."""
    status, out = verify(capsys, copy(flown, tmp_path / "bag", changing("rates", 1, 31, too_early)))
    assert status == 1
    assert "first:\n  rates: mission 1, step 31, user" in out


def test_a_differing_repetition_is_found(flown, tmp_path, capsys):
    other = bag_message("rates", nudged("data_bits", 2)(payload(flown, "rates", 1, 31)), 0)
    recorded = []
    with BagReader(flown) as reader:
        for message in reader.messages():
            recorded.append(message)
            if changing("rates", 1, 31, lambda _: None)(message) is None:
                recorded.append(message._replace(data=other.data, log_time_ns=message.log_time_ns + 1))
        bag = write(tmp_path / "bag", recorded, reader.about)
    status, out = verify(capsys, bag)
    assert status == 1
    assert "rates: mission 1, step 31, data_bits[2], repeated: recorded" in out


@pytest.mark.parametrize(
    ("topic", "channel", "decisions", "reason"),
    [
        ("rates", 121, 119, "1 not recomputed: no rates recorded"),
        ("users", 121, 120, "1 not recomputed: no users of this scenario recorded"),
        ("move", 122, 119, "1 not recomputed: the move before it is not recorded"),
        ("mission", 122, 119, "1 not recomputed: the cell before it is not recorded"),
    ],
)
def test_what_is_missing_is_counted_and_the_rest_goes_on(
    flown, tmp_path, capsys, topic, channel, decisions, reason
):
    bag = copy(flown, tmp_path / "bag", changing(topic, 1, 31, lambda _: None))
    status, out = verify(capsys, bag)
    assert status == 0
    assert f"channel: {channel} of 122 steps recomputed, equal to the last bit" in out
    assert f"decisions: {decisions} of" in out
    assert reason in out
    assert out.splitlines()[-1] == "verified in part"
    assert verify(capsys, bag, "--complete")[0] == 1


def test_a_lost_pose_leaves_its_step_out_only(flown, tmp_path, capsys):
    time_ns = payload(flown, "users", 1, 31).stamp_ns
    stamp = pose((0, 0, 0), time_ns)[4:12]
    bag = copy(flown, tmp_path / "bag", lambda m: None if m.topic == "/pose" and stamp in m.data else m)
    status, out = verify(capsys, bag)
    assert status == 0
    assert "channel: 121 of 122 steps recomputed, equal to the last bit" in out
    assert "1 not recomputed: no pose recorded" in out


def test_another_policy(flown, capsys):
    status, out = verify(capsys, flown, "--policy", "five_clusters_hover_position")
    assert status == 0
    found = [line for line in out.splitlines() if "Q " in line]
    assert len(found) == 5
    assert "mission 0, step" in found[0]
    assert ", recorded " in found[0]
    n = [int(line.split(": ")[1].split()[0]) for line in out.splitlines() if line.endswith("of 60 moves")]
    assert len(n) == 2
    assert f"'five_clusters_hover_position' decides differently in {sum(n)} of 120 steps" in out
    status, out = verify(capsys, flown, "--policy", POLICY)
    assert status == 0
    assert "decides differently in 0 of 120 steps" in out
    status, err = verify(capsys, flown, "--policy", "three_clusters_hover_dueling")
    assert (status, "does not fit scenario 'five_clusters_hover'" in err) == (2, True)


def test_a_missing_policy_is_reported_and_found_by_its_hash(flown, tmp_path, capsys):
    with BagReader(flown) as reader:
        recorded, metadata = list(reader.messages()), reader.about
    bag = write(tmp_path / "elsewhere", recorded, metadata | {"policy": "mine"})
    assert verify(capsys, bag)[0] == 0, "a shipped policy is known by its hash, whatever its name"
    bag = write(tmp_path / "other", recorded, metadata | {"policy_sha256": "ab" * 32})
    status, out = verify(capsys, bag)
    assert status == 0
    assert f"decisions: not verified: policy '{POLICY}' (sha256 abababababab) is missing" in out
    assert (
        f"'{POLICY}' is another one (sha256 {metadata['policy_sha256'][:12]}); expected it from --po" in out
    )
    assert out.splitlines()[-1] == "verified in part"
    assert verify(capsys, bag, "--complete")[0] == 1
    status, err = verify(capsys, bag, "--policy-dir", tmp_path / "nowhere")
    assert (status, "no such folder" in err) == (2, True)


@pytest.mark.parametrize("inside", [False, True])
def test_a_policy_of_ones_own(tmp_path, capsys, inside):
    """In a folder of policies, or as a folder; a neighbour that is no policy has no effect."""
    from uav_dc_ros.agents import policy as policies

    folder = saved(tmp_path / "mine" / "p", TINY, name="own")
    (tmp_path / "mine" / "broken").mkdir()
    (tmp_path / "mine" / "broken" / policies.CONFIG).write_text("{")
    own = policies.load(folder)
    metadata = about(TINY, policy="own", policy_sha256=own.sha256)
    bag = write(tmp_path / "bag", flight(TINY, missions=2), metadata)
    status, out = verify(capsys, bag, "--policy-dir", folder if inside else folder.parent)
    assert "decisions: 16 of 16 steps recomputed" in out
    assert status == 1, "its moves were made up"
    status, out = verify(capsys, bag)
    assert "decisions: not verified: policy 'own'" in out
    assert status == 0


def test_shipped_policies_are_found_by_hash_wherever_the_bag_was_flown(flown, capsys, monkeypatch, tmp_path):
    shutil.copytree(files.shipped_folder("policies") / POLICY, tmp_path / "renamed")
    monkeypatch.setattr(files, "shipped_folder", lambda name: tmp_path / "none")
    assert "not verified" in verify(capsys, flown)[1]
    assert verify(capsys, flown, "--policy-dir", tmp_path)[1].endswith("\nverified\n")


def test_tolerance_lets_the_last_bit_pass_and_counts_it(flown, tmp_path, capsys):
    bag = copy(flown, tmp_path / "bag", changing("rates", 1, 31, nudged("rate_bps", 3)))
    status, out = verify(capsys, bag, "--tolerance", "1e-12")
    assert status == 0
    assert "1 values are equal within the tolerance only" in out
    assert verify(capsys, bag, "--tolerance", "1e-17")[0] == 1
    assert verify(capsys, bag, "--tolerance", "1")[0] == 2


@pytest.mark.parametrize("topic", ["pose", "users", "rates", "mission"])
def test_a_bag_without_a_topic_is_refused(tmp_path, capsys, topic):
    recorded = [message for message in flight(TINY) if message.topic != f"/{topic}"]
    status, err = verify(capsys, write(tmp_path / "bag", recorded, about(TINY)))
    assert status == 2
    if topic != "mission":
        assert f"holds nothing on /{topic}; expected pose, users, rates, mission" in err


def test_a_bag_of_another_recorder(tmp_path, capsys):
    """Its metadata names no seed and no policy."""
    bag = write(tmp_path / "bag", flight(TINY, missions=2), namespace="/uav2")
    status, err = verify(capsys, bag)
    assert (status, "expected --scenario NAME|FILE" in err) == (2, True)
    assert verify(capsys, bag, "--scenario", "five_clusters_hover")[0] == 1, "another world"
    shipped = flight(scenarios.load("three_clusters_hover"), missions=2)
    bag = write(tmp_path / "shipped", shipped, namespace="/uav2")
    status, out = verify(capsys, bag, "--namespace", "uav2")
    assert status == 0
    n_steps = len([message for message in shipped if message.topic == "/users"])
    assert f"channel: {n_steps} of {n_steps} steps recomputed, equal to the last bit" in out
    assert "the bag names no seed of a simulated world: poses and users are not recomputed" in out
    assert "decisions: not verified: the bag does not name the policy that flew; --policy NAME|DIR" in out
    assert out.splitlines()[-1] == "verified in part"
    status, out = verify(capsys, bag, "--policy", "three_clusters_hover_dueling")
    assert (status, "decides differently in" in out) == (0, True)


def test_where_rates_are_missing_both_pasts_are_possible(tmp_path, capsys):
    """The monitor counted a step whose rates were lost, or missed it."""
    scenario = tiny(mission={"r_min_bits": 6e7})
    recorded = flight(scenario, act=lambda mission, step: 6 if step else 1)  # to the users, and stay

    def found(name, messages_of_bag, *changes):
        for change in (changing("rates", 0, 3, lambda _: None), *changes):
            messages_of_bag = [kept for m in messages_of_bag if (kept := change(m)) is not None]
        return verify(capsys, write(tmp_path / name, messages_of_bag, about(scenario)))

    status, out = found("booked", recorded)
    assert (status, "channel: 8 of 9 steps recomputed, equal to the last bit" in out) == (0, True)

    missed = without_step(recorded, scenario, 3)
    assert missed[-1] != recorded[-1]
    status, out = found("missed", missed)
    assert (status, "channel: 8 of 9 steps recomputed, equal to the last bit" in out) == (0, True)

    # What fits neither is unknown, and no difference; but SINR and rate do not depend on it.
    status, out = found("odd", recorded, changing("rates", 0, 4, more_data))
    assert "1 not recomputed: what was collected before it is not recorded" in out
    status, out = found("false", recorded, changing("rates", 0, 4, nudged("sinr", 1)))
    assert (status, "step 4, user 1, sinr: recorded" in out) == (1, True)


def without_step(recorded, scenario, number):
    """A flight whose monitor missed a step."""
    made, collection = [], None
    uav_m = users_m = None
    for message in recorded:
        kind = messages.PAYLOADS.get(message.topic[1:])
        one = messages.decode(cdr.decode_string(message.data), kind) if kind else None
        if one is None:
            uav_m = np.frombuffer(message.data, "<f8", 3, offset=20)
        elif isinstance(one, messages.Users):
            users_m = payloads.users_m(one, scenario)
        elif isinstance(one, messages.Rates) and one.step == number - 1:
            collection = payloads.collection(one, scenario)
        elif isinstance(one, messages.Rates) and one.step > number:
            link = world.measure(scenario, uav_m, users_m, collection[1])
            collection = world.collect(scenario, link, *collection)
            rates = payloads.rates(link, *collection, mission=one.mission, step=one.step)
            message = message._replace(data=bag_message("rates", rates, 0).data)
        made.append(message)
    return made


def more_data(payload):
    return msgspec.structs.replace(payload, data_bits=[one + 1.0 for one in payload.data_bits])


def test_a_bag_of_version_0_1_0_verifies(tmp_path, capsys):
    """Its scenario has no reading of the data in the reward, no channel model, and the same fingerprint."""
    old = msgspec.to_builtins(TINY)
    assert old["reward"].pop("data") == "so_far"
    assert old["radio"].pop("model") == "free_space"
    values = {"scenario_values": json.dumps(old)}
    status, out = verify(capsys, write(tmp_path / "bag", flight(TINY), about(TINY, **values)))
    assert (status, out.count("9 of 9 steps recomputed, equal to the last bit")) == (0, 2), out


def test_a_bag_holds_its_channel_model(tmp_path, capsys):
    radio = {"carrier_hz": 2e9, "environment": "umi_av", "line_of_sight": "mean_gain"}
    values = msgspec.to_builtins(TINY)
    kept = {
        key: values["radio"][key] for key in ("bandwidth_hz", "tx_power_w", "noise_power_dbm", "interference")
    }
    scenario = from_values(values | {"radio": kept | radio | {"model": "tr_36_777"}}, "aerial")
    recorded = flight(scenario)
    status, out = verify(capsys, write(tmp_path / "bag", recorded, about(scenario)))
    assert (status, out.count("9 of 9 steps recomputed, equal to the last bit")) == (0, 2), out
    other = json.dumps(
        msgspec.to_builtins(
            from_values(
                values | {"radio": kept | radio | {"model": "air_to_ground", "environment": "urban"}}, "other"
            )
        )
    )
    status, out = verify(capsys, write(tmp_path / "other", recorded, about(scenario, scenario_values=other)))
    assert (status, "step 0, user 0, sinr: recorded" in out) == (1, True), out


def test_a_gain_map_is_read_from_its_place_or_from_that_of_the_scenario_given(tmp_path, capsys):
    gain_map.save(tmp_path / "map.npz", TINY.grid, X_M, Y_M, free_space_db(TINY.grid))
    (tmp_path / "mapped.toml").write_text(mapped_toml("map.npz"))
    scenario = scenarios.load(tmp_path / "mapped.toml")
    bag = write(tmp_path / "bag", flight(scenario), about(scenario))
    status, out = verify(capsys, bag)
    assert status == 0, out
    assert "channel: 9 of 9 steps recomputed, equal to the last bit" in out
    (tmp_path / "moved").mkdir()
    for name in ("map.npz", "mapped.toml"):
        (tmp_path / name).rename(tmp_path / "moved" / name)
    gain_map.load.cache_clear()
    gain_map._values.cache_clear()
    status, error = verify(capsys, bag)
    assert (status, f"gain map {tmp_path / 'map.npz'}: cannot be read: No such file" in error) == (2, True)
    assert verify(capsys, bag, "--scenario", tmp_path / "moved" / "mapped.toml")[0] == 0


@pytest.mark.parametrize("seed", ["shadowing_seed", "link_seed"])
def test_a_random_channel_is_recomputed_from_the_recorded_seeds(tmp_path, capsys, seed):
    values = msgspec.to_builtins(TINY)
    values["radio"] |= {
        "shadowing": {"sigma_db": 6.0, "correlation_m": 50.0},
        "fading": {"model": "rayleigh"},
    }
    scenario = from_values(values, "test")
    recorded = flight(scenario, missions=2)
    n_steps = sum(message.topic == "/users" for message in recorded)
    bag = write(tmp_path / "bag", recorded, about(scenario))
    status, out = verify(capsys, bag)
    assert status == 0, out
    for check in ("channel", "world"):
        assert f"{check}: {n_steps} of {n_steps} steps recomputed, equal to the last bit" in out

    def other(payload):
        return msgspec.structs.replace(payload, **{seed: getattr(payload, seed) ^ 1})

    status, out = verify(capsys, copy(bag, tmp_path / "changed", changing("users", 1, 2, other)))
    assert status == 1
    assert f"users: mission 1, step 2, {seed}: recorded" in out, "the world's"
    assert "rates: mission 1, step 2, user 0, sinr: recorded" in out, "the channel's"


def test_a_recording_that_begins_late_two_flights_and_an_abort(tmp_path, capsys):
    late = flight(TINY, missions=2)[20:]  # from step 4 on
    second = flight(TINY, missions=2, steps=3, begun_ns=late[-1].log_time_ns + 10**9)
    status, out = verify(capsys, write(tmp_path / "bag", late + second, about(TINY)))
    assert status == 0
    assert "4 missions, " in out
    assert "not recomputed: its mission is not recorded from the start" in out
    assert "world: " in out
    assert "equal to the last bit" in out


def test_another_seed_in_the_metadata_is_no_difference(tmp_path, capsys):
    """Nodes that were started by hand: the seed in the missions counts."""
    first = flight(TINY, seed=3, missions=2)
    second = flight(TINY, seed=8, begun_ns=first[-1].log_time_ns + 10**9)
    status, out = verify(capsys, write(tmp_path / "bag", first + second, about(TINY, seed=0)))
    assert status == 0
    assert "world: 27 of 27 steps recomputed, equal to the last bit" in out
    assert "flown with seed 3, 8; the bag's metadata names seed 0" in out
    false = [changing("mission", 1, 0, higher("seed"))(message) for message in first]
    status, out = verify(capsys, write(tmp_path / "false", false, about(TINY, seed=3)))
    assert (status, "mission 1, step 0, seed: recorded 5, recomputed 4" in out) == (1, True)
    false = [changing("mission", 0, 0, higher("seed"))(message) for message in first]
    status, out = verify(capsys, write(tmp_path / "start", false, about(TINY, seed=3)))
    assert (status, "users: mission 0, step 0, user 0, x_m" in out) == (1, True)


def test_a_paced_flight_may_hover_where_a_move_came_too_late(tmp_path, capsys):
    """In lockstep no move comes too late: there the same is a difference."""
    recorded = flight(TINY, act=lambda mission, step: 6)
    late = changing("move", 0, 2, lambda move: msgspec.structs.replace(move, action="right"))
    recorded = [late(message) for message in recorded]
    status, out = verify(capsys, write(tmp_path / "paced", recorded, about(TINY, pace="10.0")))
    assert status == 0
    assert "1 moves came too late and were not flown: the vehicle hovered" in out
    status, out = verify(capsys, write(tmp_path / "lockstep", recorded, about(TINY)))
    assert status == 1
    assert "mission: mission 0, step 3, cell: recorded [0, 0, 0], recomputed [1, 0, 0]" in out


@pytest.mark.long
def test_missions_whose_nodes_were_killed_verify(ros: Ros, capsys):
    """A killed monitor restores its data from its journal; a world repeats what it had flown."""
    bag, missions = ros.folder / "bag", 25
    steps = missions * (scenarios.load("five_clusters").mission.max_steps + 1)  # with step 0 of each
    process = ros.start(
        "uav_dc_ros.run_all", "--missions", missions, "--pace", "lockstep", "--no-compose", "--bag", bag
    )
    for node in ("channel_monitor", "world", "policy"):
        os.kill(ros.node(node), signal.SIGKILL)
        time.sleep(0.7)
    status, output = finish(process)
    assert status == 0, output
    assert output.count("killed by SIGKILL") == 3, output
    status, out = verify(capsys, bag)
    assert status == 0, out
    recomputed = re.search(
        rf"^channel: (\d+) of {steps} steps recomputed, equal to the last bit", out, re.MULTILINE
    )
    assert recomputed is not None, out
    # The last messages of a killed node may be lost: the bag lacks them, and verify reports it.
    assert int(recomputed[1]) >= steps - 3, out


@pytest.mark.long
def test_a_monitor_that_outlives_a_flight_takes_no_pose_of_it_for_the_next(ros: Ros, capsys):
    """Mission time begins again with each flight: the last pose of one has a stamp that comes again.

    The first world hovers at the start, since no policy is there; the second one leaves it at once.
    """
    bag = ros.folder / "bag"

    def start(node, *parameters):
        given = [part for parameter in parameters for part in ("-p", parameter)]
        return ros.start(
            f"uav_dc_ros.nodes.{node}", "--ros-args", "-p", "scenario:=five_clusters_hover", *given
        )

    def stop(node):
        node.terminate()
        status, output = finish(node)
        assert status == 0, output

    probe = ros.stranger("probe", "/mission")
    others = [
        start("channel_monitor", 'peers:=["world", "recorder"]'),
        start("recorder", f"bag:={bag}", 'peers:=["channel_monitor"]'),
    ]
    first = start("world", "pace:='100'", 'peers:=["channel_monitor", "recorder"]')
    wait_for(probe.stdout, '\\"step\\":7')
    stop(first)
    others.append(start("policy", f"policy:={POLICY}"))
    second = start("world", 'peers:=["channel_monitor", "recorder", "policy"]')
    wait_for(probe.stdout, '\\"remaining_steps\\":0')
    for node in (second, *others):
        stop(node)
    probe.stdin.close()
    probe.wait(90)
    probe.stdout.close()
    status, out = verify(capsys, bag)
    assert status == 0, out
    assert "2 missions, " in out


def test_json_has_what_the_text_has(tmp_path, capsys):
    """The status is the same; a difference, a gap and a clean check have other words."""
    bag = write(tmp_path / "bag", flight(TINY, missions=2), about(TINY))
    status, out = verify(capsys, bag, "--json")
    report = json.loads(out)
    assert (status, report["result"], report["missions"]) == (0, "verified in part", 2)
    assert (report["scenario"], report["fingerprint"]) == (TINY.name, TINY.fingerprint)
    assert (report["policy"], report["other_policy"]) == (None, None)
    assert "does not name the policy" in report["decisions_missing"]
    for check in report["checks"]:
        assert check["recomputed"] == report["steps"] == 18
        assert (check["differing"], check["not_recomputed"], check["first_difference"]) == (0, {}, None)
    assert report["service"]["fairness"] > 0
    changed = copy(bag, tmp_path / "changed", changing("rates", 1, 3, nudged("sinr", 2)))
    status, _ = verify(capsys, changed, "--json", tmp_path / "report.json")
    report = json.loads((tmp_path / "report.json").read_text())
    assert (status, report["result"]) == (1, "differs")
    channel, world = report["checks"]
    assert (channel["title"], channel["differing"], world["differing"]) == ("channel", 1, 0)
    assert "rates: mission 1, step 3, user 2, sinr: recorded" in channel["first_difference"]
    status, text = verify(capsys, changed)
    assert (status, channel["first_difference"] in text) == (1, True)
    assert verify(capsys, bag, "--json", "--complete")[0] == 1
