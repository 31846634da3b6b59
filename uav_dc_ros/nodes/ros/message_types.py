"""Message types of any ROS package that is installed: their classes, and their definitions as text."""

import importlib
import importlib.util
import re
from pathlib import Path
from typing import Any

NAME = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")
_BASIC = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}  # IDL's: .msg's
_SEPARATOR = "=" * 80


def find(type: str) -> Any:
    """The Python class of a message type, such as `std_msgs/msg/String`; None if it is not installed.

    Names come from the network, or out of bags: nothing is imported but packages that hold messages.
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
    """A message type that is installed, with all types inside it, in the encoding `ros2msg`.

    Of a type that ROS 2 itself has, this is its text; of another one, what its class tells: names and types
    of all fields, but neither constants nor defaults, which nobody needs to read its messages.

    Raises:
        LookupError: it, or a type inside it, is not installed.
    """
    from uav_dc_ros.bags import message_definitions  # brings rosbags, which only few need, and late

    if type in message_definitions.TYPESTORE.fielddefs:
        return message_definitions.definition(type)
    texts: dict[str, str] = {}
    _describe(type, texts)
    own = texts.pop(type)
    others = (f"{_SEPARATOR}\nMSG: {_short(name)}\n{text}" for name, text in texts.items())
    return "".join([own, *others]).encode()


def _describe(type: str, texts: dict[str, str]) -> None:
    """Enter the fields of a type, and of all types inside it."""
    found = find(type)
    if found is None:
        raise LookupError(type)
    names = found.get_fields_and_field_types()
    lines = [f"{_text(kind)} {name}" for name, kind in zip(names, found.SLOT_TYPES, strict=False)]
    texts[type] = "".join(f"{line}\n" for line in lines)
    for kind in found.SLOT_TYPES[: len(names)]:
        element = getattr(kind, "value_type", kind)
        if hasattr(element, "namespaced_name"):
            inner = "/".join(element.namespaced_name())
            if inner not in texts:
                _describe(inner, texts)


def _text(kind: Any) -> str:
    """A field's type, as .msg files write it."""
    from rosidl_parser import definition as idl  # type: ignore[import-untyped]  # a fifth of a second

    match kind:
        case idl.BasicType():
            return _BASIC.get(kind.typename, str(kind.typename))
        case idl.NamespacedType():
            return _short("/".join(kind.namespaced_name()))
        case idl.AbstractGenericString():
            bound = f"<={kind.maximum_size}" if kind.has_maximum_size() else ""
            return ("wstring" if isinstance(kind, idl.AbstractWString) else "string") + bound
        case idl.Array():
            return f"{_text(kind.value_type)}[{kind.size}]"
        case idl.BoundedSequence():
            return f"{_text(kind.value_type)}[<={kind.maximum_size}]"
        case _:
            return f"{_text(kind.value_type)}[]"


def _short(type: str) -> str:
    return type.replace("/msg/", "/")
