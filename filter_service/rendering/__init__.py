"""From a frame and the cache to the image that the eye sees, pass by pass."""
