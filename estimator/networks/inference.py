"""Inference with the trained networks, in microseconds instead of a ray trace.

ONNX Runtime evaluates the networks on the CPU.  Each is loaded on first use, once per
process.  Inputs outside the training ranges raise `OutOfDomain`, and callers fall back
to ray tracing.

A card has the columns, training ranges and expected error of a network.  The training
writes ``weights/<name>.json`` with ``weights/<name>.onnx``.  The columns below are the
contract between training and inference: both import them from here.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.bounded_files import read_json
from estimator.eye.assembly import (
    ANTERIOR_CONIC,
    DIAMETER,
    accommodated_conic_constant,
)
from estimator.eye.parameters import PARAMETER_NAMES
from estimator.optics.zernike import N_TERMS
from estimator.threads import thread_count

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

FOCUS_ITERATIONS = 4
"""Evaluations of the focus network for one distance: after the fourth, the lens of a
perfect network is met to 1e-6 mm."""

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
        Error for eyes like the service's users' eyes.
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


def read_card(name: str) -> Card:
    """Read and validate one network's card.

    Raises
    ------
    WeightsMissing, DamagedWeights
        The card is missing or invalid; the message names the file and the remedy.
    """
    path = WEIGHTS_FOLDER / f"{name}.json"
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


BATCH = 2048
"""Rows per batch: activations stay in the processor cache."""

ERRORS_ONLY = 3
"""Minimum severity of ONNX Runtime's log; its warnings are not relevant here."""


@dataclass(frozen=True)
class Network:
    """A loaded network; inputs and outputs are in physical units."""

    card: Card
    _session: Any

    def __call__(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the outputs (P, n_outputs) for inputs (P, n_inputs).

        Raises
        ------
        OutOfDomain
            An input column is outside its training range.
        """
        self.card.check(features)
        features = np.ascontiguousarray(features, dtype=np.float32)
        found = [
            self._session.run(None, {"features": features[start : start + BATCH]})[0]
            for start in range(0, len(features), BATCH)
        ]
        return np.concatenate(found).astype(np.float64)


@dataclass(frozen=True)
class PupilAberrations:
    """Wavefronts and their pupils, predicted by the aberration network.

    Attributes
    ----------
    zernike_um : (P, 28)
        Coefficients on the circumscribed circle; piston is zero.
    zernike_radius_mm : (P,)
        Radius of this circle.
    rim_mm : (P, 5)
        Rim of the pupil; see `field_wavefronts.rim_from_ellipse`.
    """

    zernike_um: NDArray[np.float64]
    zernike_radius_mm: NDArray[np.float64]
    rim_mm: NDArray[np.float64]


@cache
def load_network(name: str) -> Network:
    """Load a network and its card; the result is cached.

    Raises
    ------
    WeightsMissing
        A file or package is missing; the message names it.
    DamagedWeights
        A file is invalid.
    """
    card = read_card(name)
    path = WEIGHTS_FOLDER / f"{name}.onnx"
    if not path.is_file():
        raise WeightsMissing(missing_text(path))
    try:
        import onnxruntime
    except ImportError as error:
        raise WeightsMissing(
            "the package onnxruntime is missing; run sh setup.sh"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = thread_count()
    options.inter_op_num_threads = 1
    options.log_severity_level = ERRORS_ONLY
    # Spinning threads would occupy the cores that render frames.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(
            path, options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # its errors have no common class
        raise DamagedWeights(
            f"{path.name} cannot be loaded ({type(error).__name__}); {REMEDY}"
        ) from error
    return Network(card, session)


def network_eye(
    zernike_um: ArrayLike, *, pupil_diameter_mm: ArrayLike, wavelength_nm: ArrayLike
) -> NDArray[np.float64]:
    """Return the parameters (..., 45) of relaxed eyes with given wavefronts.

    The wavefronts of these eyes are approximately the given ones.

    Parameters
    ----------
    zernike_um : (..., 28)
        On-axis coefficients on the circle of the pupil; piston and tilt are ignored.
    pupil_diameter_mm, wavelength_nm : (...)

    Raises
    ------
    OutOfDomain, WeightsMissing, DamagedWeights
    """
    zernike_um = np.asarray(zernike_um, dtype=np.float64)
    features = _features(zernike_um[..., FIRST_TERM:], pupil_diameter_mm, wavelength_nm)
    return _shaped(load_network("eye"), features)


def network_zernike(
    vectors: ArrayLike, *, pupil_diameter_mm: ArrayLike, wavelength_nm: ArrayLike
) -> NDArray[np.float64]:
    """Return the on-axis coefficients (..., 28), um, of eyes.

    The discriminator network approximates `eye.tracing.zernike_of_vectors`.  Piston is
    zero.

    Parameters
    ----------
    vectors : (..., 45)
    pupil_diameter_mm, wavelength_nm : (...)

    Raises
    ------
    OutOfDomain, WeightsMissing, DamagedWeights
    """
    features = _features(vectors, pupil_diameter_mm, wavelength_nm)
    return _with_piston(_shaped(load_network("discriminator"), features))


def network_focus(
    vectors: ArrayLike, *, pupil_diameter_mm: ArrayLike, focus_dpt: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the changes of the lens that focus relaxed eyes at given distances.

    The network was trained on lenses that keep their conic constants.  It is evaluated
    again with the anterior conic constant of the lens that it found.

    Parameters
    ----------
    vectors : (..., 45)
        Relaxed eyes.
    pupil_diameter_mm : (...)
        Pupil through which the eye is focused.
    focus_dpt : (...)
        Focus distance, without correction.

    Returns
    -------
    lens_diameter_change_mm, aqueous_thickness_change_mm : (...)

    Raises
    ------
    OutOfDomain, WeightsMissing, DamagedWeights
    """
    features = _features(vectors, pupil_diameter_mm, focus_dpt)
    diameter_mm = features[..., DIAMETER]
    relaxed_conic = features[..., ANTERIOR_CONIC].copy()
    for _ in range(FOCUS_ITERATIONS):
        changes_mm = _shaped(load_network("focus"), features)
        features[..., ANTERIOR_CONIC] = accommodated_conic_constant(
            relaxed_conic, diameter_ratio=1.0 + changes_mm[..., 0] / diameter_mm
        )
    return changes_mm[..., 0], changes_mm[..., 1]


def network_aberrations(
    vectors: ArrayLike,
    *,
    pupil_diameter_mm: ArrayLike,
    wavelength_nm: ArrayLike,
    h_deg: ArrayLike = 0.0,
    v_deg: ArrayLike = 0.0,
) -> PupilAberrations:
    """Return the aberrations of eyes over the field, for an object at infinity.

    The network approximates `aberrations.wavefront_grid`.  All arguments broadcast; the
    result has their shape as its leading axes.

    Parameters
    ----------
    vectors : (..., 45)
        Eyes in their state of accommodation.
    pupil_diameter_mm, wavelength_nm, h_deg, v_deg : (...)

    Raises
    ------
    OutOfDomain, WeightsMissing, DamagedWeights
    """
    features = _features(vectors, pupil_diameter_mm, wavelength_nm, h_deg, v_deg)
    found = _shaped(load_network("aberration"), features)
    n_zernike = N_TERMS - 1
    return PupilAberrations(
        zernike_um=_with_piston(found[..., :n_zernike]),
        zernike_radius_mm=found[..., n_zernike],
        rim_mm=found[..., n_zernike + 1 :],
    )


def _features(first: ArrayLike, *columns: ArrayLike) -> NDArray[np.float64]:
    """Broadcast (..., n) and columns (...), and join them to (..., n + n_columns)."""
    first = np.asarray(first, dtype=np.float64)
    others = [np.asarray(column, dtype=np.float64) for column in columns]
    shape = np.broadcast_shapes(first.shape[:-1], *(c.shape for c in others))
    n = first.shape[-1]
    features = np.empty((*shape, n + len(others)))
    features[..., :n] = first
    for i, column in enumerate(others):
        features[..., n + i] = column
    return features


def _shaped(network: Network, features: NDArray[Any]) -> NDArray[np.float64]:
    n_inputs = len(INPUTS[network.card.network])
    found = network(features.reshape(-1, n_inputs))
    return found.reshape(*features.shape[:-1], found.shape[-1])


def _with_piston(zernike_um: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([np.zeros((*zernike_um.shape[:-1], 1)), zernike_um], axis=-1)
