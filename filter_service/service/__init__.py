"""The running service: socket, sessions, builds of profiles, the render loop."""
