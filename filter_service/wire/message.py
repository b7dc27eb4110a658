"""Base class of messages: header fields with annotated types, and parts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Annotated, Any, ClassVar, Self

import msgpack
from msgspec import Meta, MsgspecError, Struct, convert
from msgspec import msgpack as msgspec_msgpack

from filter_service.errors import BadMessage
from filter_service.validation import Record, checked, show

MAX_HEADER_BYTES = 4096
MAX_DEPTH = 32
"""Maximum nesting depth of maps and lists."""

MAX_BITS = 64
"""Maximum size of an integer: the limit of msgpack, applied to JSON, too."""

MAX_TEXT = 4096
"""Maximum number of characters of a text in a profile."""

MAX_ITEMS = 16_384
"""Maximum number of items in all maps and lists of a profile: 100 measurements of 28
coefficients have 3,400.  Refusing a megabyte with more takes 1 ms; parsing it took
300."""

# Nested arrays are the most expensive input: 64 KiB of them took 98 ms without a limit
# of their length, and 0.03 ms with a limit of 64.
_HEADER_BOUNDS = {
    "max_str_len": 2048,
    "max_bin_len": 0,
    "max_array_len": 64,
    "max_map_len": 64,
    "max_ext_len": 0,
}
# A profile may contain measurements: 28 coefficients at a few hundred angles.
_PROFILE_BOUNDS = {
    "max_str_len": MAX_TEXT,
    "max_bin_len": 0,
    "max_array_len": 4096,
    "max_map_len": 4096,
    "max_ext_len": 0,
}


def unpack_header(data: bytes | bytearray | memoryview) -> dict[str, Any]:
    """Return the header map of a message.

    Parameters
    ----------
    data : bytes-like, at most MAX_HEADER_BYTES
        The first part of a message.

    Raises
    ------
    BadMessage
        If it is too long, not msgpack or not a map, or has a repeated or non-text key.
    """
    size_bytes = memoryview(data).nbytes
    if size_bytes > MAX_HEADER_BYTES:
        raise BadMessage(
            f"the header has {size_bytes} bytes",
            field="header",
            allowed=f"1 to {MAX_HEADER_BYTES} bytes",
        )
    # It is too short to have more than MAX_ITEMS items.
    header = _unpacked(data, "header", _HEADER_BOUNDS, object_pairs_hook=_unique_keys)
    if not isinstance(header, dict):
        raise BadMessage(
            f"it is {show(header)}", field="header", allowed="a msgpack map"
        )
    _check_depth(header, "header")  # other limits are _HEADER_BOUNDS or msgpack's own
    return header


def check_profile_size(data: bytes | bytearray | memoryview, max_bytes: int) -> None:
    """Check the size of a profile before it is unpacked.

    Raises
    ------
    BadMessage
        If it is empty or too long.
    """
    size_bytes = memoryview(data).nbytes
    if not 1 <= size_bytes <= max_bytes:
        raise BadMessage(
            f"the profile has {size_bytes} bytes",
            field="profile",
            allowed=f"1 to {max_bytes} bytes",
        )


def unpack_profile(body: bytes) -> dict[str, Any]:
    """Return the profile map from its part, JSON or msgpack.

    A JSON object starts with ``{`` or white space; a msgpack map starts with neither.

    Raises
    ------
    BadMessage
        If it is neither of the two, or has a repeated key or a non-finite number.
    """
    if body.lstrip()[:1] == b"{":
        profile = _load_json(body)
    else:
        items = _Items()
        profile = _unpacked(
            *(body, "profile", _PROFILE_BOUNDS),
            list_hook=items.count_list,
            object_pairs_hook=items.count_map,
        )
    if not isinstance(profile, dict):
        raise BadMessage(
            f"it is {show(profile)}", field="profile", allowed="a JSON or msgpack map"
        )
    _check_values(profile, "profile")
    return profile


class _Items:
    """Counts the items of maps and lists during parsing, to stop early."""

    def __init__(self) -> None:
        self._count = 0

    def _add(self, count: int) -> None:
        self._count += 1 + count
        if self._count > MAX_ITEMS:
            raise ValueError(f"it has more than {MAX_ITEMS} items")

    def count_list(self, items: list[object]) -> list[object]:
        """Count a list."""
        self._add(len(items))
        return items

    def count_map(self, pairs: list[tuple[object, object]]) -> dict[str, object]:
        """Count the pairs of a map, and return the map."""
        self._add(len(pairs))
        return _unique_keys(pairs)


def _unpacked(
    data: bytes | bytearray | memoryview,
    field: str,
    bounds: Mapping[str, int],
    **hooks: Callable[[Any], object],
) -> object:
    try:
        return msgpack.unpackb(
            data,
            raw=False,
            use_list=True,
            strict_map_key=False,  # the error of _unique_keys includes the key
            ext_hook=_reject_extension,
            **bounds,
            **hooks,
        )
    except (ValueError, msgpack.UnpackException) as error:
        reason = str(error) or type(error).__name__
        raise BadMessage(
            f"it cannot be read: {show(reason)}",
            field=field,
            allowed="one msgpack value with text keys, no repeats, no extension types",
        ) from None


def _unique_keys(pairs: list[tuple[object, object]]) -> dict[str, object]:
    """Return the pairs as a dict; raise ValueError for repeated or non-text keys."""
    try:
        result: dict[str, object] = dict(pairs)  # type: ignore[arg-type]
    except TypeError:  # a key is a list or a map
        result = {}
    if len(result) == len(pairs) and set(map(type, result)) <= {str}:
        return result
    result = {}
    for key, value in pairs:
        if not isinstance(key, str):
            raise ValueError(f"a key is {show(key)}, not text")
        if key in result:
            raise ValueError(f"the key {show(key)} appears twice")
        result[key] = value
    return result


def _reject_extension(code: int, _data: bytes) -> object:
    raise ValueError(f"extension type {code} is not supported")


def _load_json(body: bytes) -> object:
    # Imported here because clients parse no profiles and do not need the package.
    from estimator.bounded_files import loads_bounded

    try:
        return loads_bounded(body, max_bytes=len(body), max_items=MAX_ITEMS)
    except ValueError as error:
        raise BadMessage(
            f"it cannot be read as JSON: {show(str(error))}",
            field="profile",
            allowed=f"one JSON object of up to {MAX_ITEMS} items, no key repeated",
        ) from None


_Path = tuple[Any, Any]
"""Path of a value: the path of its map or list, and its key there."""


def _check_depth(root: object, name: str) -> None:
    """Raise BadMessage for lists and maps that are nested too deep."""
    level: list[Any] = [root]
    depth = 1
    while level:
        if depth > MAX_DEPTH:
            raise BadMessage(
                f"lists and maps are nested {depth} deep",
                field=name,
                allowed=f"at most {MAX_DEPTH}",
            )
        level = [
            item
            for value in level
            for item in (value.values() if isinstance(value, dict) else value)
            if isinstance(item, dict | list)
        ]
        depth += 1


def _check_values(root: object, name: str) -> None:
    """Raise BadMessage for values that a profile must not contain.

    These are values nested too deep, texts and integers that are too large, and numbers
    that are not finite.  This does not recurse, and formats a path only for an invalid
    value.
    """
    _check_depth(root, name)
    waiting: list[tuple[_Path, object]] = [((None, name), root)]
    while waiting:
        path, value = waiting.pop()
        pairs: Iterable[tuple[Any, Any]]
        if isinstance(value, dict):
            pairs = value.items()
        elif isinstance(value, list):
            pairs = enumerate(value)
        else:
            continue
        for key, item in pairs:
            if isinstance(item, float):
                if not math.isfinite(item):
                    raise BadMessage(
                        f"it is {item!r}",
                        field=_format_path((path, key)),
                        allowed="a finite number",
                    )
            elif isinstance(item, dict | list):
                waiting.append(((path, key), item))
            elif isinstance(item, str):
                if len(item) > MAX_TEXT:
                    raise BadMessage(
                        f"it has {len(item)} characters",
                        field=_format_path((path, key)),
                        allowed=f"at most {MAX_TEXT} characters",
                    )
            elif isinstance(item, int) and item.bit_length() > MAX_BITS:
                raise BadMessage(
                    f"it is an integer of {item.bit_length()} bits",
                    field=_format_path((path, key)),
                    allowed=f"at most {MAX_BITS} bits",
                )


def _format_path(path: _Path | None) -> str:
    steps: list[str] = []
    while path is not None:
        path, key = path
        steps.append(f"[{key}]" if isinstance(key, int) else f".{key}")
    return "".join(reversed(steps)).removeprefix(".")


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
        given = header
        if cls.payload in header:
            given = {name: v for name, v in header.items() if name != cls.payload}
        return checked(given, cls).with_parts(parts, limits)

    def with_parts(self, parts: Sequence[Part], limits: Limits) -> Self:
        """Return the message with its parts; most messages have none."""
        expect_parts(parts, 0)
        return self

    @classmethod
    def changed(cls, message: Message, **values: object) -> Self:
        """Return a valid message, of this type, with other values of some fields.

        It is not validated again, unlike by `dataclasses.replace`.
        """
        found = object.__new__(cls)
        vars(found).update(vars(message), **values)
        return found

    def _with_payload(self, value: object) -> Self:
        return self.changed(self, **{self.payload: value})


class _Head(Struct):
    """The fields that all messages have."""

    type: str
    version: int


@cache
def _decoder(kind: Any) -> msgspec_msgpack.Decoder[Any]:
    return msgspec_msgpack.Decoder(kind)


def plain_message(
    data: Part, kinds: Mapping[str, type[Message]], version: int
) -> Message | None:
    """Return the message of a header of the service, without its parts.

    This takes half the time of `unpack_header` and `Message.parse`, and validates all
    known fields; it does not look for repeated keys and strange values of others.
    Returns None for a header that those have to examine.
    """
    if memoryview(data).nbytes > MAX_HEADER_BYTES:
        return None
    try:
        head = _decoder(_Head).decode(data)
        if head.version != version or head.type not in kinds:
            return None
        kind: Any = kinds[head.type]  # mypy takes no class with fields as hashable
        found: Message = _decoder(kind).decode(data)
    except MsgspecError:
        return None
    return None if getattr(found, found.payload, ()) else found


_unpack_any = msgspec_msgpack.Decoder().decode
_pack_any = msgspec_msgpack.Encoder().encode


@cache
def _names_of(kind: type[Message]) -> frozenset[str]:
    """Return the keys of a header of a kind of message."""
    names = {field.name for field in fields(kind)} - {kind.payload}
    return frozenset(names | {"type", "version"})


def plain_request(
    data: Part, kinds: Mapping[str, type[Message]], version: int
) -> Message | None:
    """Return the message of a client's header, without its parts.

    This takes a third of the time of `unpack_header` and `Message.parse`, in a service
    that was idle, because it runs less code.  Returns None for a header that those have
    to examine: data that equals the packed value of its map has no repeated keys.
    """
    if memoryview(data).nbytes > MAX_HEADER_BYTES:
        return None
    try:
        header = _unpack_any(data)
        if type(header) is not dict or _pack_any(header) != data:
            return None
        name = header.get("type")
        kind: Any = kinds.get(name) if type(name) is str else None
        if kind is None or header.keys() - _names_of(kind):
            return None
        if type(header["version"]) is not int or header["version"] != version:
            return None
        found: Message = convert(header, kind)
    except (MsgspecError, KeyError, TypeError, ValueError, RecursionError):
        return None
    return found


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
        Details of a received message; otherwise each note has its own.
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
