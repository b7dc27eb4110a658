"""Runs in the environment of the peers: optiland's images through an eye.

optiland's `PSFBasisGenerator` makes PSFs on a grid of field points and reduces them to
a mean and eigen-PSFs; its `SpatiallyVariableSimulator` convolves an image with these.
Its `ImageSimulationEngine` takes a sample of the PSF for a pixel and a square field, so
the generator is given PSFs here that are integrated over the pixels of the camera,
at the field points of the image.  The convolution is optiland's own.

The reference has the same PSFs at far more field points, between which it interpolates
linearly: an image is the sum, over field points, of the light near a point convolved
with the PSF of that point.
"""

import math
import time
import warnings
from pathlib import Path

import numpy as np
from scipy.signal import fftconvolve

RAYS = 128
"""Across the pupil.  The PSFs then reach 15 px or more before they wrap around."""

SAMPLES_PER_PX = 9
"""Of a PSF, at least."""

REFERENCE_STEP_PX = 20
"""Between the field points of the reference."""


class Camera:
    """A pinhole camera.

    Attributes
    ----------
    tangents : (left, right, up, down)
    size_px : (width, height)
    """

    def __init__(self, tangents, size_px):
        self.tangents, self.size_px = tangents, size_px
        self.pitch = (tangents[1] - tangents[0]) / size_px[0]

    def field_points(self, shape):
        """Tangents (rows, columns) of field points from corner pixel to corner pixel.

        The rows are those of the image: the first is its upper edge.
        """
        left, right, up, down = self.tangents
        half = self.pitch / 2
        return (
            np.linspace(up - half, down + half, shape[0]),
            np.linspace(left + half, right - half, shape[1]),
        )


def local_scale(tangent_x, tangent_y):
    """Matrix (2, 2) from direction cosines to tangents, about a direction."""
    n = 1.0 / math.sqrt(1.0 + tangent_x**2 + tangent_y**2)
    cosines = n * np.array([tangent_x, tangent_y])
    return np.eye(2) / n + np.outer(cosines, cosines) / n**3


def integrated(psf, step, scale, pitch, radius_px):
    """Integrate a PSF over pixels.

    Parameters
    ----------
    psf : (n, n)
        Samples over direction cosines; rows go upward, the center is at n // 2.
    step : float
        Between samples.
    scale : (2, 2)
        From direction cosines to tangents.
    pitch : float
        Tangent of a pixel.
    radius_px : int

    Returns
    -------
    kernel : (2 radius + 1, 2 radius + 1)
        Rows go downward; the sum is 1.
    """
    at = (np.arange(psf.shape[0]) - psf.shape[0] // 2) * step / pitch
    x, y = np.einsum("ij,jkl->ikl", scale, np.stack(np.meshgrid(at, at)))
    # Every sample is shared by the four nearest cells of a finer raster, which
    # preserves its position.
    side = (2 * radius_px + 1) * SAMPLES_PER_PX
    columns = (x + radius_px + 0.5) * SAMPLES_PER_PX - 0.5
    rows = (radius_px + 0.5 - y) * SAMPLES_PER_PX - 0.5
    fine = np.zeros((side, side))
    for own_rows, row_share in _cells(rows):
        for own_columns, column_share in _cells(columns):
            inside = (own_rows >= 0) & (own_rows < side)
            inside &= (own_columns >= 0) & (own_columns < side)
            cell = own_rows[inside] * side + own_columns[inside]
            light = (psf * row_share * column_share)[inside]
            fine += np.bincount(cell, light, side * side).reshape(side, side)
    pixels = 2 * radius_px + 1
    kernel = fine.reshape(pixels, SAMPLES_PER_PX, pixels, SAMPLES_PER_PX).sum((1, 3))
    return kernel / kernel.sum()


def _cells(position):
    """Two nearest cells of each position, and the share of each."""
    low = np.floor(position).astype(int)
    yield low, low + 1 - position
    yield low + 1, position - low


def hat(count, size):
    """Linear weights (count, size) of nodes that span the samples; columns sum to 1."""
    nodes = np.linspace(0.0, size - 1.0, count)
    distance = np.abs(np.arange(size)[None] - nodes[:, None])
    return np.maximum(1.0 - distance * (count - 1) / (size - 1), 0.0)


def dense_image(channel, kernels):
    """Convolve one channel with PSFs that change linearly between field points.

    Parameters
    ----------
    channel : (height, width)
    kernels : (rows, columns, side, side)
        PSFs of field points from corner pixel to corner pixel.
    """
    radius = kernels.shape[-1] // 2
    image = np.zeros([side + 2 * radius for side in channel.shape])
    weights = [
        hat(count, size)
        for count, size in zip(kernels.shape[:2], channel.shape, strict=True)
    ]
    for i, row_weight in enumerate(weights[0]):
        rows = np.flatnonzero(row_weight)
        for j, column_weight in enumerate(weights[1]):
            columns = np.flatnonzero(column_weight)
            light = channel[np.ix_(rows, columns)]
            light = light * np.outer(row_weight[rows], column_weight[columns])
            part = fftconvolve(light, kernels[i, j])
            y, x = rows[0], columns[0]
            image[y : y + part.shape[0], x : x + part.shape[1]] += part
    return image[radius : radius + channel.shape[0], radius : radius + channel.shape[1]]


class Eye:
    """The eye of one channel as an optic of optiland.

    Parameters
    ----------
    surfaces : list of dict
        ``radius_mm``, ``conic_constant``, ``z_mm`` and ``index_after``.
    stop_z_mm : float
    retina : dict
        ``radius_mm``, ``conic_constant`` and ``z_mm``.
    """

    def __init__(self, surfaces, stop_z_mm, retina, wavelength_nm, pupil_mm, camera):
        from optiland.materials import IdealMaterial
        from optiland.optic import Optic

        self.optic = Optic()
        self.wavelength_um, self.pupil_mm = wavelength_nm / 1000.0, pupil_mm
        self.camera = camera
        rows = [(s["z_mm"], 1, s) for s in surfaces]
        rows = sorted([*rows, (stop_z_mm, 0, None)], key=lambda row: row[:2])
        self.optic.surfaces.add(index=0, thickness=np.inf)
        index = 1.0
        for number, (z_mm, _, surface) in enumerate(rows, 1):
            shape = {"radius": np.inf, "is_stop": True}
            if surface is not None:
                index = surface["index_after"]
                shape = {"radius": surface["radius_mm"]}
                shape["conic"] = surface["conic_constant"]
            self.optic.surfaces.add(
                index=number, z=z_mm, material=IdealMaterial(n=index), **shape
            )
        self.optic.surfaces.add(
            index=len(rows) + 1,
            z=retina["z_mm"],
            radius=-abs(retina["radius_mm"]),
            conic=retina["conic_constant"],
        )
        self.optic.set_aperture("EPD", pupil_mm)
        self.optic.fields.set_type("angle")
        self.max_field_deg = math.degrees(math.atan(max(map(abs, camera.tangents))))
        for x, y in ((0.0, 0.0), (self.max_field_deg, 0.0), (0.0, self.max_field_deg)):
            self.optic.fields.add(x=x, y=y)
        self.optic.wavelengths.add(value=self.wavelength_um, is_primary=True)

    @property
    def _period(self):
        """Direction cosine after which a PSF repeats."""
        return self.wavelength_um * 1e-3 * (RAYS - 1) / self.pupil_mm

    @property
    def radius_px(self):
        """Largest radius that no light wraps around into."""
        return int(self._period / self.camera.pitch / 2 - 0.5)

    def kernel(self, tangent_x, tangent_y):
        """PSF of a field point, integrated over pixels."""
        from optiland.psf.fft import FFTPSF

        field = [
            math.degrees(math.atan(t)) / self.max_field_deg
            for t in (tangent_x, tangent_y)
        ]
        size = math.ceil(SAMPLES_PER_PX * self._period / self.camera.pitch)
        size = max(size, RAYS)
        psf = FFTPSF(
            self.optic,
            tuple(field),
            self.wavelength_um,
            num_rays=RAYS,
            grid_size=size,
        ).psf
        scale = local_scale(tangent_x, tangent_y)
        step = self._period / size
        return integrated(psf, step, scale, self.camera.pitch, self.radius_px)

    def kernels(self, shape, *, symmetric=False):
        """PSFs (rows, columns, side, side) of field points over the image.

        Parameters
        ----------
        symmetric : bool
            Compute a quadrant, and mirror it: for centered eyes and cameras.
        """
        rows, columns = self.camera.field_points(shape)
        found = {}
        for i in range(shape[0]):
            for j in range(shape[1]):
                mirror = shape[0] - 1 - i, shape[1] - 1 - j
                if symmetric and (i > mirror[0] or j > mirror[1]):
                    source = found[min(i, mirror[0]), min(j, mirror[1])]
                    source = source[::-1] if i > mirror[0] else source
                    found[i, j] = source[:, ::-1] if j > mirror[1] else source
                    continue
                found[i, j] = self.kernel(columns[j], rows[i])
        side = 2 * self.radius_px + 1
        return np.stack([found[key] for key in sorted(found)]).reshape(
            *shape, side, side
        )


def eigen_basis(eye, shape, n_components):
    """Eigen-PSFs, their coefficients over the image, and the mean, by optiland."""
    from optiland.analysis.image_simulation import PSFBasisGenerator

    class PixelBasis(PSFBasisGenerator):
        """The generator, with PSFs integrated over pixels."""

        def _compute_psf_grid(self):
            kernels = eye.kernels(shape)
            return kernels.reshape(-1, *kernels.shape[2:])

    generator = PixelBasis(eye.optic, eye.wavelength_um, grid_shape=shape)
    eigen_psfs, coefficients, mean_psf = generator.generate_basis(n_components)
    maps = generator.resize_coefficient_map(coefficients, eye.camera.size_px[::-1])
    return [np.asarray(part, np.float32) for part in (eigen_psfs, maps, mean_psf)]


def pixel_weights(blob, pitch, step, size):
    """Means (size,) of a blob in pixels over the cells of a PSF's samples."""
    edges = (np.arange(len(blob) + 1) - len(blob) / 2) * pitch
    sums = np.concatenate([[0.0], np.cumsum(blob) * pitch])
    ends = (np.arange(size + 1) - size // 2 - 0.5) * step
    return np.diff(np.interp(ends, edges, sums)) / step


def gradient(folder, eye, wavelength_nm, pupil_mm, pitch):
    """Derivative of a PSF's sum, weighted with a blob, by the radius of the cornea."""
    import optiland.backend as backend

    backend.set_backend("torch")
    backend.set_precision("float64")
    backend.grad_mode.enable()
    import torch
    from optiland.psf.fft import FFTPSF

    half = 0.5 * pitch
    camera = Camera((-half, half, half, -half), (1, 1))
    own = Eye(**eye, wavelength_nm=wavelength_nm, pupil_mm=pupil_mm, camera=camera)
    geometry = own.optic.surfaces[1].geometry
    radius_mm = float(geometry.radius)
    size = max(math.ceil(SAMPLES_PER_PX * own._period / pitch), RAYS)
    blob = np.load(Path(folder) / "blob.npy")
    weights = torch.tensor(pixel_weights(blob, pitch, own._period / size, size))
    inside = torch.tensor(
        pixel_weights(np.ones_like(blob), pitch, own._period / size, size)
    )
    for _ in range(2):  # the first warms up
        start_s = time.perf_counter()
        geometry.radius = torch.tensor(radius_mm, dtype=torch.float64).requires_grad_()
        psf = FFTPSF(
            own.optic,
            (0.0, 0.0),
            own.wavelength_um,
            num_rays=RAYS,
            grid_size=size,
        ).psf
        light = (weights @ psf @ weights) / (inside @ psf @ inside)
        light.backward()
        taken_s = time.perf_counter() - start_s
    return {"gradient": float(geometry.radius.grad), "seconds": taken_s}


class Simulation:
    """What the requests are about: an eye, a camera and a picture."""

    def __init__(self):
        warnings.simplefilter("ignore")
        self._kept = {}

    def open(self, folder, eye, wavelengths_nm, tangents, size_px):
        """Read the picture, and keep the eye: surfaces of each channel."""
        from optiland.analysis import image_simulation

        self._simulator = image_simulation.SpatiallyVariableSimulator()
        self._eye, self._wavelengths_nm = eye, wavelengths_nm
        self._camera = Camera(tangents, size_px)
        color = np.load(Path(folder) / "color.npy")
        self._channels = np.moveaxis(color, -1, 0).astype(np.float32)
        return {}

    def _eyes(self, pupil_mm):
        for own, wavelength_nm in zip(self._eye, self._wavelengths_nm, strict=True):
            yield Eye(
                **own,
                wavelength_nm=wavelength_nm,
                pupil_mm=pupil_mm,
                camera=self._camera,
            )

    def frame(self, folder, pupil_mm, shape, n_components):
        """Filter the picture; PSFs are computed anew if the pupil has changed."""
        start_s = time.perf_counter()
        variant = tuple(shape), n_components
        if self._kept.get(variant, (None,))[0] != pupil_mm:
            bases = [
                eigen_basis(eye, tuple(shape), n_components)
                for eye in self._eyes(pupil_mm)
            ]
            self._kept[variant] = pupil_mm, bases
        channels = [
            self._simulator.simulate(channel[None], *basis)[0]
            for channel, basis in zip(
                self._channels, self._kept[variant][1], strict=True
            )
        ]
        color = np.stack(channels, axis=-1)
        taken_s = time.perf_counter() - start_s
        np.save(Path(folder) / "out.npy", color)
        return {"seconds": taken_s}

    def reference(self, folder, pupil_mm, step_px=REFERENCE_STEP_PX):
        """Filter the picture with PSFs of many field points."""
        shape = [math.ceil((side - 1) / step_px) + 1 for side in self._camera.size_px]
        channels = [
            dense_image(channel, eye.kernels(tuple(shape[::-1]), symmetric=True))
            for channel, eye in zip(self._channels, self._eyes(pupil_mm), strict=True)
        ]
        np.save(Path(folder) / "out.npy", np.stack(channels, axis=-1))
        return {}


if __name__ == "__main__":
    from peer_answers import answer_requests

    simulation = Simulation()
    answer_requests(
        {
            "open": simulation.open,
            "frame": simulation.frame,
            "reference": simulation.reference,
            "gradient": gradient,
        }
    )
