"""`python -m uav_dc_ros.train`: from a scenario to a policy's folder."""

from uav_dc_ros.experiments.train.cli import main

if __name__ == "__main__":
    main()
