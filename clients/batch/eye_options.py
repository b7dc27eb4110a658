"""Options that give each image an eye of its own: tables, drawn persons and banks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from clients.batch.eye_table import (
    LIMITS,
    EyeRow,
    is_table_of_eyes,
    read_eyes,
    settings_of_rows,
    with_rows,
)
from clients.batch.eyes import SYNTEYES, Drawn
from clients.batch.options import BatchOptions
from clients.batch.profiles import check_last_person, read_profiles
from clients.batch.source import SourceFrame, States
from clients.batch.views import Views
from clients.batch.work import FORMATS, VIDEO_FORMATS, checked_settings
from clients.commands.options import read_object
from clients.commands.state_options import listed_numbers
from filter_service import FilterSettings


def way_of_eyes(options: BatchOptions) -> str | None:
    """Return the option that gives each image its own eye, or None.

    Raises
    ------
    ValueError
        If options exclude each other, or none gives an eye.
    """
    ways = [
        f"--{name.replace('_', '-')}"
        for name in ("eyes", "sample_eyes", "bank")
        if getattr(options, name) is not None
    ]
    if options.states is not None:
        if not options.states.is_file():
            raise ValueError(f"--states '{options.states}': no such file")
        ways += ["--states"] if is_table_of_eyes(options.states) else []
    if len(ways) > 1:
        raise ValueError(f"{' and '.join(ways)} are given; allowed: one of them")
    if not ways and not options.profile:
        raise ValueError(
            "--profile is not given; allowed: --profile, --eyes, --sample-eyes or "
            "--bank"
        )
    way = ways[0] if ways else None
    is_drawn = way in ("--sample-eyes", "--bank")
    for name in ("sample_pupil_mm", "sample_focus_dpt"):
        if getattr(options, name) is not None and not is_drawn:
            raise ValueError(
                f"--{name.replace('_', '-')} is given; allowed with --sample-eyes or "
                "--bank"
            )
    return way


def check_own_eyes(options: BatchOptions, way: str) -> None:
    """Check that other options fit frames that have eyes of their own."""
    excluded = {
        "people": options.people is not None,
        "states": options.states is not None and way != "--states",
        "profile": bool(options.profile) and way == "--bank",
        "settings": options.settings != "{}" and way == "--bank",
    }
    for name, is_given in excluded.items():
        if is_given:
            raise ValueError(f"{way} and --{name} are given; allowed: one of them")
    if options.format in VIDEO_FORMATS:
        allowed = ", ".join(name for name in FORMATS if name not in VIDEO_FORMATS)
        raise ValueError(
            f"--format is {options.format}, with {way}; allowed: {allowed}"
        )


def rows_of(options: BatchOptions) -> list[EyeRow]:
    """Return the rows of a table of eyes, if there is one."""
    path, name = options.eyes, "eyes"
    if path is None and options.states is not None and is_table_of_eyes(options.states):
        path, name = options.states, "states"
    if path is None:
        return []
    if not path.is_file():
        raise ValueError(f"--{name} '{path}': no such file")
    return read_eyes(path, option=name, named=read_profiles(options.profile or ()))


def with_own_eyes(
    options: BatchOptions,
    views: Views,
    rows: Sequence[EyeRow],
    frames: Sequence[SourceFrame],
) -> tuple[list[SourceFrame], FilterSettings, dict[str, Any]]:
    """Return frames with their eyes, settings, and what determines the eyes."""
    given = read_object("--settings", options.settings)
    usual = States(views.pupils_mm[0], views.foci_dpt[0])
    distance_dpt = views.distances_dpt[0] if views.distances_dpt else None
    if rows:
        path = options.eyes or options.states
        assert path is not None
        settings = settings_of_rows(given, rows, usual, distance_dpt)
        found = with_rows(
            frames,
            rows,
            usual,
            gaze_deg=checked_settings(given).gaze_deg,
            path=path,
            source=options.source,
            option="states" if options.eyes is None else "eyes",
        )
        return found, settings, {}
    if distance_dpt is not None and usual.focus_dpt is None:
        usual = replace(usual, focus_dpt=distance_dpt)
    pupils_mm = _drawn_range("--sample-pupil-mm", options.sample_pupil_mm, "pupil_mm")
    foci_dpt = _drawn_range("--sample-focus-dpt", options.sample_focus_dpt, "focus_dpt")
    if foci_dpt is None and usual.focus_dpt is not None:
        foci_dpt = usual.focus_dpt, usual.focus_dpt
    count = options.sample_eyes or 0
    check_last_person("--sample-eyes", count, options.first_person)
    drawn = Drawn.of(
        options.bank,
        read_profiles(options.profile or ()) or SYNTEYES,
        count,
        options.first_person,
        seed=options.seed,
        pupil_range_mm=pupils_mm or (usual.pupil_mm, usual.pupil_mm),
        focus_range_dpt=foci_dpt,
    )
    settings = drawn.settings(given, distance_dpt)
    return drawn.of_frames(frames), settings, {"drawn": drawn.described}


def _drawn_range(
    option: str, text: str | None, column: str
) -> tuple[float, float] | None:
    if text is None:
        return None
    values = listed_numbers(option, text, LIMITS[column])
    if len(values) != 2 or values[0] > values[1]:
        raise ValueError(f"{option} is '{text:.60}'; allowed: LOW,HIGH")
    return values[0], values[1]
