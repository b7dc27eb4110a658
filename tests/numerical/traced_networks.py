"""Networks that trace instead: what their place must do with a perfect answer."""

import numpy as np

from estimator.eye.accommodation import AccommodatingEye
from estimator.eye.assembly import eye_surfaces
from estimator.eye.parameters import EyeParameters
from estimator.networks import inference as networks
from estimator.networks.inference import INPUTS, OUTPUTS, Card, ExpectedError
from estimator.wavefront.aberrations import wavefront_grid
from estimator.wavefront.field_wavefronts import rim_from_ellipse

FAR = 1e9
USERS = (networks,)
"""Modules that load networks by name."""


def trace_aberrations(row):
    """Output of a perfect aberration network for one row of its inputs."""
    pupil_mm, wavelength_nm, h_deg, v_deg = row[45:]
    found = wavefront_grid(
        eye_surfaces(EyeParameters.from_vector(row[:45])),
        fields_deg=[[h_deg, v_deg]],
        wavelengths_nm=[wavelength_nm],
        pupil_diameters_mm=[pupil_mm],
    )
    one = (0, 0, 0)
    rim_mm = rim_from_ellipse(found.ellipse_mm[one])
    return [*found.zernike_um[one][1:], found.zernike_radius_mm[one], *rim_mm]


def trace_focus(row):
    """Output of a perfect focus network for one row of its inputs."""
    eye = AccommodatingEye(
        EyeParameters.from_vector(row[:45]),
        pupil_diameter_mm=row[45],
        keeps_conics=True,
    )
    (state,) = eye.states_at(eye.accommodations_at_cornea_dpt(np.array([-row[46]])))
    return [state.lens_diameter_change_mm, state.aqueous_thickness_change_mm]


class TracedNetwork:
    """Stands where a `networks.Network` does.

    Parameters
    ----------
    trace : callable
        From one row of inputs to one of outputs.
    ranges : {column: (low, high)}
        Of the card; all other columns have none.
    """

    def __init__(self, name, trace, ranges=None, *, p95_um=1e-3, offset_um=0.0):
        low, high = np.full((2, len(INPUTS[name])), FAR)
        low = -low
        for column, limits in (ranges or {}).items():
            place = INPUTS[name].index(column)
            low[place], high[place] = limits
        error = ExpectedError(0.5 * p95_um, p95_um, "um", 100, {})
        self.card = Card(name, low, high, 1000, "float32", "none", error)
        self._trace, self._offset_um = trace, offset_um

    def __call__(self, features):
        self.card.check(features)
        found = np.array([self._trace(row) for row in features])
        assert found.shape == (len(features), len(OUTPUTS[self.card.network]))
        return found + self._offset_um


def put_in_place(monkeypatch, *made):
    """Have every user of networks load these."""
    known = {network.card.network: network for network in made}
    for module in USERS:
        monkeypatch.setattr(module, "load_network", known.__getitem__)
