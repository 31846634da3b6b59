"""Makes `uav_dc_ros/DataCollection-v0` known to Gymnasium.

Gymnasium looks for no plug-ins since its 1.0, so one import is needed: `import gymnasium, uav_dc_ros`, this
module, or what stands before the colon in `gymnasium.make("uav_dc_ros:uav_dc_ros/DataCollection-v0")`.
"""

import gymnasium

ENV_ID = "uav_dc_ros/DataCollection-v0"


def register() -> None:
    """Registers the environment and its vector form; a second call changes nothing."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            id=ENV_ID,
            entry_point="uav_dc_ros.env.gym_env:DataCollectionEnv",
            vector_entry_point="uav_dc_ros.env.vector_env:DataCollectionVectorEnv",
        )


register()
