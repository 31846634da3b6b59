"""Training: the loop, its checkpoints, validation, plots and policy card."""
