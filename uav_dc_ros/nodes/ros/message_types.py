"""Message types of any installed ROS package: their classes, and their definitions as text."""

import importlib
import importlib.util
import re
from pathlib import Path
from typing import Any

NAME = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")
_BASIC = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}  # IDL's: .msg's


def find(type: str) -> Any:
    """The Python class of a message type, such as `std_msgs/msg/String`; None if it is not installed.

    Names come from the network, or out of bags: only packages that hold messages are imported.
    """
    matched = NAME.fullmatch(type)
    if matched is None:
        return None
    package, name = matched.groups()
    spec = importlib.util.find_spec(package)  # imports nothing
    folders = (spec and spec.submodule_search_locations) or ()
    if not any((Path(folder) / "msg" / "__init__.py").is_file() for folder in folders):
        return None
    try:
        found = getattr(importlib.import_module(f"{package}.msg"), name, None)
    except ImportError:
        return None
    return found if hasattr(found, "get_fields_and_field_types") else None


def definition(type: str) -> bytes:
    """The definition of an installed message type and of all types inside it, in the encoding `ros2msg`.

    For the types of ROS 2 itself it is their text. For others it holds the names and types of all fields,
    from the class, but neither constants nor defaults, which are not needed to decode messages. Raises
    LookupError if it, or a type inside it, is not installed.
    """
    from uav_dc_ros.bags import message_definitions  # imports rosbags, which few callers need

    if type in message_definitions.typestore().fielddefs:
        return message_definitions.definition(type)
    texts: dict[str, str] = {}
    _describe(type, texts)
    own = texts.pop(type)
    others = (f"{'=' * 80}\nMSG: {_short(name)}\n{text}" for name, text in texts.items())
    return "".join([own, *others]).encode()


def _describe(type: str, texts: dict[str, str]) -> None:
    """Add the fields of a type, and of all types inside it, to `texts`."""
    found = find(type)
    if found is None:
        raise LookupError(type)
    fields = tuple(zip(found.get_fields_and_field_types(), found.SLOT_TYPES, strict=False))
    texts[type] = "".join(f"{_field_type(kind)} {name}\n" for name, kind in fields)
    for _, kind in fields:
        element = getattr(kind, "value_type", kind)
        if hasattr(element, "namespaced_name"):
            inner = "/".join(element.namespaced_name())
            if inner not in texts:
                _describe(inner, texts)


def _field_type(kind: Any) -> str:
    """A field's type, as .msg files write it."""
    from rosidl_parser import definition as idl  # type: ignore[import-untyped]  # its import takes 0.2 s

    match kind:
        case idl.BasicType():
            return _BASIC.get(kind.typename, str(kind.typename))
        case idl.NamespacedType():
            return _short("/".join(kind.namespaced_name()))
        case idl.AbstractGenericString():
            bound = f"<={kind.maximum_size}" if kind.has_maximum_size() else ""
            return ("wstring" if isinstance(kind, idl.AbstractWString) else "string") + bound
        case idl.Array():
            return f"{_field_type(kind.value_type)}[{kind.size}]"
        case idl.BoundedSequence():
            return f"{_field_type(kind.value_type)}[<={kind.maximum_size}]"
        case _:
            return f"{_field_type(kind.value_type)}[]"


def _short(type: str) -> str:
    return type.replace("/msg/", "/")
