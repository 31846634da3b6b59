"""The project's exceptions: one small tree with one base class."""

# Behind the name of a package that the extra `train` brings.
FROM_TRAIN = 'is not installed; expected it from: pip install "uav_dc_ros[train]"'


class UavDcError(Exception):
    """An error that the user can fix. The message states what was wrong, the value, and what was expected."""


class ScenarioError(UavDcError):
    """A scenario that cannot be found or read, or is invalid.

    `path` holds the names and indices that lead to the invalid value, `()` without one.
    """

    def __init__(self, message: str, path: tuple[str | int, ...] = ()) -> None:
        super().__init__(message)
        self.path = path


class UnknownKeyError(ScenarioError):
    """A key that no scenario has."""


class MessageError(UavDcError):
    """A payload that does not match its schema; `reason` names the error (`malformed`, ...) for counters."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class PolicyError(UavDcError):
    """A policy folder that is missing, damaged, or made for another world."""


class BagError(UavDcError):
    """A bag that cannot be written or read."""


class BagDamagedError(BagError):
    """A bag that is damaged, or whose recorder was killed; `bag recover` makes a whole one of it."""


class ParameterError(UavDcError):
    """An invalid ROS parameter or command-line option."""


class NodeError(UavDcError):
    """A node that failed, or did not start, while a mission needed it."""


class VehicleError(UavDcError):
    """A vehicle, or a connection to it, that cannot be used."""


class PhaseError(UavDcError):
    """A phase of a mission that cannot follow the one before: a bug in the bridge."""


class TrainingError(UavDcError):
    """A training run that cannot start or continue."""
