"""Pure mathematics of two cameras and a curve: no files, clocks, threads or logging."""
