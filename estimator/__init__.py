"""Optics of the eye: profiles, wavefronts and float64 point-spread functions."""
