"""Q-network, policy folder, replay buffer and learner; `network` and `policy` need no torch."""
