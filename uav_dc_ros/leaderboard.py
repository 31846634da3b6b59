"""`python -m uav_dc_ros.leaderboard`: the standings of policies and planners in many worlds."""

from uav_dc_ros.experiments.leaderboard.cli import main

if __name__ == "__main__":
    main()
