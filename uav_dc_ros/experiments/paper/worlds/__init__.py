"""The multiverse: the paper's claims in many worlds, drawn over everything that the paper leaves open."""
