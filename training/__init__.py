"""Training of the networks, with torch, which the service never imports."""
