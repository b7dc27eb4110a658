"""JSON Schema of messages and profiles, and the tables of profiles in PROTOCOL.md.

    python -m filter_service.protocol_schema

writes ``protocol.schema.json`` (headers of all messages) and ``profile.schema.json``
(bodies of profiles) for clients in other languages, and the tables in section 10 of
``PROTOCOL.md``.  PROTOCOL.md states rules that a schema cannot express, such as the
size of a part.
"""

from __future__ import annotations

import inspect
import json
import re
from pathlib import Path
from typing import Any

import msgspec

from estimator.profiles.reference import profile_schema, profile_tables
from filter_service.messages import PROTOCOL_VERSION, REPLIES, REQUESTS

FOLDER = Path(__file__).resolve().parent
SCHEMA_FILE = FOLDER / "protocol.schema.json"
PROFILE_SCHEMA_FILE = FOLDER / "profile.schema.json"
DOCUMENT = FOLDER / "PROTOCOL.md"
TABLES_START, TABLES_END = (
    "<!-- profile tables: start -->",
    "<!-- profile tables: end -->",
)
SECTION = re.compile(r"\n\n\w+\n-{3,}\n")
"""Start of a docstring's numpydoc sections, which are not part of descriptions."""

DRAFT = "https://json-schema.org/draft/2020-12/schema"


def protocol_schema() -> dict[str, Any]:
    """Return the schema of a header, which ``type`` distinguishes."""
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


def generated_files() -> dict[Path, str]:
    """Return the text of every file with generated content."""
    document = DOCUMENT.read_text(encoding="utf-8")
    before, rest = document.split(TABLES_START)
    after = rest.split(TABLES_END)[1]
    tables = f"{TABLES_START}\n{profile_tables()}{TABLES_END}"
    return {
        SCHEMA_FILE: _as_text(protocol_schema()),
        PROFILE_SCHEMA_FILE: _as_text(profile_schema()),
        DOCUMENT: f"{before}{tables}{after}",
    }


def _as_text(schema: dict[str, Any]) -> str:
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for path, text in generated_files().items():
        path.write_text(text, encoding="utf-8")
