"""What the PSF cache of an eye holds, how it is built, kept on disk and read."""
