"""Evaluation of policies over many missions."""
