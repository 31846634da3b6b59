"""The verb `export`: missions as tables, or as transitions for training."""
