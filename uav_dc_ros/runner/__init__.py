"""What run_all consists of: nodes are started, followed and stopped; a summary is written."""
