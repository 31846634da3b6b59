"""Agents: Q-network, policy folder, replay buffer and learner. Flying needs `network` and `policy` only: no torch."""
