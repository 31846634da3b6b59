"""The best mission that is possible, and bounds on it."""
