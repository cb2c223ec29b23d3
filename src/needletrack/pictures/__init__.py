"""Pictures of a track: its curve in both views, its distance map, its shape in space; and a run over time.

Figures are matplotlib's, made without pyplot: no window, no global state. Each module is imported by itself: the daemon
draws its overlays (`views.py`) without matplotlib, which takes half a second and 30 MB to load.
"""
