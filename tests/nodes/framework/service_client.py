"""A node outside the mission that calls services, as `ros2 lifecycle` and `ros2 param` do.

Commands come as JSON lines on standard input, responses go as JSON lines to standard output:

    {"node": "/policy", "do": "configure"}            -> {"success": true, "state": "inactive"}
    {"node": "/policy", "set": {"policy": "nobody"}}  -> {"policy": {"success": false, "reason": "..."}}
    {"node": "/policy", "describe": ["policy"]}       -> {"policy": {"description": "...", ...}}
    {"call": "/abort"}                                -> {"success": true, "message": "..."}
"""

import json
import sys
from typing import Any

import rclpy
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

TRANSITIONS = {"configure": 1, "cleanup": 2, "activate": 3, "deactivate": 4}


class ServiceClient(Node):
    """Calls a service, and waits for its response."""

    def call(self, kind: Any, service: str, **request: Any) -> Any:
        client = self.create_client(kind, service)
        assert client.wait_for_service(20.0), f"no service {service}"
        future = client.call_async(kind.Request(**request))
        rclpy.spin_until_future_complete(self, future, timeout_sec=20.0)
        assert future.done(), f"{service} did not respond"
        self.destroy_client(client)
        return future.result()

    def change(self, node: str, transition: str) -> dict[str, Any]:
        request = ChangeState.Request()
        request.transition.label = "" if transition in TRANSITIONS else transition
        request.transition.id = TRANSITIONS.get(transition, 0)
        response = self.call(ChangeState, f"{node}/change_state", transition=request.transition)
        state = self.call(GetState, f"{node}/get_state").current_state.label
        return {"success": response.success, "state": state}

    def set(self, node: str, values: dict[str, Any]) -> dict[str, Any]:
        given = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        results = self.call(SetParameters, f"{node}/set_parameters", parameters=given).results
        return {
            name: {"success": result.successful, "reason": result.reason}
            for name, result in zip(values, results, strict=True)
        }

    def describe(self, node: str) -> dict[str, Any]:
        names = self.call(ListParameters, f"{node}/list_parameters").result.names
        descriptors = self.call(DescribeParameters, f"{node}/describe_parameters", names=names).descriptors
        return {
            row.name: {
                "description": row.description,
                "expected": row.additional_constraints,
                "read_only": row.read_only,
                "range": [
                    [bound.from_value, bound.to_value]
                    for bound in (*row.integer_range, *row.floating_point_range)
                ],
            }
            for row in descriptors
        }


def main() -> None:
    rclpy.init()
    client = ServiceClient("client")
    for line in sys.stdin:
        command = json.loads(line)
        if "call" in command:
            called = client.call(Trigger, command["call"])
            response = {"success": called.success, "message": called.message}
        elif "do" in command:
            response = client.change(command["node"], command["do"])
        elif "set" in command:
            response = client.set(command["node"], command["set"])
        else:
            response = client.describe(command["node"])
        print(json.dumps(response), flush=True)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
