"""All sections in turn."""

import os
from functools import partial

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks.frames import SEQUENCE, STILLS
from benchmarks.machine import Load, Machine, now
from benchmarks.memory import measure_memory
from benchmarks.plan import Plan
from benchmarks.report import Report, SceneTimes
from benchmarks.threads import one_thread
from benchmarks.throughput import measure_throughput
from benchmarks.times import measure_times


def run(plan: Plan, console: Console) -> Report:
    """Measure what the plan says; progress goes to the console where it is a terminal."""
    started_at, at_start = now(), os.getloadavg()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with one_thread(), Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        machine = Machine.here()
        scenes: list[SceneTimes] = []
        throughput, memory = None, None
        if "time" in plan.sections:
            for scene in (STILLS, SEQUENCE):
                total = plan.warmup_pairs + plan.timed_pairs
                task = progress.add_task(f"time, {scene.name}", total=total)
                scenes.append(measure_times(scene, plan, partial(progress.advance, task)))
        if "throughput" in plan.sections:
            total = 2 * plan.rounds * (plan.warmup_pairs + plan.pairs_per_round)
            task = progress.add_task(f"throughput, {SEQUENCE.name}", total=total)
            throughput = measure_throughput(SEQUENCE, plan, partial(progress.advance, task))
        if "memory" in plan.sections:
            # In another process, which is not disturbed to tell how far it is.
            progress.add_task(f"memory, {plan.memory_pairs} pairs of {SEQUENCE.name}", total=None)
            memory = measure_memory(SEQUENCE, plan)
    return Report(
        smoke=plan.smoke,
        machine=machine,
        load=Load(started_at=started_at, ended_at=now(), at_start=at_start, at_end=os.getloadavg()),
        scenes=scenes,
        throughput=throughput,
        memory=memory,
    )
