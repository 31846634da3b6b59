"""Training of one policy for fields that it has not seen: random layouts, and parallelised Q-learning."""
