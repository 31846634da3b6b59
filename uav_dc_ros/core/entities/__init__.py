"""The observation `entities`: the clusters as a set, in numbers that look alike in other fields."""

from uav_dc_ros.core.entities.encoding import bounds, encode, problem, size

__all__ = ["bounds", "encode", "problem", "size"]
