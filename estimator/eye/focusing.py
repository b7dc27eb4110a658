"""What any eye answers about focus and pupil: its reach, and what it cannot meet."""

OUT_OF_REACH_DPT = 1e-6
"""A request farther than this from what the eye can do is said to be out of reach."""


class Focusing:
    """Accommodation of an eye, whatever its wavefronts come from.

    Attributes
    ----------
    refraction_dpt : float
        Least-squares M at 555 nm of the relaxed eye, through the worn correction: its
        far point is at -M.
    amplitude_dpt : float
        Largest accommodation.
    """

    refraction_dpt: float
    amplitude_dpt: float

    def accommodation_dpt(self, focus_dpt: float) -> float:
        """Accommodation a = clamp(f + M(555 nm), 0, amplitude) for a focus distance."""
        return min(max(focus_dpt + self.refraction_dpt, 0.0), self.amplitude_dpt)

    def reachable_focus_dpt(self, focus_dpt: float) -> float:
        """Distance, dpt, that the eye is really focused at when asked for this one."""
        return self.accommodation_dpt(focus_dpt) - self.refraction_dpt

    def focus_notes(self, focus_dpt: float) -> tuple[str, ...]:
        """Say in words what of a focus distance this eye cannot meet."""
        asked_dpt = focus_dpt + self.refraction_dpt
        if asked_dpt < -OUT_OF_REACH_DPT:
            return (
                f"focus {focus_dpt:g} dpt is beyond the far point "
                f"({-self.refraction_dpt:.3g} dpt): the eye stays relaxed",
            )
        if asked_dpt <= self.amplitude_dpt + OUT_OF_REACH_DPT:
            return ()
        near_dpt = self.amplitude_dpt - self.refraction_dpt
        reached = (
            f"is nearer than the near point ({near_dpt:.3g} dpt)"
            if near_dpt >= 0.0
            else f"is out of reach, as all distances are by {-near_dpt:.3g} dpt or more"
        )
        return (
            f"focus {focus_dpt:g} dpt {reached}: "
            f"accommodation stops at {self.amplitude_dpt:.3g} dpt",
        )


class FocusingEye(Focusing):
    """The same of an eye that knows its wavefronts up to some pupil.

    Attributes
    ----------
    max_pupil_diameter_mm : float
        Above it the pupil is capped.
    pupil_limit : str
        What that pupil is: "measured" or "traced".
    """

    max_pupil_diameter_mm: float
    pupil_limit: str

    def usable_pupil_mm(self, pupil_diameter_mm: float) -> float:
        """Pupil asked for, capped where the eye knows no more."""
        return min(pupil_diameter_mm, self.max_pupil_diameter_mm)

    def notes(self, *, pupil_diameter_mm: float, focus_dpt: float) -> tuple[str, ...]:
        """Say in words what of the request this eye cannot meet."""
        notes = self.focus_notes(focus_dpt)
        if pupil_diameter_mm <= self.max_pupil_diameter_mm + 1e-9:
            return notes
        capped = (
            f"pupil {pupil_diameter_mm:g} mm capped at the {self.pupil_limit} "
            f"{self.max_pupil_diameter_mm:g} mm"
        )
        return (capped, *notes)
