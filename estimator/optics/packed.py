"""Columns of the arrays that describe an eye to compiled code.

`surfaces.pack_eye` returns the geometry: one row per refracting surface, then one for
the retina.  `surfaces.media_indices` returns the *index row* of a wavelength: the
refractive index in front of the first surface and behind each surface, followed by the
parameters of each gradient-index medium.
"""

# --- geometry: one row per refracting surface, the retina last ---------------------
CURVATURE_X, CURVATURE_Y, CONIC = 0, 1, 2
VERTEX = 3  # x, y, z of the vertex, mm
ROTATION = 6  # 3 x 3, row-major: surface axes to eye axes
FORM = 15  # REVOLVED, BICONIC, WITH_OFFSET, or a form of `forms`
IS_TURNED = 16  # 1 where ROTATION is not the identity
CLEAR_SQUARED = 17  # square of the clear radius, mm²
NEAR_GRADIENT = 18  # 1 where the medium on either side has a gradient
GRADIENT = 19  # column of the index row where the medium behind starts; 0: homogeneous
OFFSET = 20  # 28 monomial coefficients, mm, in the order of `surfaces.horner_order`
STOP_Z = 48  # last row only: the stop plane, mm
N_BEFORE_STOP = 49  # last row only: number of surfaces in front of the stop
FORM_NUMBERS = 50  # parameters of a form of `forms`
HAS_OFFSET = 62  # 1 where offset terms add to a form of `forms`
ADDED_CURVATURE = 63  # mean curvature that a form of `forms` adds at the vertex, 1/mm
N_COLUMNS = 64
N_FORM_NUMBERS = HAS_OFFSET - FORM_NUMBERS

REVOLVED, BICONIC, WITH_OFFSET = 0, 1, 2
FIRST_FORM = 3  # of the table in `forms`

# --- index row, from the column that GRADIENT names --------------------------------
GRADIENT_FORM = 0  # position in `gradients.INDEX_FUNCTIONS`
GRADIENT_STEPS = 1  # steps of the integration through the medium
GRADIENT_NUMBERS = 2  # parameters of the gradient
