"""The page's prose, kept apart in `words.toml`, and sections made of it."""

import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from tests.benchmarks.paper_page.published import caption
from tests.benchmarks.paper_page.rows import Block, Section
from tests.benchmarks.published_figures import HARDWARE

PATH = Path(__file__).parent / "words.toml"
KINDS = {"Table": "tables", "Figure": "figures"}


@cache
def _all_words() -> dict:
    return tomllib.loads(PATH.read_text(encoding="utf-8"))


def section(
    number: str,
    origins: Sequence[str],
    blocks: Sequence[Block],
    *,
    words: str = "",
    picture: str = "",
    **values: str,
) -> Section:
    """Make a section of blocks and its words.

    Parameters
    ----------
    number : str
        As "Table 7".
    words : str
        Which entry of `words.toml`; that of ``number`` where it is empty.
    **values : str
        What stands for the {names} there.
    """
    said = _all_words()[words or number]
    known = {**_all_words()["common"], "gpu": HARDWARE, **values}
    kind, _, own = number.partition(" ")
    title = said.get("title") or caption(KINDS[kind], int(own))
    return Section(
        number,
        title,
        said["shows"].format(**known),
        said["finding"].format(**known),
        tuple(origins),
        tuple(blocks),
        picture=picture,
        picture_says=said.get("picture", "").format(**known),
        missing=said.get("missing", "").format(**known),
        notes=tuple(note.format(**known) for note in said.get("notes", ())),
    )
