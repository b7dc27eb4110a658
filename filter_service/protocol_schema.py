"""The headers of all messages as JSON Schema, for clients in other languages.

    python -m filter_service.protocol_schema

writes ``filter_service/protocol.schema.json``.  Rules that a schema cannot express (an
edge on the wrong side, the size of a part) are in PROTOCOL.md.
"""

from __future__ import annotations

import inspect
import json
import re
from pathlib import Path
from typing import Any

import msgspec

from filter_service.messages import PROTOCOL_VERSION, REPLIES, REQUESTS

SCHEMA_FILE = Path(__file__).resolve().parent / "protocol.schema.json"
SECTION = re.compile(r"\n\n\w+\n-{3,}\n")
"""Start of a docstring's numpydoc sections, which concern Python only."""

DRAFT = "https://json-schema.org/draft/2020-12/schema"


def protocol_schema() -> dict[str, Any]:
    """Return the schema of a header: one of the messages, distinguished by ``type``."""
    kinds = [*REQUESTS.values(), *REPLIES.values()]
    _, parts = msgspec.json.schema_components(kinds, ref_template="#/$defs/{name}")
    for kind in kinds:
        schema = parts[kind.__name__]
        schema["properties"].pop(kind.payload, None)
        schema["properties"] = {
            "type": {"const": kind.type_name},
            "version": {"const": PROTOCOL_VERSION},
            **schema["properties"],
        }
        schema["required"] = ["type", "version", *schema["required"]]
    for schema in parts.values():
        if "description" in schema:
            text = inspect.cleandoc(schema["description"])
            schema["description"] = SECTION.split(text)[0]
    return {
        "$schema": DRAFT,
        "title": f"Headers of the filter service's protocol {PROTOCOL_VERSION}",
        "oneOf": [{"$ref": f"#/$defs/{kind.__name__}"} for kind in kinds],
        "$defs": dict(sorted(parts.items())),
    }


def schema_text() -> str:
    """Return the schema as the text of its file."""
    return json.dumps(protocol_schema(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    SCHEMA_FILE.write_text(schema_text(), encoding="utf-8")
