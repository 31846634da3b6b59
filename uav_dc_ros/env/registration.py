"""Makes `uav_dc_ros/DataCollection-v0` known to Gymnasium.

Gymnasium has looked for no plug-ins since its 1.0, so one import is needed: of this module, or, inside
the name, `gymnasium.make("uav_dc_ros.env.registration:uav_dc_ros/DataCollection-v0")`.
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
