"""Payloads as channels of encoding `json`, whose fields viewers such as Foxglove plot.

The text of a payload stays, byte for byte. `BagReader` reads such a channel as the std_msgs/msg/String that
its messages were. Foxglove's reader of JSON Schema accepts only fields with one plain `type`, at the root of
the schema, so the schema of a channel differs in form from that in `msgs_json/`; it accepts the same texts.
"""

import json
from functools import cache
from typing import Any

from uav_dc_ros import cdr, messages
from uav_dc_ros.messages import PAYLOADS, RunPayload
from uav_dc_ros.topics import JSON

SERIALIZATION = "json"  # of the messages
ENCODING = "jsonschema"  # of the schema


def payload(topic: str, type: str) -> type[RunPayload] | None:
    """The payload of a topic by its full name and message type; None: it has none."""
    return PAYLOADS.get(topic.rpartition("/")[2]) if type == JSON else None


def name(kind: type[RunPayload]) -> str:
    """Name of a payload's schema."""
    return f"uav_dc_ros.{kind.__name__}"


NAMES = frozenset(map(name, PAYLOADS.values()))


def check(data: bytes, kind: type[RunPayload]) -> bytes:
    """The text of a std_msgs/String; raises MessageError if there is none, or it is no such payload."""
    text = cdr.decode_string(data)
    messages.decode(text, kind)
    return text


@cache
def schema(kind: type[RunPayload]) -> bytes:
    """JSON Schema (2020-12) of a payload's channel."""
    whole = json.loads(messages.schema_text(kind))
    definitions: dict[str, dict[str, Any]] = whole["$defs"]

    def resolved(field: dict[str, Any]) -> dict[str, Any]:
        if "$ref" in field:
            field = definitions[field["$ref"].rpartition("/")[2]] | field
        found = {key: value for key, value in field.items() if key != "$ref"}
        if "enum" in found:
            found.setdefault("type", "string")
        if "anyOf" in found:
            found["anyOf"] = [resolved(one) for one in found["anyOf"]]
        if "prefixItems" in found:  # all alike, as many as minItems and maxItems
            found["items"] = found.pop("prefixItems")[0]
        return found

    root = resolved(whole)
    fields = {key: resolved(field) for key, field in root.pop("properties").items()}
    root["properties"] = {key: field for key, field in fields.items() if "type" in field}
    root["patternProperties"] = {f"^{key}$": field for key, field in fields.items() if "type" not in field}
    del root["$defs"]
    return json.dumps(root, indent=2).encode()
