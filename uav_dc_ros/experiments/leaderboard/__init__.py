"""The leaderboard: policies and planners in many worlds, against a bound and against one another."""
