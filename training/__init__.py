"""Making the networks that the service runs."""
