"""Compiled kernels: what the profile of a tracked pair names, in C, called on NumPy's arrays.

`hatch_build.py` compiles the C files of this folder when the package is installed: into `kernels.so`, and on x86-64
into `kernels-v3.so` for processors with AVX2 and FMA as well. Each function is specified by its Python caller; arrays
are C-contiguous. Calls release the interpreter's lock.
"""

from needletrack.kernels.library import Array, Sight, TipView, address, call, packed_lens, two_sights, two_tip_views

__all__ = ["Array", "Sight", "TipView", "address", "call", "packed_lens", "two_sights", "two_tip_views"]
