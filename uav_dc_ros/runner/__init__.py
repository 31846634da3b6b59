"""What run_all consists of: it starts the nodes, follows the missions, stops the nodes and writes the summary."""
