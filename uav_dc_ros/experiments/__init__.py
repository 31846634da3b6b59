"""Experiments: train policies, and measure them.

train      the training loop; progress, card and train_cli are what surrounds it
fly        missions side by side, one per seed
evaluate   figures over many missions; evaluate_cli prints them
"""
