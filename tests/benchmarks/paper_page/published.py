"""The paper's figures, as printed: tables, captions and numbers of its text.

`published.json` holds them by table, row and eye.  Tests read them against lines quoted
from the paper (`tests/data/paper_quotes.txt`).
"""

import json
from functools import cache
from pathlib import Path

PATH = Path(__file__).parent / "published.json"

TABLES = tuple(range(3, 12))
FIGURES = (1, 9, 10, 11, 12)


@cache
def published() -> dict:
    """Return everything."""
    return json.loads(PATH.read_text(encoding="utf-8"))


def table(number: int) -> dict:
    """Rows of a table; their keys are measures, methods, scenes and eyes."""
    return published()["tables"][str(number)]["rows"]


def caption(kind: str, number: int) -> str:
    """Caption of one of the ``tables`` or ``figures``, shortened."""
    return published()[kind][str(number)]["caption"]
