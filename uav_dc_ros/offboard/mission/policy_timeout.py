"""How long a policy is waited for: one that is silent, and one that is gone."""

from uav_dc_ros.offboard.mission.fault_detector import SafetySettings


class PolicyTimeout:
    """Of a bridge with its policy.

    Args:
        settings: how many steps, and how long at least by the clock.
        step_s: duration of a step.

    Attributes:
        limit_s: how long a policy may be silent, vehicle time.
        gone_since: vehicle time and steady clock since when nobody is there; None: somebody is.
    """

    def __init__(self, settings: SafetySettings, step_s: float) -> None:
        self.limit_s = settings.policy_timeout_steps * step_s
        self._least_s = settings.policy_timeout_s
        self.gone_since: tuple[float, float] | None = None

    def is_over(self, since: tuple[float, float], now: tuple[float, float]) -> bool:
        """Was it waited for too long, by the vehicle's time, and by the clock, which is the policy's."""
        return now[0] - since[0] > self.limit_s and now[1] - since[1] > self._least_s
