"""`fly` from Python: in a thread, beside a caller's own rclpy, which stays as it was."""

import json
import signal
import sys

import pytest

from tests.conftest import Ros, finish, wait_for

IN_A_THREAD = """
import json, os, signal, threading
import rclpy
from uav_dc_ros import RunConfig, fly

rclpy.init()
node = rclpy.create_node("mine")
before = dict(os.environ), [signal.getsignal(number) for number in (2, 15, 1)]
flown = []
thread = threading.Thread(target=lambda: flown.extend(fly(RunConfig(pace="lockstep", bag="bag"))))
thread.start()
thread.join()
assert before == (dict(os.environ), [signal.getsignal(number) for number in (2, 15, 1)])
flown += fly(RunConfig(pace="lockstep", record=False, scenario="three_clusters", seed=4, missions=2))
assert before == (dict(os.environ), [signal.getsignal(number) for number in (2, 15, 1)])
rclpy.spin_once(node, timeout_sec=0.01)
assert rclpy.ok()
rclpy.shutdown()
print(json.dumps([(one.scenario, one.seed, one.outcome, one.steps, one.bag, one.reason) for one in flown]))
"""
FOR_EVER = """
from uav_dc_ros import RunConfig, fly

try:
    fly(RunConfig(pace=0.001, bag="bag"), show=True)
except KeyboardInterrupt:
    print("interrupted")
"""
REFUSED = """
from uav_dc_ros import RunConfig, UavDcError, fly

for config in (RunConfig(scenario="mars"), RunConfig(nodes=("moon",)), RunConfig(settings={"world.x": 1})):
    try:
        fly(config)
    except UavDcError as error:
        print(error)
"""


def test_missions_beside_a_caller_s_own_ros(ros: Ros) -> None:
    status, output = finish(ros.start_command(sys.executable, "-c", IN_A_THREAD))
    assert status == 0, output
    assert json.loads(output) == [
        ["five_clusters", 0, "landed", 46, str(ros.folder / "bag"), ""],
        ["three_clusters", 4, "landed", 46, None, ""],
        ["three_clusters", 5, "landed", 46, None, ""],
    ]
    assert (ros.folder / "bag" / "metadata.yaml").is_file()


@pytest.mark.long  # run_all does it, too: test_faults
def test_ctrl_c_closes_the_bag_first(ros: Ros) -> None:
    process = ros.start_command(sys.executable, "-u", "-c", FOR_EVER)
    assert process.stdout is not None
    wait_for(process.stdout, "step 0/46")
    process.send_signal(signal.SIGINT)
    status, output = finish(process)
    assert status == 0, output
    assert output.splitlines()[-1] == "interrupted"
    assert (ros.folder / "bag" / "metadata.yaml").is_file()


def test_what_cannot_be_flown_is_an_error_of_the_project_s_own(ros: Ros) -> None:
    status, output = finish(ros.start_command(sys.executable, "-c", REFUSED))
    assert status == 0, output
    mars, moon, x = output.splitlines()
    assert "scenario 'mars': no such name or file" in mars
    assert "'moon'; expected some of world" in moon
    assert "world.x" in x
    assert list(ros.folder.iterdir()) == [ros.folder / "log"] or not list(ros.folder.iterdir())
