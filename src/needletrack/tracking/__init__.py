"""From a stereo pair, and the track before it, to a needle track: pure functions, one file a stage."""
