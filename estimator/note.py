"""Notes for the user, with codes and numbers for programs.

This module uses the standard library only, so that any package may import it.
"""

from __future__ import annotations

from typing import Any, Self


class Note(str):
    """A sentence for the user, with a code that does not depend on its numbers.

    Parameters
    ----------
    code : str
        Name of the cause, for example ``focus_beyond_far_point``.
    text : str
        The sentence.
    **values : float
        Its numbers, by names that end in their unit.

    Attributes
    ----------
    code : str
    values : dict of float
    """

    code: str
    values: dict[str, float]

    def __new__(cls, code: str, text: str, /, **values: float) -> Self:
        """Return the text as a note."""
        note = super().__new__(cls, text)
        note.code = code
        note.values = {name: float(value) for name, value in values.items()}
        return note

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the arguments of `note_of`, for pickle."""
        return note_of, (self.code, str(self), self.values)

    def with_prefix(self, prefix: str) -> Note:
        """Return the same note with text in front."""
        return note_of(self.code, prefix + self, self.values)


def note_of(code: str, text: str, values: dict[str, float]) -> Note:
    """Return a note from its code, its text and its numbers."""
    return Note(code, text, **values)
