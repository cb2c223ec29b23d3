"""The life of a process beside tracking, which gives way to it from its first moment on.

This loads next to nothing: what the work needs is loaded when the process is nice already. Loading takes it a second,
which the first pairs would else share their processor with.
"""

import ctypes
import os
import pickle
import signal
from multiprocessing.connection import Connection

_PR_SET_PDEATHSIG, _NICE = 1, 5


def give_way(work: bytes, pipe: Connection) -> None:
    """Do the work, a pickled function and its arguments but for the last, which is the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # It must not outlive a parent that was killed.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    # Whoever starts it may be tied to a processor of its own, and must not wait for it.
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    os.nice(_NICE)
    function, arguments = pickle.loads(work)
    function(*arguments, pipe)
