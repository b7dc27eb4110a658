"""Bounded reading of untrusted files: bytes, text, JSON and TOML.

Every reader in this project raises `InvalidFile` for a file that it cannot use,
whatever the underlying library raised, and checks size limits before reading.
This module uses the standard library only, so that any package may import it.
"""

from __future__ import annotations

import json
import os
import re
import stat
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MAX_BITS = 64
"""Size limit of a JSON integer, as in msgpack: profiles accept the same in both."""

MAX_DIGITS = 20
"""Digit limit of a JSON integer, without its sign; parsing time is quadratic."""

MAX_DEPTH = 32
"""Nesting limit of JSON objects and arrays.  A glTF file has 8, a profile 4."""

MAX_ITEMS = 100_000
"""Limit of JSON values.  66 coefficients at 400 field directions are 27,000."""

MAX_TEXT_BYTES = 8_000_000
MAX_TEXT_LINES = 200_000
"""Line limit of a text file; a list of frames at 30 Hz may cover two hours."""

_READ_BYTES = 1 << 20
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


class InvalidFile(ValueError):
    """A file that cannot be used: wrong type, damaged, or beyond a limit.

    Attributes
    ----------
    path : str
        The file, as the user named it.
    found : str
        Description of the problem.
    allowed : str
        Accepted content; may be empty.
    option : str
        Command-line option that named the file; may be empty.
    """

    def __init__(
        self, path: str | Path, found: str, allowed: str = "", option: str = ""
    ) -> None:
        ValueError.__init__(self, str(path), found, allowed, option)  # for pickle
        self.path = str(path)
        self.found = found
        self.allowed = allowed
        self.option = option

    def __str__(self) -> str:
        """Return one line with option, file, problem and accepted content."""
        where = f"--{self.option} '{self.path}'" if self.option else f"'{self.path}'"
        text = f"{where}: {self.found}"
        return printable(f"{text}; allowed: {self.allowed}" if self.allowed else text)


MAX_LINE_CHARACTERS = 4000
"""Length limit of a message; a path may have 4095 bytes."""


def printable(text: str, *, most: int = MAX_LINE_CHARACTERS) -> str:
    """Return untrusted text as one line that no terminal or log misreads.

    Line breaks, control characters, changes of direction and halves of surrogate pairs
    become escapes as in Python; text beyond ``most`` characters becomes "...".
    """
    if len(text) > most:
        text = text[: most - 3] + "..."
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def reason_of(error: BaseException) -> str:
    """Return an exception's text as part of one line, or its type if it has none."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text = " ".join(str(error).split())[:200]
    kind = type(error).__name__
    return (
        text if text and not isinstance(error, KeyError) else f"{kind} {text}".strip()
    )


def read_bytes(path: Path, *, max_bytes: int, option: str = "") -> bytes:
    """Return the content of a regular file of at most ``max_bytes``.

    Raises
    ------
    InvalidFile
        Missing, not a regular file, unreadable, or too large.
    """
    try:
        with open(path, "rb", buffering=0, opener=_open_at_once) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise InvalidFile(path, "not a regular file", "a file", option)
            parts, size = [], status.st_size
            if size <= max_bytes:  # count again: the file may grow while it is read
                size = 0
                # In one part if the file keeps its size, which then is not copied.
                n_wanted = max(_READ_BYTES, status.st_size + 1)
                while size <= max_bytes and (part := file.read(n_wanted)):
                    parts.append(part)
                    size += len(part)
                    n_wanted = _READ_BYTES
    except IsADirectoryError:
        raise InvalidFile(path, "not a regular file", "a file", option) from None
    except FileNotFoundError:
        raise InvalidFile(path, "no such file", "a file that exists", option) from None
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        if isinstance(error, InvalidFile):
            raise
        raise InvalidFile(
            path, f"cannot be read ({reason_of(error)})", "a readable file", option
        ) from None
    if size > max_bytes:
        raise InvalidFile(
            path, f"{size:,} bytes", f"at most {max_bytes:,} bytes", option
        )
    return b"".join(parts)


def _open_at_once(path: str, flags: int) -> int:
    """Open a file without blocking, even a FIFO that has no writer."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))  # not on Windows


def read_text(
    path: Path,
    *,
    max_bytes: int = MAX_TEXT_BYTES,
    max_lines: int = MAX_TEXT_LINES,
    option: str = "",
) -> str:
    """Return the text of a UTF-8 file of bounded size, without a byte order mark.

    Raises
    ------
    InvalidFile
        As `read_bytes`; not UTF-8, a null character, or too many lines.
    """
    content = read_bytes(path, max_bytes=max_bytes, option=option)
    n_lines = content.count(b"\n") + content.count(b"\r")
    if n_lines > max_lines:
        raise InvalidFile(path, f"{n_lines:,} lines", f"at most {max_lines:,}", option)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InvalidFile(path, "is not a text file", "UTF-8 text", option) from None
    if "\0" in text:
        raise InvalidFile(path, "is not a text file", "UTF-8 text", option)
    return text


def read_json(
    path: Path,
    *,
    max_bytes: int = MAX_TEXT_BYTES,
    max_depth: int = MAX_DEPTH,
    max_items: int = MAX_ITEMS,
    option: str = "",
) -> Any:
    """Return the value of a JSON file within bounds; see `loads_bounded`.

    Raises
    ------
    InvalidFile
    """
    content = read_bytes(path, max_bytes=max_bytes, option=option)
    try:
        return loads_bounded(
            content, max_bytes=max_bytes, max_depth=max_depth, max_items=max_items
        )
    except ValueError as error:
        raise InvalidFile(path, f"not JSON ({error})", "JSON", option) from None


def read_toml(
    path: Path, *, max_bytes: int = MAX_TEXT_BYTES, option: str = ""
) -> dict[str, Any]:
    """Return the table of a TOML file.

    Raises
    ------
    InvalidFile
    """
    text = read_text(path, max_bytes=max_bytes, option=option)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidFile(
            path, f"not TOML ({reason_of(error)})", "TOML", option
        ) from None


def loads_bounded(
    data: bytes,
    *,
    max_bytes: int,
    max_depth: int = MAX_DEPTH,
    max_items: int = MAX_ITEMS,
    finite: bool = False,
) -> Any:
    """Return the value of a JSON text; reject oversized text before parsing it.

    Commas and opening brackets are counted first, at the speed of `bytes.count`: each
    value of the result needs one of them, so their number bounds its memory.

    Parameters
    ----------
    data : bytes
        UTF-8 text, with or without a byte order mark.
    max_bytes, max_depth, max_items : int
        Limits of the text size, of nesting, and of the number of values.
    finite : bool
        Whether to reject NaN, infinity and numbers beyond float64.

    Raises
    ------
    ValueError
        A limit is exceeded, the text is not JSON, an object repeats a key, an integer
        has more than 64 bits, or text contains half a surrogate pair.
    """
    if len(data) > max_bytes:
        raise ValueError(f"{len(data):,} bytes; allowed: at most {max_bytes:,}")
    n_items = 1 + data.count(b",") + data.count(b"[") + data.count(b"{")
    if n_items > max_items:
        raise ValueError(f"more than {max_items:,} values; allowed: at most that many")
    text = data.decode("utf-8-sig")
    try:
        value = json.loads(
            text,
            object_pairs_hook=_without_repeats,
            parse_constant=_refuse_constant if finite else None,
            parse_int=_bounded_integer,
        )
    except RecursionError:
        raise ValueError(_depth_text(max_depth)) from None
    check_values(
        value,
        max_depth=max_depth,
        finite=finite,
        whole_text=_SURROGATE.search(text) is not None,
    )
    return value


def check_values(
    root: object,
    *,
    max_depth: int = MAX_DEPTH,
    finite: bool = False,
    whole_text: bool = True,
) -> None:
    """Reject deep nesting and integers of more than 64 bits, without recursion.

    Parameters
    ----------
    finite : bool
        Whether to reject infinity and NaN as well.
    whole_text : bool
        Whether to reject text with half a surrogate pair, which cannot be printed.

    Raises
    ------
    ValueError
    """
    level: list[Any] = [root]
    depth = 0
    while level:
        inner: list[Any] = []
        for value in level:
            kind = type(value)
            if (kind is dict or kind is list) and depth >= max_depth:
                raise ValueError(_depth_text(max_depth))
            if kind is dict:
                inner += value.values()
                if whole_text:
                    inner += value
            elif kind is list:
                inner += value
            elif kind is int:
                if value.bit_length() > MAX_BITS:
                    raise ValueError(
                        f"an integer of {value.bit_length()} bits; allowed: at most "
                        f"{MAX_BITS}"
                    )
            elif kind is float:
                if finite and not -_INFINITY < value < _INFINITY:
                    raise ValueError(f"{value!r}; allowed: finite numbers")
            elif kind is str and whole_text:
                _refuse_half_pair(value)
        level, depth = inner, depth + 1


_INFINITY = float("inf")


def _depth_text(max_depth: int) -> str:
    return f"objects or arrays more than {max_depth} deep; allowed: at most {max_depth}"


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"{twice[:60]!r} is given twice; allowed: each key once")
    return result


def _bounded_integer(text: str) -> int:
    n_digits = len(text.lstrip("-"))
    if n_digits > MAX_DIGITS:
        raise ValueError(
            f"an integer of {n_digits} digits; allowed: at most {MAX_DIGITS}"
        )
    return int(text)


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name}; allowed: finite numbers")


def _refuse_half_pair(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(
            "text with half a surrogate pair; allowed: Unicode text"
        ) from None


def numbered_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text with their numbers, starting at one."""
    return enumerate(text.splitlines(), start=1)
