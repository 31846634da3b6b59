"""Reads torn and damaged files of bags, and makes whole bags of them."""
