"""What the nodes share: the tables of nodes and parameters, life cycle, topics, diagnostics, process."""
