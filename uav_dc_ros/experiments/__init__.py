"""Experiments: train policies, evaluate them, and repeat the paper's."""
