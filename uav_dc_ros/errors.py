"""The project's exceptions: one small tree, so that a caller can catch all of it with one name."""


class UavDcError(Exception):
    """Something the user can mend. The message says what was wrong, the value, and what was expected."""


class ScenarioError(UavDcError):
    """A scenario that cannot be found, read or believed."""


class MessageError(UavDcError):
    """A payload that is not what its schema says.

    Attributes:
        reason: short, stable name of what was wrong (`malformed`, `invalid`, ...), fit for counting.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class PolicyError(UavDcError):
    """A policy folder that is missing, damaged, or made for another world."""


class BagError(UavDcError):
    """A bag that cannot be written or read."""


class BagDamagedError(BagError):
    """A bag that is damaged, or whose recorder was killed: `recover` makes a whole one of the rest."""


class ParameterError(UavDcError):
    """A ROS parameter of a node, or an option of a command, that makes no sense."""


class NodeError(UavDcError):
    """A node that failed, or never appeared, while a mission needed it."""


class VehicleError(UavDcError):
    """A vehicle, or a way to it, that cannot be used."""


class PhaseError(UavDcError):
    """A phase of a mission that cannot follow the one before: an error of the bridge itself."""


class TrainingError(UavDcError):
    """A training run that cannot start or go on."""
