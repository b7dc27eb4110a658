"""Card of a trained network: its columns, training ranges and expected error.

The training writes ``weights/<name>.json`` with ``weights/<name>.onnx``.  The columns
below are the contract between training and inference: both import them from here.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.eye.parameters import PARAMETER_NAMES
from estimator.optics.zernike import N_TERMS

WEIGHTS_FOLDER = Path(__file__).parent / "weights"
CARD_FORMAT = 1

FIRST_TERM = 3
"""First coefficient of the eye network's inputs: a measured tilt is uninformative."""

ZERNIKE_NAMES = tuple(f"zernike_j{j}_um" for j in range(1, N_TERMS))
RIM_NAMES = (
    *("ellipse_centre_x_mm", "ellipse_centre_y_mm"),
    *("ellipse_xx_mm", "ellipse_xy_mm", "ellipse_yy_mm"),
)
"""Columns of a pupil's rim, see `field_wavefronts.rim_from_ellipse`."""

INPUTS: Mapping[str, tuple[str, ...]] = {
    "discriminator": (*PARAMETER_NAMES, "pupil_diameter_mm", "wavelength_nm"),
    "eye": (*ZERNIKE_NAMES[FIRST_TERM - 1 :], "pupil_diameter_mm", "wavelength_nm"),
    "focus": (*PARAMETER_NAMES, "pupil_diameter_mm", "focus_dpt"),
    "aberration": (
        *PARAMETER_NAMES,
        *("pupil_diameter_mm", "wavelength_nm", "h_deg", "v_deg"),
    ),
}
"""Names of the input columns, by network."""

OUTPUTS: Mapping[str, tuple[str, ...]] = {
    "discriminator": ZERNIKE_NAMES,
    "eye": PARAMETER_NAMES,
    "focus": ("lens_diameter_change_mm", "aqueous_thickness_change_mm"),
    "aberration": (*ZERNIKE_NAMES, "zernike_radius_mm", *RIM_NAMES),
}

NETWORK_NAMES = tuple(INPUTS)

MARGIN_RATIO = 1e-6
"""Fraction of a range beyond its ends that still counts as inside, for rounding."""


LARGEST_ERROR_RATIO = 3.0
"""Ratio of the traced error in one eye to the stated 95th percentile above which a
network is not used for that eye.  Ranges of single columns do not define a domain: a
wavefront may resemble no eye's even if each of its terms is small."""


class NetworkUnavailable(ValueError):
    """A network is unavailable: no weights, or an input outside its training."""


class WeightsMissing(NetworkUnavailable):
    """The weights file, or the package that evaluates it, is missing."""


class DamagedWeights(NetworkUnavailable):
    """The weights or their card are damaged or of another version."""


class NetworkUnfit(NetworkUnavailable):
    """A network is not accurate for this eye, though its inputs are in range."""


@dataclass(frozen=True)
class Excess:
    """One input column outside its training range, in the column's own unit."""

    column: str
    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return (
            f"{self.column} {self.value:.4g} (trained for {self.low:.4g} to "
            f"{self.high:.4g})"
        )


class OutOfDomain(NetworkUnavailable):
    """An input outside the training ranges.

    Attributes
    ----------
    excesses : tuple of Excess
        Columns outside their ranges, the farthest first, relative to the range.
    """

    def __init__(self, network: str, excesses: tuple[Excess, ...]):
        self.network = network
        self.excesses = excesses
        others = f" and {len(excesses) - 1} more" if len(excesses) > 1 else ""
        super().__init__(f"{excesses[0]}{others}")


@dataclass(frozen=True)
class ExpectedError:
    """Mean and 95th percentile of a network's error against ray tracing.

    Both are in ``unit``; ``by_radial_order`` holds the mean of each order if the output
    is a wavefront.
    """

    mean_abs: float
    p95_abs: float
    unit: str
    n_samples: int
    by_radial_order: Mapping[int, float]

    def __str__(self) -> str:
        return f"{self.mean_abs:.2g} {self.unit} (95 % below {self.p95_abs:.2g})"


@dataclass(frozen=True)
class Card:
    """Card of one network.

    Attributes
    ----------
    low, high : (n_inputs,)
        Training range of each input column, in its unit.
    n_parameters : int
        Number of weights and biases.
    precision : str
        Precision of the stored weights, ``float16`` or ``float32``.
    error : ExpectedError
        Error for eyes as the service sees them.
    error_by_rows : mapping
        Error by the distribution of eyes: ``table_2``, the box of the paper's Table 2,
        and ``population``, the prior of the estimation.
    """

    network: str
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    n_parameters: int
    precision: str
    commit: str
    error: ExpectedError
    error_by_rows: Mapping[str, ExpectedError] = field(default_factory=dict)

    def outside(self, features: NDArray[np.float64]) -> tuple[Excess, ...]:
        """Return columns of inputs (P, n_inputs) outside their ranges, farthest first.

        Each has its value farthest outside; NaN is outside every range.
        """
        width = np.maximum(self.high - self.low, np.finfo(np.float64).tiny)
        beyond = np.maximum(self.low - features, features - self.high) / width
        beyond = np.where(np.isnan(features), np.inf, beyond)
        row = beyond.argmax(axis=0)
        worst = beyond[row, np.arange(width.size)]
        order = np.argsort(-worst, kind="stable")
        return tuple(
            Excess(
                INPUTS[self.network][i],
                float(features[row[i], i]),
                float(self.low[i]),
                float(self.high[i]),
            )
            for i in order[: np.count_nonzero(worst > MARGIN_RATIO)]
        )

    def check(self, features: NDArray[np.float64]) -> None:
        """Reject inputs (P, n_inputs) outside the training ranges.

        Raises
        ------
        OutOfDomain
        """
        if excesses := self.outside(features):
            raise OutOfDomain(self.network, excesses)

    def check_error(self, traced_error: float, where: str) -> None:
        """Reject a traced error far above the expected error.

        Raises
        ------
        NetworkUnfit
        """
        if not traced_error <= LARGEST_ERROR_RATIO * self.error.p95_abs:
            raise NetworkUnfit(
                f"error of {traced_error:.2g} {self.error.unit} {where} (95 % should "
                f"be below {self.error.p95_abs:.2g})"
            )


def card_path(name: str) -> Path:
    """Return the path of a network's card."""
    return WEIGHTS_FOLDER / f"{name}.json"


def weights_path(name: str) -> Path:
    """Return the path of a network's weights."""
    return WEIGHTS_FOLDER / f"{name}.onnx"


def read_card(name: str) -> Card:
    """Read and validate one network's card.

    Raises
    ------
    WeightsMissing, DamagedWeights
        The card is missing or invalid; the error names the file and a remedy.
    """
    path = card_path(name)
    if not path.is_file():
        raise WeightsMissing(missing_text(path))
    try:
        return parse_card(name, json.loads(path.read_text(encoding="utf-8")))
    except (KeyError, TypeError, ValueError) as error:
        raise DamagedWeights(
            f"{path.name} is not a card of the network '{name}' ({error!r}): restore "
            "it "
            "from the repository, or make it anew with python -m training.export"
        ) from error


def missing_text(path: Path) -> str:
    """Return a message that names a missing file and a remedy."""
    name = path.relative_to(WEIGHTS_FOLDER.parents[2]).as_posix()
    return (
        f"{name} is missing: restore it from the repository, or make it anew with "
        "python -m training.export"
    )


def parse_card(name: str, data: Mapping[str, Any]) -> Card:
    """Parse a card's JSON.

    Raises
    ------
    KeyError, TypeError, ValueError
        The card is incomplete, or belongs to another network or version.
    """
    columns = tuple(column["name"] for column in data["inputs"])
    for what, found, wanted in (
        ("format", data["format"], CARD_FORMAT),
        ("network", data["network"], name),
        ("inputs", columns, INPUTS[name]),
        ("outputs", tuple(data["outputs"]), OUTPUTS[name]),
    ):
        if found != wanted:
            raise ValueError(f"{what} {found}, wanted {wanted}")
    low, high = (
        np.array([float(column[end]) for column in data["inputs"]])
        for end in ("low", "high")
    )
    if not np.all(low <= high):
        raise ValueError("a range that is not ascending")
    return Card(
        network=name,
        low=low,
        high=high,
        n_parameters=int(data["n_parameters"]),
        precision=str(data["precision"]),
        commit=str(data["commit"]),
        error=_parse_error(data["error"]),
        error_by_rows={
            rows: _parse_error(error)
            for rows, error in data.get("error_by_rows", {}).items()
        },
    )


def _parse_error(error: Mapping[str, Any]) -> ExpectedError:
    return ExpectedError(
        mean_abs=float(error["mean_abs"]),
        p95_abs=float(error["p95_abs"]),
        unit=str(error["unit"]),
        n_samples=int(error["n_samples"]),
        by_radial_order={
            int(order): float(value)
            for order, value in error.get("by_radial_order", {}).items()
        },
    )
