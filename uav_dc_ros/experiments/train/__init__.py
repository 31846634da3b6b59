"""Training: the learner's loop, and what is kept and shown of it."""
