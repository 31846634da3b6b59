"""Registers `uav_dc_ros/DataCollection-v0` and its vector form with Gymnasium, which finds no plug-ins.

`import gymnasium, uav_dc_ros` imports it, and `gymnasium.make("uav_dc_ros:uav_dc_ros/DataCollection-v0")`.
"""

import gymnasium

ENV_ID = "uav_dc_ros/DataCollection-v0"


def register() -> None:
    """Register the environment, once."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            id=ENV_ID,
            entry_point="uav_dc_ros.env.gym_env:DataCollectionEnv",
            vector_entry_point="uav_dc_ros.env.vector_env:DataCollectionVectorEnv",
        )


register()
