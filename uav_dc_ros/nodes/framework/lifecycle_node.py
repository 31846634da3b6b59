"""A node with the life cycle of ROS 2, and with its parameters from the node table."""

import difflib
import traceback
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.context import Context
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from uav_dc_ros.errors import ParameterError, UavDcError
from uav_dc_ros.nodes.framework.node_table import NODES
from uav_dc_ros.nodes.framework.parameters import COMMON, Parameter
from uav_dc_ros.nodes.ros import rclpy_private


class ManagedNode(LifecycleNode):
    """A node of the table; a UavDcError in `configure` or `activate` is logged, undone, and fails it.

    `overrides` replace parameter values of the command line. Raises ParameterError for an invalid value, and
    for a parameter that the node does not have.
    """

    def __init__(
        self, name: str, overrides: Sequence[rclpy.Parameter] = (), context: Context | None = None
    ) -> None:
        try:
            super().__init__(name, parameter_overrides=list(overrides), context=context)
        except InvalidParameterTypeException as error:  # of a parameter that rclpy declares itself
            raise ParameterError(str(error)) from None
        self.row = NODES[name]
        self.values: dict[str, Any] = {}  # of its parameters, checked when it is configured
        self.failure: UavDcError | None = None  # of the last transition, if it failed
        self._is_active = False
        self._until_cleanup, self._until_inactive = ExitStack(), ExitStack()  # destroy what they hold
        self._change_state = rclpy_private.replace_change_state(self, self._reject_impossible)
        self._declare()

    # Parameters.

    def _declare(self) -> None:
        rows = {row.name: row for row in (*COMMON, *self.row.parameters)}
        overrides = rclpy_private.parameter_overrides(self)
        for row in rows.values():
            if (given := overrides.get(row.name)) is not None:
                overrides[row.name] = _typed(given, row)
            try:
                value = self.declare_parameter(row.name, row.default, _descriptor(row)).value
            except InvalidParameterValueException:
                value = overrides[row.name].value
            self.values[row.name] = row.value(value)
        self._reject_unknown("", list(rows))
        for peer in self.values["peers"]:
            if peer not in NODES:
                raise ParameterError(f"peers: {peer!r}; expected some of {', '.join(NODES)}")
        self.add_pre_set_parameters_callback(
            lambda given: [_typed(one, rows[one.name]) if one.name in rows else one for one in given]
        )
        self.add_on_set_parameters_callback(self._on_set)

    def _reject_unknown(self, kind: str, known: Sequence[str]) -> None:
        """Raise ParameterError for an override that no parameter has; `kind`: of QoS, or of the others."""
        for name in rclpy_private.parameter_overrides(self):
            if name.startswith("qos_overrides.") == bool(kind) and not self.has_parameter(name):
                close = difflib.get_close_matches(name, known, 1)
                meant = f"did you mean {close[0]!r}?" if close else f"expected some of {', '.join(known)}"
                raise ParameterError(f"{name}: no such parameter of node {self.row.name}; {meant}")

    def _on_set(self, given: list[Any]) -> SetParametersResult:
        """Reject invalid values, and every value while the node is configured."""
        rows = {row.name: row for row in self.row.parameters}
        for parameter in given:
            if (row := rows.get(parameter.name)) is None:
                continue
            try:
                if self.state != "unconfigured":
                    raise ParameterError(
                        f"{row.name}: the node is {self.state}; expected it to be unconfigured, since it "
                        "reads its parameters only when it is configured"
                    )
                row.value(parameter.value)
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    # The life cycle.

    @property
    def state(self) -> str:
        """State of the life cycle: `unconfigured`, `inactive`, `active` or `finalized`."""
        return rclpy_private.state(self)

    def configure(self) -> None:
        """Load and check what the parameters name. Raises UavDcError where that fails."""

    def activate(self) -> None:
        """Start. The topics work from here on."""

    def deactivate(self) -> None:
        """Stop safely. The topics still work."""

    def cleanup(self) -> None:
        """Release what `configure` created."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition to inactive: read the parameters and configure."""
        return self._attempt(self._configure, undo=self._cleanup)

    def _configure(self) -> None:
        for row in self.row.parameters:
            self.values[row.name] = row.value(self.get_parameter(row.name).value)
        self.configure()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition to active."""
        return self._attempt(self._activate, undo=self._undo_activation)

    def _activate(self) -> None:
        self._is_active = True
        self.activate()

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition to inactive: a safe stop, and the end of all subscriptions."""
        return self._attempt(self._deactivate)

    def _deactivate(self) -> None:
        self.deactivate()
        self._flush()
        self._undo_activation()

    def _flush(self) -> None:
        """Wait until the last messages have been received."""

    def _undo_activation(self) -> None:
        self._is_active = False
        self._until_inactive.close()

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition to unconfigured."""
        return self._attempt(self._cleanup)

    def _cleanup(self) -> None:
        self.cleanup()
        self._until_cleanup.close()

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition to finalized, from any state."""
        return self._attempt(self._shut_down)

    on_error = on_shutdown  # to unconfigured, after an unexpected error in a transition

    def _shut_down(self) -> None:
        if self._is_active:
            self._deactivate()
        self._cleanup()

    def _attempt(
        self, transition: Callable[[], None], undo: Callable[[], None] = lambda: None
    ) -> TransitionCallbackReturn:
        """Make a transition. An error is logged; a UavDcError is also undone."""
        self.failure = None
        try:
            transition()
        except UavDcError as error:
            self.failure = error
            self.get_logger().error(str(error))
            undo()
            return TransitionCallbackReturn.FAILURE
        except Exception:  # rclpy would swallow it
            self.get_logger().fatal(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _reject_impossible(self, request: Any, response: Any) -> Any:
        """Reject a request for a transition that this state does not have: rclpy would end the node."""
        try:
            return self._change_state(request, response)
        except rclpy_private.RCLError:
            requested = request.transition.label or request.transition.id
            self.get_logger().warning(f"transition {requested}: not one from the state {self.state}")
            response.success = False
            return response


def _typed(given: rclpy.Parameter, row: Parameter) -> rclpy.Parameter:
    """A parameter of its row's type, where its value can be converted."""
    value = row.typed(given.value)
    return given if value is given.value else rclpy.Parameter(row.name, value=value)


def _descriptor(row: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=row.help,
        additional_constraints=row.expected,
        read_only=row.read_only,
        dynamic_typing=True,  # `Parameter.value` rejects a wrong type, by the parameter's name
    )
    if isinstance(row.default, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=row.min, to_value=row.max)]
    elif row.min is not None:
        descriptor.integer_range = [IntegerRange(from_value=int(row.min), to_value=int(row.max or 0))]
    return descriptor
