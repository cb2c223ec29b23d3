"""A page to look at: what tracking made of a recording, where it went wrong, and what the images show there.

One HTML file with everything in it: it asks no host for anything, and may be kept, sent and opened anywhere.
"""

from needletrack.report.page import Written, write_report

__all__ = ["Written", "write_report"]
