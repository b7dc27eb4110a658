"""Checks and files of a release, for `make release` and `make release-check`."""
