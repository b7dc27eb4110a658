"""Figures 1 and 9 to 12: what the paper shows, and our pictures of the same."""

from tests.benchmarks.paper_page.estimating import SECONDS
from tests.benchmarks.paper_page.measured import Measured
from tests.benchmarks.paper_page.published import published
from tests.benchmarks.paper_page.rendering import (
    DECIBELS,
    LARGE,
    MILLISECONDS,
    SCENES,
    SYSTEMS,
)
from tests.benchmarks.paper_page.rows import Block, Line, Section
from tests.benchmarks.paper_page.words import section

MIXED = (10, 12)
OFF_AXIS = (11, 12)
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
            measured.value(
                "networks", "median_ms", step=s, case="myopia", method="exact"
            )
            for s in ("eye", "focus", step)
        ]
        ours_s = None if None in steps else sum(steps) / 1e3
        estimation.append(Line(case, own["estimation_s"][k], ours_s))
        at = {"case": "myopia", "scene": "courtyard", "size": LARGE}
        ours_ms = measured.value("field", "median_ms", method=method, **at)
        rendering.append(Line(case, own["rendering_ms"][k], ours_ms))
    return section(
        "Figure 1",
        ("networks", "field"),
        (
            Block(
                *("The paper", SECONDS, tuple(estimation)),
                is_own=True,
                scene="estimating the eye and its aberrations",
            ),
            Block(
                *("The paper", MILLISECONDS, tuple(rendering)),
                is_own=True,
                scene="rendering a frame",
            ),
        ),
        picture="paper_figure_1.jpg",
    )


def picture_sections(measured: Measured) -> list[Section]:
    """Figures 9 to 12, with the errors of the parts that they show large."""
    return [_pictures(measured, number) for number in (9, 10, 11, 12)]


def _pictures(measured: Measured, number: int) -> Section:
    found = measured.rows("paper_figures", figure=number)
    names = dict.fromkeys(name for row in found for name in row["psnr_db"])
    ours = next(name for name in names if name.startswith("ours"))
    blocks = tuple(_picture_block(found, name, ours) for name in names if name != ours)
    content = measured.results("paper_figures")
    return section(
        f"Figure {number}",
        ("paper_figures",),
        blocks,
        words="pictures",
        picture=f"paper_figure_{number}.jpg",
        field="over the visual field" if number in OFF_AXIS else "on the axis",
        eyes="with mixed aberrations" if number in MIXED else "of low order only",
        size=content["size"],
        state=content["state"],
    )


def _picture_block(found: list[dict], name: str, ours: str) -> Block:
    titles = {own: theirs for theirs, own in SCENES.items()}
    lines = tuple(
        Line(
            f"{row['eye']}, {titles[row['scene']].replace('San Miguel', 'Courtyard')}",
            None,
            None,
            row["psnr_db"][name],
            row["psnr_db"][ours],
        )
        for row in found
    )
    system = SYSTEMS.get(name.removeprefix("paper "), SYSTEMS.get(name, name))
    return Block(
        *(system, DECIBELS, lines),
        is_own=name.startswith("paper"),
        scene="part of the picture, linear light",
        rebuilt_as="part of the picture",
    )
