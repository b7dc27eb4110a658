"""These tests need torch: `make test-training` installs it and runs them."""

import importlib.util

if importlib.util.find_spec("torch") is None:
    collect_ignore_glob = ["test_*.py"]
