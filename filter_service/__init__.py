"""The running filter service; this file imports nothing, so clients never load GL."""
