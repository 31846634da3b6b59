"""What bags tell of missions: a bag from any source that has the topics.

steps   the steps of recorded missions, one after the other
survey  what a bag holds and lacks; missions is how its missions ended; info tells it
"""
