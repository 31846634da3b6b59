"""Agents: what a policy is, and how it learns.

network   the Q-network on numpy or torch
policy    a trained policy as a folder; needs numpy only, so the policy node uses it, too
replay    the replay buffer (torch)
dqn       deep Q-learning and its dueling variant for a population of runs (torch)
"""
