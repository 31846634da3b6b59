"""The verb `export`: missions as tables, or as transitions to learn from."""
