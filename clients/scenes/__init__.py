"""Four scenes and a letter chart, built without files, and their rendering."""
