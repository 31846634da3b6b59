"""Recording: topics into a bag."""
