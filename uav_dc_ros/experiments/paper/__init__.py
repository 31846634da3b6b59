"""The paper's sweep: its figures and claims as data, its training in shards, and its report."""
