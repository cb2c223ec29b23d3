"""A process beside tracking is nice before it loads anything of its work."""

import multiprocessing
import os
import pickle
from multiprocessing.connection import Connection
from typing import Any

from needletrack.aside import give_way

WITHIN_S = 30.0


class Niceness:
    """When it is unpickled, a number: how nice the process is that does so."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.nice, (0,)


def tell(niceness: int, pipe: Connection) -> None:
    pipe.send(niceness)


def test_it_gives_way_while_it_loads_its_work() -> None:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    work = pickle.dumps((tell, (Niceness(),)))
    process = context.Process(target=give_way, args=(work, theirs), daemon=True)
    process.start()
    theirs.close()
    assert ours.poll(WITHIN_S)
    assert ours.recv() == min(os.nice(0) + 5, 19)
    process.join(WITHIN_S)
    assert process.exitcode == 0
