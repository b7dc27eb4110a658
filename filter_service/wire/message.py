"""Base class of messages: header fields with annotated types, and parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Self

from msgspec import Meta

from filter_service.errors import BadMessage
from filter_service.validation import Record, checked

DEFAULT_ENDPOINT = "tcp://127.0.0.1:5577"

Part = bytes | bytearray | memoryview

MAX_ID = 2**53 - 1  # exact as a double, as in JSON and JavaScript
MAX_NOTES = 8
MAX_NOTE_BYTES = 200
MAX_NOTE_VALUE = 1e12
MAX_DEVICES = 8

Id = Annotated[int, Meta(ge=0, le=MAX_ID)]
Count = Id
ShortText = Annotated[str, Meta(max_length=100)]
Text = Annotated[str, Meta(max_length=2048)]
NoteValue = Annotated[float, Meta(ge=-MAX_NOTE_VALUE, le=MAX_NOTE_VALUE)]
Notes = Annotated[tuple[Text, ...], Meta(max_length=MAX_NOTES)]
Milliseconds = Annotated[float, Meta(ge=0.0, le=1e12)]
Timestamp = Annotated[float, Meta(ge=-1e18, le=1e18)]
Megabytes = Annotated[float, Meta(ge=0.0, le=1e9)]
Nanoseconds = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Size = Annotated[int, Meta(ge=1, le=2**40)]


@dataclass(frozen=True)
class NoteDetail(Record):
    """The cause of a note and its numbers, by names that end in their unit."""

    code: ShortText
    values: dict[ShortText, NoteValue] = field(default_factory=dict)

    @classmethod
    def of(cls, note: str) -> Self:
        """Return the details of an `estimator.note.Note`, or "other" of other text.

        Numbers that are not finite are left out.  Clients, which import this module, do
        not import the estimator.
        """
        values = getattr(note, "values", {})
        numbers = {n: v for n, v in values.items() if abs(v) <= MAX_NOTE_VALUE}
        return cls(getattr(note, "code", "other"), numbers)

    @property
    def size_bytes(self) -> int:
        """Return about the size of the details in a header."""
        return 20 + len(self.code) + sum(12 + len(name) for name in self.values)


@dataclass(frozen=True)
class Limits(Record):
    """Limits of a service, published in ``welcome``."""

    max_width_px: Size = 4096
    max_height_px: Size = 4096
    max_views: Size = 2
    max_part_bytes: Size = 100_000_000  # 3840 x 2160 linear float32 color fits
    max_profile_bytes: Size = 2**20

    def with_limits(self, error: BadMessage) -> BadMessage:
        """Return the error with this service's limits instead of the protocol's."""
        name, allowed = (error.field or "").rpartition(".")[2], error.allowed
        if allowed and allowed.startswith(("an integer", "a list")):
            allowed = {
                "width_px": f"an integer 1 to {self.max_width_px}",
                "height_px": f"an integer 1 to {self.max_height_px}",
                "views": f"a list of 1 to {self.max_views} items",
            }.get(name, allowed)
        return BadMessage(error.message, field=error.field, allowed=allowed)


@dataclass(frozen=True)
class Message(Record):
    """Base class of all messages: frozen dataclasses of header fields.

    Attributes
    ----------
    payload : str
        Name of the field that is sent as separate parts; empty for most messages.
    """

    type_name: ClassVar[str]
    payload: ClassVar[str] = ""

    def fields(self) -> dict[str, Any]:
        """Return the header fields, without those that are None."""
        fields = super().fields()
        fields.pop(self.payload, None)
        return fields

    def parts(self) -> list[Any]:
        """Return the parts that follow the header."""
        return []

    @classmethod
    def parse(
        cls, header: Mapping[str, Any], parts: Sequence[Part], limits: Limits
    ) -> Self:
        """Validate a header and its parts, and return the message.

        Raises
        ------
        BadMessage
            If a field is invalid; the error has its path, value and allowed values.
        """
        given = {name: value for name, value in header.items() if name != cls.payload}
        return checked(given, cls).with_parts(parts, limits)

    def with_parts(self, parts: Sequence[Part], limits: Limits) -> Self:
        """Return the message with its parts; most messages have none."""
        expect_parts(parts, 0)
        return self

    def _with_payload(self, value: object) -> Self:
        return replace(self, **{self.payload: value})


def expect_parts(parts: Sequence[Part], count: int) -> None:
    """Raise BadMessage unless exactly ``count`` parts follow the header."""
    if len(parts) != count:
        raise BadMessage(
            f"{len(parts)} parts follow the header",
            field="parts",
            allowed=f"{count} parts",
        )


def clip(text: str, max_bytes: int) -> str:
    """Return a text, truncated with "..." if its UTF-8 form is too long."""
    encoded = text.encode("utf-8", "replace")
    if len(encoded) <= max_bytes:
        return encoded.decode("utf-8")
    return encoded[: max_bytes - 3].decode("utf-8", "ignore") + "..."


def fit_notes(
    notes: Sequence[str], details: Sequence[NoteDetail], max_count: int, max_bytes: int
) -> tuple[tuple[str, ...], tuple[NoteDetail, ...]]:
    """Return the first notes with their details, truncated to fit into a header.

    Parameters
    ----------
    notes : sequence of str
    details : sequence of NoteDetail
        Those of a received message; otherwise each note has its own.
    """
    fitting: list[str] = []
    found: list[NoteDetail] = []
    for i, note in enumerate(notes[:max_count]):
        detail = details[i] if i < len(details) else NoteDetail.of(note)
        text = clip(note, MAX_NOTE_BYTES)
        max_bytes -= len(text.encode("utf-8")) + detail.size_bytes
        if fitting and max_bytes < 0:
            break
        fitting.append(text)
        found.append(detail)
    return tuple(fitting), tuple(found)
