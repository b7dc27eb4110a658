"""Data that earlier versions wrote or understood, which later versions must read.

    python -m tests.corpus.freeze

writes it anew, from the version that is checked out: once per release, never to make a
failing test pass.  `tests/end_to_end/test_corpus.py` reads it.
"""
