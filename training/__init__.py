"""Training of the networks; the only package that imports torch."""
