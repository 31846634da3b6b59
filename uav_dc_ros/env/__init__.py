"""The world as reinforcement learning sees it: adapters over `core`, no formula.

observations   what an agent sees; needs numpy only, so the policy node uses it, too
"""
