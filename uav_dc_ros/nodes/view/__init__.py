"""What RViz and Foxglove show of a mission."""
