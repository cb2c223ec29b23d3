"""One thread each for OpenCV and the BLAS libraries: what a pair costs, and not what the machine can hide."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import threadpool_info, threadpool_limits  # type: ignore[import-untyped]


@contextmanager
def one_thread() -> Iterator[None]:
    """Within it, OpenCV and every loaded BLAS and OpenMP library of this process use one thread.

    NumPy, SciPy and OpenCV bring a BLAS each, which a limit reaches once it is loaded: import first.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        cv2.setNumThreads(before)


def thread_counts() -> dict[str, int]:
    """Threads in use now, by library."""
    counts = {"opencv": cv2.getNumThreads()}
    for library in threadpool_info():
        counts[f"{library['internal_api']} {library['version'] or ''}".strip()] = int(library["num_threads"])
    return counts
