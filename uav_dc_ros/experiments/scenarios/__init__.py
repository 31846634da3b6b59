"""Making, checking and drawing scenarios."""
