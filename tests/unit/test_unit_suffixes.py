"""A physical quantity's name ends in its unit, or is listed as having none."""

import ast
from functools import cache

import pytest

from tests.source_tree import PACKAGES, ROOT, python_files

UNITS = (
    *("mm", "um", "nm", "m", "mm2", "mm3", "deg", "rad", "mrad", "arcmin", "dpt", "px"),
    *("s", "ms", "hz", "db", "mb", "bytes", "years", "nit", "cpd"),
)
KINDS = ("ratio", "index", "count", "fraction", "constant")
"""Last words that say what kind of pure number this is."""

DIMENSIONLESS = {
    "axes": "unit vectors",
    "kernel": "shares of light, unit sum",
    "packed": "columns of eyes in mm, 1/mm and none, as their module says",
    "flat_kernels": "shares of light, kernels one behind the other",
    "log_amplitude": "logarithm of a ratio",
    "color": "light, sRGB or linear as the header says",
    "hidden_color": "as color",
    "bands": "light, in the units of the input",
    "light": "linear light in the unit of an image",
    "added_light": "as light",
    "white_level": "as light",
    "max_repeat_difference": "levels of 255, or linear light",
    "elements": "points and directions in pixels, lengths times light",
    "log_mar": "logarithm of minutes of arc",
    "pupil_ellipse": "center and semi-axes in mm, angle in rad",
    "values": "polynomials in um/mm^degree, and rims in mm",
    "maps": "pixels per pixel",
    "node_from_cell": "pixels per pixel",
    "tangents": "of the angles to the image edges",
    "uv": "texture position, 0 to 1",
    "srgb": "encoded light, 0 to 1",
    "background_srgb": "encoded light, 0 to 1",
    "defocus_error": "mean square, of a white of 1",
    "errors": "mean squares, of a white of 1",
    "lower_bound": "as errors",
    "target": "linear light",
    "before": "linear light",
    "after": "linear light",
    "render_tolerance": "errors over the usual ones",
    "oversampling": "samples per sample",
    "conic_constant": "shape of a conic, 0 sphere, -1 paraboloid",
    "conic_constants": "as conic_constant, of two meridians",
    "coefficients": "of a polynomial or formula, each with its own power of mm or um",
    "indices": "refractive indices",
    "abbe_number": "(n_d - 1) / (n_F - n_C)",
    "margin": "in lambda/D",
    "pupil_samples": "samples across the pupil, a count that need not be whole",
    "low": "in the unit of a network's input column, or of an entry of the page",
    "high": "in the unit of a network's input column, or of an entry of the page",
    "step": "in the unit of an entry of the page",
    "initial": "in the unit of an entry of the page",
    "value": "in the unit of a network's input column",
    "mean_abs": "in the unit that a network's card names",
    "p95_abs": "in the unit that a network's card names",
    "t": "the sender's own clock, echoed unread",
    "inputs": "columns of a data set, each in the unit its name ends in",
    "targets": "as inputs",
    "ranges": "of inputs",
    "n_epochs": "how often a training sees its rows, may be a fraction",
    "learning_rate": "step of an optimizer",
    "weight_decay": "as learning_rate",
    "prior_weight": "um of error that a deviation from the prior counts as",
    "decay_per_epoch": "factor of both",
}
"""Float fields without a unit, each with what it is instead."""

FLOAT_TYPES = {"float", "float16", "float32", "float64"}


@cache
def _named_types() -> dict[str, set[str]]:
    """Types that a module gives a name, as ``PupilMm = Annotated[float, ...]``."""
    return {
        target.id: _own_words(node.value)
        for package in PACKAGES
        for path in python_files(package)
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign)
        and ("Annotated" in _own_words(node.value) or isinstance(node.value, ast.BinOp))
        for target in node.targets
        if isinstance(target, ast.Name) and target.id[:1].isupper()
    }


def _own_words(annotation: ast.expr) -> set[str]:
    return {n.id for n in ast.walk(annotation) if isinstance(n, ast.Name)} | {
        n.attr for n in ast.walk(annotation) if isinstance(n, ast.Attribute)
    }


def _type_words(annotation: ast.expr) -> set[str]:
    words = _own_words(annotation)
    return words.union(*(_named_types().get(word, set()) for word in words))


def _is_dataclass(node: ast.ClassDef) -> bool:
    return any("dataclass" in ast.unparse(d) for d in node.decorator_list)


def _is_mapping(annotation: ast.expr) -> bool:
    return ast.unparse(annotation).startswith(("dict", "Mapping", "Callable"))


def quantities(source: str) -> list[tuple[str, str, int]]:
    """(class, field, line) of public dataclass fields that hold floats or arrays."""
    found = []
    if "dataclass" not in source:
        return found
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.ClassDef) or not _is_dataclass(node):
            continue
        if node.name.startswith("_"):
            continue
        for entry in node.body:
            if not isinstance(entry, ast.AnnAssign) or _is_mapping(entry.annotation):
                continue
            if "typer." in ast.unparse(entry.annotation):
                continue  # named like its option on the command line
            name = entry.target.id
            physical = _type_words(entry.annotation) & FLOAT_TYPES
            if physical and not name.startswith("_"):
                found.append((node.name, name, entry.lineno))
    return found


def has_unit(name: str) -> bool:
    if name.endswith("_log_mar"):
        return True
    last = name.rsplit("_", 1)[-1]
    return name in DIMENSIONLESS or last in KINDS or (last in UNITS and last != name)


def _found_quantities():
    for package in PACKAGES:
        for path in python_files(package):
            for kind, name, line in quantities(path.read_text(encoding="utf-8")):
                where = f"{path.relative_to(ROOT)}:{line} {kind}.{name}"
                yield path.relative_to(ROOT).as_posix(), name, where


@pytest.fixture(scope="module")
def found():
    return list(_found_quantities())


def test_every_quantity_names_its_unit(found):
    files = {file for file, _, _ in found}
    assert "estimator/profiles/eye_profile.py" in files  # the walk sees the eye,
    assert any(file.startswith("filter_service/wire/") for file in files)  # the wire
    wrong = [where for _, name, where in found if not has_unit(name)]
    assert not wrong, "\n".join(wrong)


def test_the_list_of_dimensionless_fields_holds_what_exists(found):
    names = {name for _, name, _ in found}
    assert sorted(DIMENSIONLESS.keys() - names) == []


def test_the_walk_sees_a_field_without_unit(found):
    source = (
        "@dataclass(frozen=True)\nclass Eye:\n    pupil: float\n    axis_deg: float\n"
        "    name: str\n    wave: NDArray[np.float64] | None = None\n"
    )
    names = [name for _, name, _ in quantities(source)]
    assert names == ["pupil", "axis_deg", "wave"]
    assert [name for name in names if not has_unit(name)] == ["pupil", "wave"]
