"""One setting for all tests: no display, and the same examples on every run."""

import os

from hypothesis import settings

os.environ["MPLBACKEND"] = "Agg"

# A slow or busy machine must not fail a property, nor must chance.
settings.register_profile("needletrack", deadline=None, derandomize=True)
settings.load_profile("needletrack")
