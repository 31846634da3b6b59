"""What brings a vehicle down: return or land, asked for until it obeys, and then let alone."""

from dataclasses import dataclass

from uav_dc_ros.autopilot.vehicle import Mode, SetMode, Telemetry
from uav_dc_ros.autopilot.watch import Settings
from uav_dc_ros.messages import Phase

DOWN = (Mode.LAND, Mode.RETURN)


@dataclass
class Descent:
    """One way down.

    Attributes:
        how: the mode that it is to come down in.
        outcome: of the mission, once the vehicle stands.
        obeyed: was it seen coming down? From then on it is let alone: who changes the mode now is the pilot.
        tries: how often it was asked.
    """

    how: Mode = Mode.LAND
    outcome: Phase = Phase.ABORTED
    obeyed: bool = False
    tries: int = 0

    def obeys(self, known: Telemetry) -> bool:
        """Does it come down, as it was told or as its own failsafe or a pilot knows better."""
        self.obeyed = self.obeyed or known.mode in DOWN
        return self.obeyed

    def is_ours(self, mode: Mode) -> bool:
        """Is a vehicle that shall come down in a mode that nobody else has chosen for something else."""
        return mode in DOWN or (mode is Mode.COMMANDED and not self.obeyed)

    def lands_instead(self, settings: Settings, asked_s: float | None, vehicle_s: float) -> bool:
        """Has it to land now, as it was asked to return often enough.

        Args:
            settings: how often is enough.
            asked_s: when it was asked last, vehicle time; None: never.
            vehicle_s: now.
        """
        answered = asked_s is None or vehicle_s - asked_s >= settings.retry_s
        if self.how is not Mode.RETURN or self.tries < settings.returning_tries or not answered:
            return False
        self.how = Mode.LAND
        return True

    @property
    def wish(self) -> SetMode:
        """What to ask for."""
        return SetMode(self.how)
