"""The beat of a stream of setpoints: the same for every way to a vehicle."""

STREAM_S = 0.05
STREAM_VEHICLE_S = 0.2  # of a simulated vehicle whose time runs faster; PX4 wants more than 2 Hz of that
LIFE_S = 1.0  # a stream ends so long after the last sign of life of those who decide


def following(due_s: float, period_s: float, now_s: float) -> float:
    """When something is due again: on the beat, and without catching up on beats that were missed."""
    return due_s + period_s if now_s < due_s + period_s else now_s + period_s
