"""How far off needletrack is, against exact truth; the 2017 method and public peers beside it on the same frames.

`make accuracy` runs it; docs/accuracy.md says what is measured and how to read the tables.
"""
