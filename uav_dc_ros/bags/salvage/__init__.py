"""Reads files of bags that are torn or damaged, and makes whole bags of them."""
