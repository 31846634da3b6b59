"""The file of a random field, by its seed."""

from functools import lru_cache

from uav_dc_ros.scenarios.generation import document, field


@lru_cache(maxsize=16)  # a composed process has several nodes in one scenario
def text(seed: int) -> str:
    """Its text; raises ParameterError if no field of the seed can be flown."""
    return document.text(field.at_random(seed), document.header(f"random --seed {seed}"))
