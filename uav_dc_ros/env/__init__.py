"""Gymnasium environments over `core`; they add no physics of their own."""
