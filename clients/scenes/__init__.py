"""Two test scenes and a letter chart, built in code without files or downloads."""
