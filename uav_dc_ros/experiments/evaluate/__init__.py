"""Evaluation: missions flown with a policy, and figures over many of them."""
