"""Prints, as JSON, the names of the parameters that each node in argv has declared."""

import json
import sys

import rclpy
from rclpy.parameter_client import AsyncParameterClient


def main() -> None:
    rclpy.init(args=[])
    asker = rclpy.create_node("asker")
    declared = {}
    for name in sys.argv[1:]:
        client = AsyncParameterClient(asker, name)
        assert client.wait_for_services(10.0), f"{name} offers no parameters"
        answer = client.list_parameters()
        rclpy.spin_until_future_complete(asker, answer, timeout_sec=10.0)
        declared[name] = list(answer.result().result.names)
    print(json.dumps(declared))
    rclpy.shutdown()


if __name__ == "__main__":
    main()
