"""Recorded stereo streams: what lies on disk, and playing it as a source of pairs."""
