"""From pictures of a checkerboard to a calibrated rig: pure functions on images and corners."""
