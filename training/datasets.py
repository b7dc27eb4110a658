"""Data sets: rows of a domain, sampled and labeled, in shards with a manifest.

Row i of a data set depends only on the domain, the sampling and the seed, so shards can
be generated in any order and by several processes, and regenerated.
"""

import json
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from estimator.bounded_files import InvalidFile, read_json, reason_of
from training.population import (
    partly_accommodated_eyes,
    population_eyes,
    population_ranges,
)
from training.tasks import DOMAINS, MAX_COEFFICIENT_UM, N_EYE, Domain

FORMAT = 1
MANIFEST = "manifest.json"
SAMPLINGS = ("random", "sobol")
N_POPULATION_AXES = 3
"""Additional sampling axes: choice of the population, refraction, accommodation."""


DAMAGED = (
    *(ValueError, KeyError, TypeError, OSError, EOFError, OverflowError),
    *(NotImplementedError, RuntimeError, MemoryError, SyntaxError),
    *(TokenError, zipfile.BadZipFile, zlib.error),
)
"""What `numpy.load` raises for damaged files."""


class DataError(ValueError):
    """A data set or checkpoint cannot be created or read as requested."""


@dataclass(frozen=True)
class Recipe:
    """Parameters of a data set.

    Attributes
    ----------
    domain : str
        Name in `tasks.DOMAINS`.
    n_rows : int
        Rows to draw; vignetted ones are not written to the shards.
    rows_per_shard : int
    seed : int
    sampling : {"random", "sobol"}
        Uniform and independent, or a scrambled low-discrepancy sequence.
    population_ratio : float
        Fraction of rows whose eyes are drawn from the population (see `population`)
        instead of the ranges of Table 2.
    """

    domain: str
    n_rows: int
    rows_per_shard: int = 20_480
    seed: int = 132
    sampling: str = "sobol"
    population_ratio: float = 0.0

    def __post_init__(self) -> None:
        if self.domain not in DOMAINS:
            raise DataError(
                f"domain {self.domain!r:.60}: allowed are {', '.join(DOMAINS)}"
            )
        if self.sampling not in SAMPLINGS:
            raise DataError(
                f"sampling {self.sampling!r:.60}: allowed are {', '.join(SAMPLINGS)}"
            )
        if not 0.0 <= self.population_ratio <= 1.0:
            raise DataError(
                f"population_ratio {self.population_ratio}: must be within 0 and 1"
            )
        repeats = DOMAINS[self.domain].n_repeats
        if self.n_rows < 1 or self.rows_per_shard < 1 or self.rows_per_shard % repeats:
            raise DataError(
                f"{self.n_rows} rows in shards of {self.rows_per_shard}: both must be "
                f"positive, and a shard of '{self.domain}' a multiple of {repeats}"
            )

    @property
    def n_shards(self) -> int:
        """Return the number of shards; the last one may be shorter."""
        return -(-self.n_rows // self.rows_per_shard)


@dataclass(frozen=True)
class Shard:
    """Labeled rows, in float32.

    Attributes
    ----------
    inputs : (n, n_inputs)
    targets : (n, n_targets)
    n_rejected : int
        Number of vignetted rows, which are omitted.
    """

    inputs: NDArray[np.float32]
    targets: NDArray[np.float32]
    n_rejected: int


def draw(recipe: Recipe, shard: int) -> NDArray[np.float64]:
    """Draw the inputs (n, n_inputs) of a shard.

    If the domain has several rows per eye (as the paper's focus set), the range of the
    last input is divided into ``n_repeats`` parts, with one random value in each.

    Raises
    ------
    DataError
        The data set has no such shard.
    """
    domain, n_repeats = DOMAINS[recipe.domain], DOMAINS[recipe.domain].n_repeats
    first = shard * recipe.rows_per_shard
    n = min(recipe.rows_per_shard, recipe.n_rows - first)
    if n < 1:
        raise DataError(f"shard {shard}: the data set has {recipe.n_shards}")
    low, high = domain.ranges.T
    n_eyes = -(-n // n_repeats)
    n_axes = len(low) + (N_POPULATION_AXES if recipe.population_ratio else 0)
    unit = _unit_points(recipe, first // n_repeats, n_eyes, n_axes)
    rows = low + (high - low) * unit[:, : len(low)]
    if recipe.population_ratio:
        _populate(recipe, domain, rows, unit)
    if n_repeats == 1:
        return rows
    part = (np.arange(n_repeats) + unit[:, len(low) - 1, None]) / n_repeats
    rows = np.repeat(rows, n_repeats, axis=0)
    rows[:, -1] = low[-1] + (high - low)[-1] * part.ravel()
    return rows[:n]


def _populate(
    recipe: Recipe, domain: Domain, rows: NDArray[Any], unit: NDArray[Any]
) -> None:
    """Replace a share of the eyes of rows (n, n_inputs) by population eyes."""
    choice, refraction, used = unit[:, -N_POPULATION_AXES:].T
    chosen = choice < recipe.population_ratio
    eyes = population_eyes(unit[chosen, :N_EYE], refraction[chosen])
    if domain.is_focused:
        eyes = partly_accommodated_eyes(eyes, used[chosen])
    rows[chosen, :N_EYE] = eyes


def input_ranges(domain: Domain, population_ratio: float) -> NDArray[np.float64]:
    """Return the ranges (n_inputs, 2) of all inputs of a data set."""
    ranges = domain.ranges.copy()
    if population_ratio:
        wider = population_ranges(is_focused=domain.is_focused)
        ranges[:N_EYE, 0] = np.minimum(ranges[:N_EYE, 0], wider[:, 0])
        ranges[:N_EYE, 1] = np.maximum(ranges[:N_EYE, 1], wider[:, 1])
    return ranges


def _unit_points(recipe: Recipe, first: int, n: int, n_axes: int) -> NDArray[Any]:
    if recipe.sampling == "random":
        # One stream per block of rows: any shard can be drawn without the others.
        rng = np.random.default_rng(np.random.SeedSequence([recipe.seed, first]))
        return rng.random((n, n_axes))
    sequence = qmc.Sobol(n_axes, scramble=True, rng=recipe.seed)
    if first:
        sequence.fast_forward(first)
    with warnings.catch_warnings():
        # A shard is one part of the sequence, which is balanced as a whole.
        warnings.filterwarnings("ignore", message="The balance properties")
        return sequence.random(n)


def label(domain: Domain, inputs: NDArray[np.float64]) -> Shard:
    """Trace inputs (n, n_inputs), and omit vignetted rows."""
    targets = domain.label(inputs)
    with np.errstate(invalid="ignore"):
        good = np.all(np.abs(targets) <= MAX_COEFFICIENT_UM, axis=1)
    return Shard(
        inputs[good].astype(np.float32),
        targets[good].astype(np.float32),
        int(np.sum(~good)),
    )


def shard_file(folder: Path, shard: int) -> Path:
    """Return the path of a shard."""
    return folder / f"shard-{shard:05d}.npz"


def write_shard(folder: Path, number: int, shard: Shard) -> None:
    """Write one shard atomically."""
    target = shard_file(folder, number)
    partial = target.with_suffix(".partial")
    with partial.open("wb") as file:
        np.savez(
            file,
            inputs=shard.inputs,
            targets=shard.targets,
            n_rejected=np.int64(shard.n_rejected),
        )
    partial.replace(target)


def write_manifest(folder: Path, recipe: Recipe, *, commit: str) -> dict[str, Any]:
    """Write the manifest of a folder: settings, ranges, counts of rejected rows."""
    domain = DOMAINS[recipe.domain]
    done = [k for k in range(recipe.n_shards) if shard_file(folder, k).exists()]
    counts = []
    for number in done:
        with np.load(shard_file(folder, number)) as data:
            counts.append((len(data["inputs"]), int(data["n_rejected"])))
    manifest = {
        "format": FORMAT,
        **asdict(recipe),
        "commit": commit,
        "inputs": [
            {"name": name, "low": float(low), "high": float(high)}
            for name, (low, high) in zip(
                domain.inputs,
                input_ranges(domain, recipe.population_ratio),
                strict=True,
            )
        ],
        "targets": list(domain.targets),
        "n_shards_done": len(done),
        "n_rows_kept": sum(kept for kept, _ in counts),
        "n_rows_rejected": sum(rejected for _, rejected in counts),
    }
    text = json.dumps(manifest, indent=1)
    partial = folder / (MANIFEST + ".partial")
    partial.write_text(text + "\n", encoding="utf-8")
    partial.replace(folder / MANIFEST)
    return manifest


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of a data set.

    Raises
    ------
    DataError
        There is no manifest, or it is damaged or has another format.
    """
    file = folder / MANIFEST
    if not file.exists():
        raise DataError(f"{folder}: no data set; run python -m training.generate")
    try:
        manifest = read_json(file)
    except InvalidFile as error:
        raise DataError(str(error)) from None
    if not isinstance(manifest, dict):
        raise DataError(f"{file}: {manifest!r:.60}, expected a JSON object")
    if manifest.get("format") != FORMAT:
        found = manifest.get("format")
        raise DataError(f"{file}: format {found!r:.60}, expected {FORMAT}")
    return manifest


def recipe_of(manifest: dict[str, Any]) -> Recipe:
    """Return the recipe that a manifest was written for.

    Raises
    ------
    DataError
        A field is missing, or of another type.
    """
    given = {}
    for each in fields(Recipe):
        if each.name not in manifest and each.default is MISSING:
            raise DataError(f"{MANIFEST}: {each.name} is missing")
        given[each.name] = value = manifest.get(each.name, each.default)
        wanted: Any = (int, float) if each.type is float else each.type
        if isinstance(value, bool) or not isinstance(value, wanted):
            raise DataError(f"{MANIFEST}: {each.name} {value!r:.60}: of another type")
    return Recipe(**given)


def load_shards(folder: Path) -> Iterator[Shard]:
    """Yield the shards of a folder, in order.

    Raises
    ------
    DataError
        A shard is missing or damaged.
    """
    recipe = recipe_of(read_manifest(folder))
    for number in range(recipe.n_shards):
        file = shard_file(folder, number)
        if not file.exists():
            raise DataError(
                f"{file.name} of {recipe.n_shards} is missing in {folder}; resume with "
                "python -m training.generate"
            )
        try:
            # np.load does not close a damaged file that it opened itself
            with file.open("rb") as opened, np.load(opened) as data:
                shard = Shard(data["inputs"], data["targets"], int(data["n_rejected"]))
        except DAMAGED as error:
            raise DataError(f"{file}: damaged ({reason_of(error)})") from None
        yield shard


def load(folder: Path) -> Shard:
    """Return all rows of a data set."""
    shards = list(load_shards(folder))
    return Shard(
        np.concatenate([s.inputs for s in shards]),
        np.concatenate([s.targets for s in shards]),
        sum(s.n_rejected for s in shards),
    )


def split(
    inputs: NDArray[np.float32], *, share: float, seed: int
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return indices of training rows and, with probability ``share``, validation rows.

    All rows (n, n_inputs) of an eye, which are consecutive, are in the same set,
    because a network trained on an eye at one distance generalizes to others.
    """
    is_new = np.r_[True, np.any(inputs[1:, :N_EYE] != inputs[:-1, :N_EYE], axis=1)]
    eye = np.cumsum(is_new) - 1
    chosen = np.random.default_rng(seed).random(eye[-1] + 1)[eye] < share
    return np.flatnonzero(~chosen), np.flatnonzero(chosen)
