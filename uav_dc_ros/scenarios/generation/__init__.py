"""Scenarios that are made: fields from a few numbers, their check, and their text."""
