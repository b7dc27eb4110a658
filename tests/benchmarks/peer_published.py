"""Published figures of methods without public code."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PrintedPeer:
    """A published method that is not measured here.

    Attributes
    ----------
    name : str
    differs : str
        What the method does otherwise, and cannot do.
    source : str
        Publication, and what it prints.
    at_most_ms : float
        Time of a frame.
    psnr_db : (lowest, highest)
        Of the images in the publication, against its own ground truth.
    """

    name: str
    differs: str
    source: str
    at_most_ms: float
    psnr_db: tuple[float, float]


PRINTED = (
    PrintedPeer(
        name="light-gathering trees",
        differs="samples of the pupil looked up in layered images; low-order "
        "aberrations and partial occlusion, no diffraction, color or field",
        source="Lima, Medeiros, Marques & Oliveira, The Visual Computer 37(9), 2021, "
        "abstract: over 300 samples per pixel in under 6 ms per frame, PSNR 32.4 to "
        "43.0, SSIM 0.94 to 0.99; it names neither resolution nor hardware",
        at_most_ms=6.0,
        psnr_db=(32.4, 43.0),
    ),
)
