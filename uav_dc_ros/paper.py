"""`python -m uav_dc_ros.paper`: the sweep behind every figure of the paper, and its claims."""

from uav_dc_ros.experiments.paper.cli import main

if __name__ == "__main__":
    main()
