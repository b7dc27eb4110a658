"""Card of a trained network: its columns, training ranges and expected error.

The training writes ``weights/<name>.json`` with ``weights/<name>.onnx``.  The columns
below are the contract between training and inference: both import them from here.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.bounded_files import read_json
from estimator.eye.parameters import PARAMETER_NAMES
from estimator.optics.zernike import N_TERMS

WEIGHTS_FOLDER = Path(__file__).parent / "weights"
REMEDY = "restore it from the repository or run python -m training.export"
CARD_FORMAT = 1

FIRST_TERM = 3
"""First coefficient of the eye network's inputs: measured tilt is uninformative."""

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
"""Tolerance of the range check for rounding errors, as a fraction of the range."""


class NetworkUnavailable(ValueError):
    """A network cannot be used: no weights, or an input outside its training range."""


class WeightsMissing(NetworkUnavailable):
    """The weights file, or the package that evaluates it, is missing."""


class DamagedWeights(NetworkUnavailable):
    """The weights or their card are damaged or of another version."""


class NetworkUnfit(NetworkUnavailable):
    """The output of a network is unusable although its inputs are in range."""


@dataclass(frozen=True)
class Excess:
    """An input column outside its training range; values are in the column's unit."""

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
        Columns outside their ranges, sorted by the relative distance, largest first.
    """

    def __init__(self, network: str, excesses: tuple[Excess, ...]):
        self.network = network
        self.excesses = excesses
        others = f" and {len(excesses) - 1} more" if len(excesses) > 1 else ""
        super().__init__(f"{excesses[0]}{others}")


@dataclass(frozen=True)
class ExpectedError:
    """Mean and 95th percentile of a network's error against ray tracing.

    Both are in ``unit``.  For wavefronts, ``by_radial_order`` maps radial orders to
    mean errors.
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
        Error for eyes like those of the service's users.
    error_by_rows : mapping
        Error by distribution of eyes: ``table_2``, uniform over the ranges of the
        paper's Table 2, and ``population``, the prior of the estimation.
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
        """Return the columns of inputs (P, n_inputs) outside their training ranges.

        They are sorted by the relative distance of their worst value, largest first.
        NaN is outside every range.
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
        The card is missing or invalid; the message names the file and the remedy.
    """
    path = card_path(name)
    if not path.is_file():
        raise WeightsMissing(missing_text(path))
    try:
        return parse_card(name, read_json(path))
    except (LookupError, AttributeError, TypeError, ValueError, OverflowError) as error:
        raise DamagedWeights(
            f"{path.name}: expected the card of the network '{name}' ({error!r}); "
            f"{REMEDY}"
        ) from error


def missing_text(path: Path) -> str:
    """Return the message for a missing file."""
    name = path.relative_to(WEIGHTS_FOLDER.parents[2]).as_posix()
    return f"{name} is missing; {REMEDY}"


def parse_card(name: str, data: Mapping[str, Any]) -> Card:
    """Parse a card's JSON.

    Raises
    ------
    KeyError, TypeError, ValueError
        The card is incomplete, or belongs to another network or version.
    """
    if not isinstance(data, dict):
        raise ValueError("expected a JSON object")
    columns = tuple(column["name"] for column in data["inputs"])
    for key, value, expected in (
        ("format", data["format"], CARD_FORMAT),
        ("network", data["network"], name),
        ("inputs", columns, INPUTS[name]),
        ("outputs", tuple(data["outputs"]), OUTPUTS[name]),
    ):
        if value != expected:
            raise ValueError(f"{key}: expected {expected}, got {value}")
    low, high = (
        np.array([float(column[end]) for column in data["inputs"]])
        for end in ("low", "high")
    )
    if not np.all(low <= high):
        raise ValueError("inputs: expected low <= high in every range")
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
