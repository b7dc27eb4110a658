"""The paper's figures as printed, and the page's prose about them.

`published.json` has tables, captions and numbers of the text by table, row and eye.
Tests read them against lines quoted from the paper (`tests/data/paper_quotes.txt`).
`words.toml` says of each table and figure what the paper shows and what differs.
"""

import json
import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from tests.benchmarks.paper_page.rows import Block, Section

FOLDER = Path(__file__).parent
KINDS = {"Table": "tables", "Figure": "figures"}
TABLES = tuple(range(3, 12))
FIGURES = (1, 9, 10, 11, 12)


@cache
def published() -> dict:
    """Return everything."""
    return json.loads((FOLDER / "published.json").read_text(encoding="utf-8"))


def table(number: int) -> dict:
    """Rows of a table; their keys are measures, methods, scenes and eyes."""
    return published()["tables"][str(number)]["rows"]


@cache
def words() -> dict:
    """Return the prose of the page, and the names that it shows."""
    return tomllib.loads((FOLDER / "words.toml").read_text(encoding="utf-8"))


def section(
    number: str,
    origins: Sequence[str],
    blocks: Sequence[Block],
    *,
    entry: str = "",
    picture: str = "",
    **values: str,
) -> Section:
    """Make a section of blocks and its words.

    Parameters
    ----------
    number : str
        As "Table 7".
    entry : str
        Which one of `words.toml`; that of ``number`` where it is empty.
    **values : str
        What stands for the {names} there.
    """
    said = words()[entry or number]
    gpu = published()["text"]["hardware"]["gpu"]
    known = {**words()["common"], "gpu": gpu, **values}
    kind, _, own = number.partition(" ")
    return Section(
        number,
        said.get("title") or published()[KINDS[kind]][own]["caption"],
        said["shows"].format(**known),
        said["finding"].format(**known),
        tuple(origins),
        tuple(blocks),
        picture=picture,
        picture_says=said.get("picture", "").format(**known),
        missing=said.get("missing", "").format(**known),
        notes=tuple(note.format(**known) for note in said.get("notes", ())),
    )
