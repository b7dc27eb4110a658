"""Literature references of a report's figures."""

from __future__ import annotations

SOURCES = {
    "csoba": "Csoba & Kunkli 2023, Fast rendering of central and peripheral human "
    "visual aberrations across the entire visual field with interactive "
    "personalization: the eye model, and the measured conditions among the presets",
    "osa": "Thibos, Applegate, Schwiegerling & Webb 2002 (J Refract Surg 18:S652): "
    "Zernike terms, their order and normalization",
    "vectors": "Thibos, Wheeler & Horner 1997 (Optom Vis Sci 74:367): M, J0, J45",
    "typical": "Thibos, Hong, Bradley & Cheng 2002 (JOSA A 19:2329): typical "
    "higher-order aberrations of 200 eyes",
    "growth": "Berrio, Tabernero & Artal 2010 (J Vis 10(14):34): their growth with age",
    "amplitude": "Anderson, Hentz, Glasser et al. 2008 (IOVS 49:2919): objective "
    "amplitude of accommodation by age",
    "color": "Thibos, Ye, Zhang & Bradley 1992 (Appl Opt 31:3594): the chromatic eye",
    "periphery": "Jaeken & Artal 2012 (IOVS 53:3405): wavefronts of 65 people over the "
    "horizontal meridian",
    "length": "Atchison 2006 (Vision Res 46:2236): eye length and corneal radius by "
    "refraction",
    "acuity": "Watson & Ahumada 2008 (J Vis 8(4):17): acuity from a wavefront",
    "nerves": "Watson & Ahumada 2005 (J Vis 5(9):6), Watson 2013 (J Vis 13(6):18): "
    "contrast sensitivity of people and their mean optics",
    "strehl": "Thibos, Hong, Bradley & Applegate 2004 (J Vis 4(4):9): visual Strehl "
    "ratio (VSOTF)",
    "chart": "Ferris, Kassoff, Bresnick & Bailey 1982 (Am J Ophthalmol 94:91): the "
    "letter chart",
    "straylight": "Vos & van den Berg 1999 (CIE Research Note 135/1): light scattered "
    "in the eye",
    "cataract": "J Ophthalmol 2017:5649532: straylight of cataracts before surgery",
}


class Citations:
    """Numbers the sources in the order of citation."""

    def __init__(self) -> None:
        self._names: list[str] = []

    def __call__(self, *names: str) -> str:
        """Return citation marks such as ``[1, 4]`` for sources."""
        for name in names:
            if name not in self._names:
                self._names.append(name)
        numbers = (str(self._names.index(name) + 1) for name in names)
        return f"[{', '.join(numbers)}]"

    def listed(self) -> tuple[str, ...]:
        """Return the cited sources, numbered."""
        return tuple(
            f"[{k + 1}] {SOURCES[name]}." for k, name in enumerate(self._names)
        )
