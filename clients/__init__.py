"""What users copy: the client library and programs that use it."""
