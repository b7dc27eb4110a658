"""Inference with the trained networks, in microseconds instead of a ray trace.

ONNX Runtime evaluates the networks on the CPU.  Each is loaded on first use, once per
process.  Inputs outside the training ranges raise `OutOfDomain`, and callers fall back
to ray tracing.  `training` writes the two files of each network; see `networks.card`.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.networks.card import (
    FIRST_TERM,
    INPUTS,
    REMEDY,
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
    path = weights_path(name)
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
