"""Inference with the trained networks, in microseconds instead of a ray trace.

Each network is evaluated by ONNX Runtime on the CPU and loaded on first use, once per
process.  Inputs outside the training ranges are rejected, never extrapolated: the
caller falls back to ray tracing.  The networks are trained by `training`; the interface
to it is the two files of each network, see `networks.card`.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.networks.card import (
    FIRST_TERM,
    INPUTS,
    Card,
    DamagedWeights,
    WeightsMissing,
    missing_text,
    read_card,
    weights_path,
)
from estimator.optics.zernike import N_TERMS
from estimator.threads import thread_count

BATCH = 2048
"""Rows per batch, so that activations stay in the processor cache."""

ERRORS_ONLY = 3
"""Lowest severity that ONNX Runtime logs; its warnings do not concern us."""


@dataclass(frozen=True)
class Network:
    """One loaded network, called with inputs in physical units."""

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
    """Wavefronts with their pupils, as predicted by the aberration network.

    ``zernike_um`` (P, 28) is on the circumscribed circles ``zernike_radius_mm`` (P,),
    piston zero; ``rim_mm`` (P, 5) as in `field_wavefronts.rim_from_ellipse`.
    """

    zernike_um: NDArray[np.float64]
    zernike_radius_mm: NDArray[np.float64]
    rim_mm: NDArray[np.float64]


@cache
def load_network(name: str) -> Network:
    """Load a network and its card, or return the loaded one.

    Raises
    ------
    WeightsMissing
        A file or package is missing; the error names it.
    DamagedWeights
    """
    card = read_card(name)
    path = weights_path(name)
    if not path.is_file():
        raise WeightsMissing(missing_text(path))
    try:
        import onnxruntime
    except ImportError as error:
        raise WeightsMissing(
            "onnxruntime, which evaluates the networks, is missing: sh setup.sh"
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
            f"{path.name} cannot be loaded ({type(error).__name__}): restore it "
            "from the repository, or make it anew with python -m training.export"
        ) from error
    return Network(card, session)


def network_eye(
    zernike_um: ArrayLike, *, pupil_diameter_mm: ArrayLike, wavelength_nm: ArrayLike
) -> NDArray[np.float64]:
    """Return parameters (..., 45) of relaxed eyes with about these wavefronts.

    Parameters
    ----------
    zernike_um : (..., 28)
        Coefficients on axis, on the circle of the pupil; piston and tilt are not used.
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
    """Return coefficients (..., 28), um, of eyes (..., 45) on axis, by discriminator.

    They approximate `eye.tracing.zernike_of_vectors`; piston is zero.

    Raises
    ------
    OutOfDomain, WeightsMissing, DamagedWeights
    """
    features = _features(vectors, pupil_diameter_mm, wavelength_nm)
    return _with_piston(_shaped(load_network("discriminator"), features))


def network_focus(
    vectors: ArrayLike, *, pupil_diameter_mm: ArrayLike, focus_dpt: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return changes (...) of lens diameter and aqueous thickness, mm, for a focus.

    Parameters
    ----------
    vectors : (..., 45)
        Relaxed eyes.
    pupil_diameter_mm : (...)
        Pupil through which the eye is focused.
    focus_dpt : (...)
        Focus distance, without correction.

    Raises
    ------
    OutOfDomain, WeightsMissing, DamagedWeights
    """
    features = _features(vectors, pupil_diameter_mm, focus_dpt)
    changes_mm = _shaped(load_network("focus"), features)
    return changes_mm[..., 0], changes_mm[..., 1]


def network_aberrations(
    vectors: ArrayLike,
    *,
    pupil_diameter_mm: ArrayLike,
    wavelength_nm: ArrayLike,
    h_deg: ArrayLike = 0.0,
    v_deg: ArrayLike = 0.0,
) -> PupilAberrations:
    """Return aberrations of focused eyes (..., 45) over the field, object at infinity.

    They approximate `aberrations.wavefront_grid`.  All arguments broadcast, and the
    leading axes of the result are theirs.

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
    """Join (..., n) and columns that broadcast with it to (..., n + n_columns)."""
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
