"""What people were found to read through worn lenses, beside what ours let them."""

from collections.abc import Iterator

import numpy as np

from tests.worn_by_people import (
    TABLES,
    corridor_width_mm,
    lost_by_lenslets,
    read_through_focus,
)

Found = tuple[str, str, str, float, str]
"""Case, setting with our value, name of the error, ours less theirs, source."""


def found_in_people() -> Iterator[Found]:
    """Extended depth of focus, lenslets and a progressive lens."""
    yield from _edof()
    yield from _lenslets()
    table, width_mm = TABLES["progressive"], corridor_width_mm()
    yield (
        *("progressive", f"corridor's width: {width_mm:.2f} mm", "mm"),
        *(width_mm - table["width_mm"], table["source"]),
    )


def _edof() -> Iterator[Found]:
    table = TABLES["edof"]

    def beside(setting: str, log_mar: float, expected: float) -> Found:
        error = log_mar - expected
        named = f"{setting}: {log_mar:.2f}"
        return "Symfony", named, "logMAR", error, table["source"]

    flat = read_through_focus(np.arange(0.0, table["flat_to_dpt"] + 0.1, 0.25))
    to = f"to {table['flat_to_dpt']:g} dpt"
    yield beside(f"best {to}", float(flat.min()), table["best_log_mar"])
    yield beside(f"worst {to}", float(flat.max()), table["worst_log_mar"])
    for dpt, expected in table["log_mar_by_dpt"].items():
        found = float(read_through_focus([float(dpt)])[0])
        yield beside(f"at {dpt} dpt", found, expected)


def _lenslets() -> Iterator[Found]:
    table = TABLES["lenslets"]
    log_mar, log_contrast = lost_by_lenslets()
    for name, lost, published in (
        ("logMAR", log_mar, table["lost_log_mar"]),
        ("log contrast", log_contrast, table["lost_log_contrast"]),
    ):
        for side, expected in published.items():
            setting = f"{name} lost, {side} gaze: {lost:.2f}"
            yield "DIMS", setting, name, lost - expected, table["source"]
