"""What bags tell of missions: a bag from any source that has the topics.

steps   the steps of recorded missions, one after the other
"""
