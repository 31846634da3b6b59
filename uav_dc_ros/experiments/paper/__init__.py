"""The paper's evaluation: its sweep as data, and what becomes of the results.

setting   what a run of the sweep is
plan      the figures, and which runs they need
results   what was measured, and its files
figures   the paper's figures; panels draws, style says how
claims    the paper's claims against the results; evidence reads and weighs, claims_* are the claims
report    claims.md and claims.json
"""
