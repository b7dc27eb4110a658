"""Two test scenes and a letter chart, built in code: no files, no downloads."""
