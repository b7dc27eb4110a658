"""Tables 3, 4, 5 and 11: networks, the time and error of estimating eyes, the data."""

from dataclasses import dataclass

from tests.benchmarks.paper_page.measured import Measured
from tests.benchmarks.paper_page.published import published, table
from tests.benchmarks.paper_page.rows import Block, Line, Measure, Section
from tests.benchmarks.paper_page.words import section
from tests.benchmarks.published_figures import CONDITIONS

SECONDS = Measure("time", "s")
STEP_TITLES = {
    "eye": "Eye structure (1 eye)",
    "focus": "Focus (42 states)",
    "on-axis": "Aberrations on the axis (126 nodes)",
    "off-axis": "Aberrations over the field (627 nodes)",
}


@dataclass(frozen=True)
class Way:
    """What the paper has for a step of tables 4 and 5, and what stands beside it.

    Attributes
    ----------
    which : str
        Column of the paper.
    ours : str
        Method of `bench_networks`.
    rebuilt : str
        The paper's method built anew there; none where it is empty.
    apart : str
        Why the errors of the two say nothing about each other.
    """

    which: str
    title: str
    ours: str = "exact"
    rebuilt: str = ""
    rebuilt_as: str = ""
    apart: str = ""


BY_DEFINITION = "it is the paper's reference: zero by definition"
ROUNDING = "exact tracing against exact tracing leaves nothing but rounding"
BY_NETWORK = Way("proposed", "The paper's network, beside ocufilter's", "network")
BY_TRACING = Way(
    "proposed", "The paper's network, beside exact tracing", apart=ROUNDING
)
PREVIOUS_TRACING = Way("previous", "Previous: ray tracing [49]", apart=BY_DEFINITION)
WAYS = {
    "eye": (
        Way(
            *("previous", "Previous: pattern search [49]"),
            rebuilt="search",
            rebuilt_as="search, cut off at 8 s",
        ),
        Way("proposed", "The paper's network, beside a refined eye"),
        BY_NETWORK,
    ),
    "focus": (
        Way(
            *("previous", "Previous: smallest spot [49]"),
            rebuilt="search",
            rebuilt_as="smallest spot",
            apart=BY_DEFINITION,
        ),
        BY_TRACING,
        BY_NETWORK,
    ),
    "on-axis": (PREVIOUS_TRACING, BY_TRACING, BY_NETWORK),
    "off-axis": (PREVIOUS_TRACING, BY_TRACING, BY_NETWORK),
}
EYE_NAMES = {
    "emmetropia": "Emmetropia",
    "myopia": "Myopia",
    "astigmatism": "Astigmatism",
    "keratoconus": "Keratoconus",
    "cataract": "Cataract",
    "post_lasik": "LASIK",
}

NETWORKS = {
    # the paper's name: ours in training/results, its card, unit
    "Eye structure estimator": ("eye", "um"),
    "Discriminator": ("discriminator", "um"),
    "Focused eye estimator": ("focus", "mm"),
    "Aberration estimator": ("aberration", "um"),
}
ARCHITECTURES = {
    "FFN": "ffn",
    "ResNet [79]": "resnet",
    "ResNet (ours)": "ours",
    "ResNet (ours) (no discriminator)": "ours, parameters loss",
}


def sections(measured: Measured) -> list[Section]:
    """Return all four."""
    return [
        _networks(measured),
        _times(measured),
        _errors(measured),
        _statistics(measured),
    ]


def _unit(name: str) -> str:
    return {"um": "µm"}.get(name, name)


def shipped_error(card: dict) -> float:
    """Mean absolute error of a network of ours over the domain of the paper's Table 2.

    Of the focus with the rows whose lens is at a bound, as the paper's has them.
    """
    found = card["error_by_rows"]["table_2"]
    return found.get("mean_abs_with_bounded", found["mean_abs"])


def _networks(measured: Measured) -> Section:
    blocks = []
    for title, (name, unit) in NETWORKS.items():
        rows = table(3)[title]
        ours = shipped_error(measured.cards[name])
        for architecture, own in rows.items():
            run = f"{name}: {ARCHITECTURES[architecture]}"
            rebuilt = measured.rows("table3", run=run)
            lines = (
                Line(
                    architecture,
                    own["mean_abs"],
                    ours,
                    rebuilt[0]["error"]["mean_abs"] if rebuilt else None,
                ),
            )
            is_last = architecture == "ResNet (ours)"
            blocks.append(
                Block(
                    f"{architecture}: {own['parameters_millions']:.0f} M weights",
                    Measure("mean abs. error", _unit(unit)),
                    lines,
                    is_own=is_last,
                    scene=title,
                    rebuilt_as="0.3 M weights, 1 M rows",
                    rebuilt_is_same=False,
                )
            )
    millions = sorted(c["n_parameters"] / 1e6 for c in measured.cards.values())
    bounded = measured.cards["focus"]["error_by_rows"]["table_2"]
    return section(
        "Table 3",
        ("table3",),
        blocks,
        low=f"{millions[0]:.1f}",
        high=f"{millions[-1]:.1f}",
        unbounded=f"{bounded['mean_abs']:.5f}",
    )


def _step_value(measured: Measured, column: str, step: str, eye: str, method: str):
    names = {"mean_abs_um", "mean_abs_mm"}
    for row in measured.rows("networks", step=step, case=eye, method=method):
        if row["error_name"] in names:
            return row[column]
    return None


def _seconds(measured: Measured, step: str, eye: str, method: str) -> float | None:
    time_ms = _step_value(measured, "median_ms", step, eye, method)
    return None if time_ms is None else time_ms / 1e3


def _times(measured: Measured) -> Section:
    blocks = []
    for step, ways in WAYS.items():
        for way in ways:
            lines = []
            for eye in CONDITIONS:
                ours = _seconds(measured, step, eye, way.ours)
                rebuilt = _seconds(measured, step, eye, way.rebuilt)
                if step == "eye":
                    rebuilt = None  # it was cut off
                published_s = table(4)[step][way.which][eye]
                lines.append(Line(EYE_NAMES[eye], published_s, ours, rebuilt, ours))
            blocks.append(_step_block(way, SECONDS, lines, step))
    return section("Table 4", ("networks",), blocks)


def _step_block(way: Way, measure: Measure, lines, step: str) -> Block:
    return Block(
        way.title,
        measure,
        tuple(lines),
        is_own=way.which == "proposed",
        scene=STEP_TITLES[step],
        incomparable="" if measure is SECONDS else way.apart,
        rebuilt_as=way.rebuilt_as,
    )


def _errors(measured: Measured) -> Section:
    blocks = []
    for step, ways in WAYS.items():
        measure = Measure("mean abs. error", "mm" if step == "focus" else "µm")
        own = table(5)[step]
        targets = tuple(
            Line(
                EYE_NAMES[eye],
                own["target"][eye],
                _step_value(measured, "target", step, eye, "exact"),
            )
            for eye in CONDITIONS
        )
        blocks.append(
            Block(
                "Target: what was to be found",
                Measure("mean abs. value", measure.unit),
                targets,
                scene=STEP_TITLES[step],
                is_contest=False,
            )
        )
        for way in ways:
            lines = []
            for eye in CONDITIONS:
                ours = _step_value(measured, "error", step, eye, way.ours)
                rebuilt = _step_value(measured, "error", step, eye, way.rebuilt)
                published_error = own[way.which][eye]
                lines.append(Line(EYE_NAMES[eye], published_error, ours, rebuilt, ours))
            blocks.append(_step_block(way, measure, lines, step))
    zeros = published()["tables"]["5"]["note"]
    return section("Table 5", ("networks",), blocks, zeros=zeros)


STATISTIC_NAMES = {
    "min": "Min",
    "max": "Max",
    "mean": "Mean",
    "abs_mean": "Abs. mean",
    "std": "Std. dev.",
    "q1": "Q1",
    "q2": "Q2",
    "q3": "Q3",
}
DOMAIN_TITLES = {
    "on_axis": "Discriminator",
    "field": "Aberration estimator",
    "focus": "Focus estimator",
}
GROUP_TITLES = {
    "lens_diameter_change_mm": "change of lens diameter",
    "aqueous_thickness_change_mm": "change of chamber depth",
}


def _statistics(measured: Measured) -> Section:
    blocks = []
    for domain, groups in table(11).items():
        found = measured.rows("table11", domain=domain)
        chains = list(dict.fromkeys(row["chain"] for row in found))
        last = [chain for chain in chains if chain != "paper"][-1]
        for group, own in groups.items():
            by_chain = {
                row["chain"]: row["statistics"]
                for row in found
                if row["group"] == group
            }
            lines = tuple(
                Line(
                    STATISTIC_NAMES[name],
                    value,
                    by_chain["ours"][name],
                    by_chain[last][name],
                )
                for name, value in own.items()
            )
            blocks.append(
                Block(
                    GROUP_TITLES.get(group, f"radial orders {group[2:]}"),
                    Measure("targets", "mm" if domain == "focus" else "µm"),
                    lines,
                    is_own=True,
                    scene=DOMAIN_TITLES[domain],
                    is_contest=False,
                    rebuilt_as="ours, with their chain's properties",
                )
            )
    n_rows = measured.results("table11")["n_rows"]
    return section("Table 11", ("table11",), blocks, n_rows=f"{n_rows:,}")
