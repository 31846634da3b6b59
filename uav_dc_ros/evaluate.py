"""`python -m uav_dc_ros.evaluate`: evaluate policies over many missions."""

from uav_dc_ros.experiments.evaluate.cli import main

if __name__ == "__main__":
    main()
