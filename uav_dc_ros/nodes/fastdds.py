"""The middleware's settings, as in fastdds.xml, unless the user has his own."""

import os
from pathlib import Path

# Jazzy's Fast DDS reads the first name, later ones the second.
NAMES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")


def use_profiles() -> None:
    """Set the profiles of this process and its children; to be called before ROS is initialised."""
    if not any(name in os.environ for name in NAMES):
        os.environ.update(dict.fromkeys(NAMES, str(Path(__file__).with_name("fastdds.xml"))))
