"""What needletrack costs: time per stage and pair, throughput, memory; and the 2017 method beside it.

`make bench` runs it; docs/performance.md says what is measured and how to read the tables.
"""
