"""Training of the networks; torch lives only here."""
