"""The two test scenes, built in code from numpy arrays: no files, no downloads."""
