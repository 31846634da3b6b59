"""`python -m uav_dc_ros.optimum`: the best missions possible, and how far policies are from them."""

from uav_dc_ros.experiments.optimum.cli import main

if __name__ == "__main__":
    main()
