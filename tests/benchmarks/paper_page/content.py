"""The tables and figures of the paper beside ours: where each value comes from."""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import product

from tests.benchmarks.paper_page.measured import Measured
from tests.benchmarks.paper_page.published import (
    FOLDER,
    published,
    section,
    table,
    words,
)
from tests.benchmarks.paper_page.rows import Block, Line, Measure, Section

NAMES = words()["names"]
EYES, SYSTEMS, SCENES = NAMES["eyes"], NAMES["systems"], NAMES["scenes"]
SCENE_TITLES, STEP_TITLES = NAMES["scene_titles"], NAMES["step_titles"]
LARGE = "1280x720"
SECONDS, MILLISECONDS = Measure("time", "s"), Measure("time", "ms")
DECIBELS = Measure("PSNR", "dB", higher_is_better=True)
MEASURES = {
    "dB": DECIBELS,
    "layers": Measure("layers", "layers"),
    **{unit: Measure("memory", unit) for unit in ("MiB", "GiB")},
    **{unit: Measure("time", unit) for unit in ("h", "ms", "s")},
    **{
        name: Measure(name, "ms")
        for name in ("time to the first frame", "time of a frame")
    },
}
SCALES = {"MiB": 1e6 / 2**20, "GiB": 1e6 / 2**30, "h": 1.0 / 3.6e6, "s": 1e-3}
"""Of the units of blocks, from megabytes and milliseconds."""

ERROR_NAMES = ("mean_abs_um", "mean_abs_mm")


@cache
def blocks_of_sections() -> dict:
    """Return the content of `blocks.toml`."""
    return tomllib.loads((FOLDER / "blocks.toml").read_text(encoding="utf-8"))


def value(measured: Measured, source: dict | list | None, eye: str):
    """Return the value of an eye; None where there is none.

    Parameters
    ----------
    source : dict, list of dict or None
        Where it comes from, as `blocks.toml` says.
    eye : str
        Its name in the file.
    """
    for one in source if isinstance(source, list) else [source]:
        where = {**(one or {"file": ""}), "case": eye}
        file, scale = where.pop("file"), where.pop("scale", None)
        column = where.pop("column", "")
        found = measured.value(file, column, **where) if file else None
        if isinstance(found, str):  # the number of kernels, in words
            return found.split(": ")[1].split(";")[0]
        if found is not None:
            return found * SCALES.get(scale, 1.0)
    return None


def eye_block(
    measured: Measured,
    system: str,
    measure: Measure,
    own: Mapping[str, float] | None,
    sources: Sequence[dict | list | None],
    *,
    cases: Mapping[str, str] | None = None,
    **more,
) -> Block:
    """Make a block with a line for each eye.

    ``own`` are the published figures; ``sources`` are of ours, of the system built
    anew, and of ours in the same conditions, as many as there are; ``cases`` are the
    eyes, by their names in the files.
    """
    lines = [
        Line(
            *(EYES[eye], own[eye] if own else None),
            *(
                value(measured, source, (cases or {}).get(eye, eye))
                for source in sources
            ),
        )
        for eye in EYES
        if cases is None or eye in cases
    ]
    return Block(system, measure, tuple(lines), **more)


def _filled(content, names: Mapping[str, str]):
    """Replace the {names} in strings."""
    if isinstance(content, str):
        return content.format(**names)
    if isinstance(content, list):
        return [_filled(part, names) for part in content]
    if isinstance(content, dict):
        return {key: _filled(part, names) for key, part in content.items()}
    return content


def listed_section(measured: Measured, number: str) -> Section:
    """Return a section whose blocks are those of `blocks.toml`."""
    content = blocks_of_sections()[number]
    blocks = []
    for group in content["group"]:
        for parts in product(group["for"], group.get("and", [{}])):
            names = {key: name for part in parts for key, name in part.items()}
            names["system"] = SYSTEMS.get(names.get("method"), "")
            names["scene_title"] = SCENE_TITLES.get(names.get("scene"), "")
            names["our_scene"] = SCENES.get(names.get("scene"), "")
            shared = {
                k: v for k, v in group.items() if k not in ("for", "and", "block")
            }
            for block in group["block"]:
                own = _filled({"system": "{system}", **shared, **block}, names)
                if own.pop("only", names.get("scene")) != names.get("scene"):
                    continue
                blocks.append(_listed_block(measured, own, set(names.values())))
    return section(number, content["origins"], blocks)


def _listed_block(measured: Measured, own: dict, names: set[str]) -> Block:
    path = own.pop("published", None)
    printed = None
    if path is not None:
        for key in path:
            printed = table(int(key)) if printed is None else printed[key]
        printed = {
            eye: float(cell.split()[0]) if isinstance(cell, str) else cell
            for eye, cell in printed.items()
        }
    sources = [own.pop(name, None) for name in ("ours", "rebuilt", "there")]
    is_own = (own.pop("own", None) in names) or own.pop("is_own", False)
    measure = MEASURES[own.pop("measure")]
    return eye_block(
        *(measured, own.pop("system"), measure, printed, sources), is_own=is_own, **own
    )


# Table 3


def networks(measured: Measured) -> Section:
    """Table 3: errors of networks over the domain of the paper's Table 2."""
    blocks = []
    for title, (name, unit) in NAMES["networks"].items():
        found = measured.cards[name]["error_by_rows"]["table_2"]
        # of the focus with the rows whose lens is at a bound, as the paper has them
        ours = found.get("mean_abs_with_bounded", found["mean_abs"])
        for architecture, own in table(3)[title].items():
            run = f"{name}: {NAMES['architectures'][architecture]}"
            rebuilt = measured.value("table3", "error", run=run)
            line = Line(
                architecture, own["mean_abs"], ours, rebuilt and rebuilt["mean_abs"]
            )
            blocks.append(
                Block(
                    f"{architecture}: {own['parameters_millions']:.0f} M weights",
                    Measure("mean abs. error", unit),
                    (line,),
                    is_own=architecture == "ResNet (ours)",
                    scene=title,
                    rebuilt_as="0.3 M weights, 1 M rows",
                    rebuilt_is_same=False,
                )
            )
    millions = sorted(card["n_parameters"] / 1e6 for card in measured.cards.values())
    unbounded = measured.cards["focus"]["error_by_rows"]["table_2"]["mean_abs"]
    return section(
        *("Table 3", ("table3",), blocks),
        low=f"{millions[0]:.1f}",
        high=f"{millions[-1]:.1f}",
        unbounded=f"{unbounded:.5f}",
    )


# Tables 4 and 5


def _in_networks(step: str, method: str | None, column: str, unit: str = "") -> dict:
    where = {"step": step, "method": method, "error_name": ERROR_NAMES}
    return {"file": "networks", "column": column, "scale": unit, **where}


def _steps(measured: Measured, step: str, column: str) -> list[Block]:
    is_time = column == "median_ms"
    measure = Measure("mean abs. error", "mm" if step == "focus" else "µm")
    blocks = []
    unit = "s" if is_time else ""
    for way in words()["ways"][step]:
        ours = _in_networks(step, way["ours"], column, unit)
        rebuilt = _in_networks(step, way.get("rebuilt"), column, unit)
        if is_time and step == "eye":
            rebuilt = None  # the time of a search that was cut off says nothing
        block = eye_block(
            *(measured, way["title"], SECONDS if is_time else measure),
            table(4 if is_time else 5)[step][way["which"]],
            (ours, rebuilt, ours),
            is_own=way["which"] == "proposed",
            scene=STEP_TITLES[step],
            incomparable="" if is_time else way.get("apart", ""),
            rebuilt_as=way.get("rebuilt_as", ""),
        )
        blocks.append(block)
    return blocks


def times(measured: Measured) -> Section:
    """Table 4: seconds of each step of estimating an eye."""
    blocks = [
        block for step in STEP_TITLES for block in _steps(measured, step, "median_ms")
    ]
    return section("Table 4", ("networks",), blocks)


def errors(measured: Measured) -> Section:
    """Table 5: their errors, and what was to be found."""
    blocks = []
    for step in STEP_TITLES:
        target = eye_block(
            *(measured, "Target: what was to be found"),
            Measure("mean abs. value", "mm" if step == "focus" else "µm"),
            table(5)[step]["target"],
            (_in_networks(step, "exact", "target"),),
            scene=STEP_TITLES[step],
            is_contest=False,
        )
        blocks += [target, *_steps(measured, step, "error")]
    zeros = published()["tables"]["5"]["note"]
    return section("Table 5", ("networks",), blocks, zeros=zeros)


# Table 11


def statistics(measured: Measured) -> Section:
    """Table 11: the data of the training."""
    blocks = []
    for domain, groups in table(11).items():
        scene, unit = NAMES["domains"][domain]
        chains = [row["chain"] for row in measured.rows("table11", domain=domain)]
        last = [chain for chain in chains if chain != "paper"][-1]
        for group, own in groups.items():
            ours, rebuilt = (
                measured.value(
                    "table11", "statistics", domain=domain, group=group, chain=chain
                )
                for chain in ("ours", last)
            )
            lines = [
                Line(NAMES["statistics"][name], value, ours[name], rebuilt[name])
                for name, value in own.items()
            ]
            blocks.append(
                Block(
                    NAMES["groups"].get(group, f"radial orders {group[2:]}"),
                    *(Measure("targets", unit), tuple(lines)),
                    is_own=True,
                    scene=scene,
                    is_contest=False,
                    rebuilt_as="ours, with their chain's properties",
                )
            )
    n_rows = measured.results("table11")["n_rows"]
    return section("Table 11", ("table11",), blocks, n_rows=f"{n_rows:,}")


# Figures

SIDES = {
    # of figure 1: what is in its time of estimation, and the method of ours
    "left: the PSFs of the axis everywhere": ("on-axis", "ours on-axis"),
    "right: over the visual field": ("off-axis", "ours dynamic"),
}


def first_figure(measured: Measured) -> Section:
    """Figure 1, with the two times of its caption."""
    own = published()["figures"]["1"]
    estimation, rendering = [], []
    for k, (case, (step, method)) in enumerate(SIDES.items()):
        steps = [
            value(measured, _in_networks(name, "exact", "median_ms", "s"), "myopia")
            for name in ("eye", "focus", step)
        ]
        ours_s = None if None in steps else sum(steps)
        estimation.append(Line(case, own["estimation_s"][k], ours_s))
        frame = {"case": "myopia", "scene": "courtyard", "size": LARGE}
        ours_ms = measured.value("field", "median_ms", method=method, **frame)
        rendering.append(Line(case, own["rendering_ms"][k], ours_ms))
    blocks = [
        Block("The paper", measure, tuple(lines), is_own=True, scene=scene)
        for measure, lines, scene in (
            (SECONDS, estimation, "estimating the eye and its aberrations"),
            (MILLISECONDS, rendering, "rendering a frame"),
        )
    ]
    picture = "paper_figure_1.jpg"
    return section("Figure 1", ("networks", "field"), blocks, picture=picture)


def picture_section(measured: Measured, number: int) -> Section:
    """Figures 9 to 12, with the errors of the parts that they show large."""
    found = measured.rows("paper_figures", figure=number)
    names = dict.fromkeys(name for row in found for name in row["psnr_db"])
    (ours,) = (name for name in names if name.startswith("ours"))
    titles = {scene: scene.capitalize() for scene in SCENES.values()}
    blocks = [
        Block(
            SYSTEMS.get(name.removeprefix("paper "), SYSTEMS.get(name, name)),
            DECIBELS,
            tuple(
                Line(
                    f"{row['eye']}, {titles[row['scene']]}",
                    *(None, None, row["psnr_db"][name], row["psnr_db"][ours]),
                )
                for row in found
            ),
            is_own=name.startswith("paper"),
            scene="part of the picture, linear light",
            rebuilt_as="part of the picture",
        )
        for name in names
        if name != ours
    ]
    content = measured.results("paper_figures")
    frames = content.get("frames", [content])[0]
    return section(
        *(f"Figure {number}", ("paper_figures",), blocks),
        entry="pictures",
        picture=f"paper_figure_{number}.jpg",
        field="over the visual field" if number in (11, 12) else "on the axis",
        eyes="with mixed aberrations" if number in (10, 12) else "of low order only",
        size=frames["size"],
        state=frames["state"],
    )


# Numbers of the text


def psf_section(measured: Measured) -> Section:
    """Section 7.2: how many PSFs there are before the first frame, and their time."""
    own = published()["text"]
    seconds, counts = [], []
    for key, case, method in (
        ("on-axis psfs", "on the axis, all pupils and foci", "ours on-axis wide"),
        ("quality psfs", "quality: over the field, one state", "ours quality"),
        ("dynamic psfs", "dynamic: over the field, all states", ""),
    ):
        if method:
            where = {"method": method, "size": LARGE, "scene": "courtyard"}
            found = [
                (row["prepare_ms"], row["psf_count"])
                for row in measured.rows("field", **where)
            ]
        else:
            found = [
                (row["median_ms"], int(row["setting"].split(": ")[1].split()[0]))
                for row in measured.rows("layers", method="cache", setting="dynamic*")
            ]
        time_ms, count = max(found, default=(None, None))
        seconds.append(Line(case, own[key]["seconds"], time_ms and time_ms / 1e3))
        counts.append(Line(case, own[key]["count"], count))
    blocks = [
        Block("The paper", measure, tuple(lines), is_own=True, **more)
        for measure, lines, more in (
            (SECONDS, seconds, {"scene": "before the first frame"}),
            (
                *(Measure("PSFs", "PSFs"), counts),
                {"scene": "how many", "is_contest": False},
            ),
        )
    ]
    return section("Section 7.2", ("field", "layers"), blocks)


def all_sections(measured: Measured) -> list[Section]:
    """Return every figure and table, by number, and numbers of the text."""
    return [
        first_figure(measured),
        *(picture_section(measured, number) for number in (9, 10, 11, 12)),
        *(make(measured) for make in (networks, times, errors)),
        *(listed_section(measured, f"Table {number}") for number in range(6, 11)),
        statistics(measured),
        listed_section(measured, "Section 4"),
        psf_section(measured),
    ]
