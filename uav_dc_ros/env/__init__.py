"""The world as reinforcement learning sees it: adapters over `core`, no physics of their own.

observations   what an agent sees; needs numpy only, so the policy node uses it, too
batch          worlds side by side, on numpy or torch: what trainer and vector environment stand on
gym_env        the Gymnasium environment
vector_env     many of them in one step
registration   importing it makes both known to gymnasium.make and make_vec
track          one mission, step by step
render         pictures of missions; brings matplotlib
"""
