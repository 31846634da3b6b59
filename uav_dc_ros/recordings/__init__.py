"""What bags tell of missions: a bag from any source that has the topics.

steps        the steps of recorded missions, one after the other: what all others read
info         what a bag holds, and whether it is complete; from survey, and missions
verify       everything recomputed; recompute does it, compare finds the first difference
export       tables and transitions; from rows, tables, transitions
report       a page about missions, or several bags side by side; made in pages
"""
