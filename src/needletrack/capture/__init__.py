"""Live stereo pairs: the cameras, and which of their frames belong together."""
