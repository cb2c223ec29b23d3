"""All sections in turn."""

import os
from collections.abc import Callable
from functools import partial
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks.bars import of_handover, of_memory, of_scene, of_searches, of_start, of_steady, of_throughput
from benchmarks.frames import STILLS
from benchmarks.handover import RATE_HZ, measure_handover
from benchmarks.losses import HIDDEN_PAIRS, RATES_HZ, SCENES, SEEN_PAIRS, searches
from benchmarks.machine import Load, Machine, now
from benchmarks.memory import measure_memory
from benchmarks.plan import Plan
from benchmarks.report import Bar, Report
from benchmarks.start import measure_start
from benchmarks.steady import measure_steady
from benchmarks.threads import one_thread
from benchmarks.throughput import measure_throughput
from benchmarks.times import measure_sequence, measure_stills
from benchmarks.worlds import LARGE_PX, SMALL_PX, drawn, recorded


def run(plan: Plan, console: Console) -> Report:
    """Measure what the plan says; progress goes to the console where it is a terminal."""
    started_at, at_start = now(), os.getloadavg()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    parts: dict[str, Any] = {}
    bars: list[Bar] = []
    with one_thread(), Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        machine = Machine.here()

        def task(name: str, total: int | None) -> Callable[[], None]:
            return partial(progress.advance, progress.add_task(name, total=total))

        small = drawn(SMALL_PX, plan.drawn_pairs, task("draw 1280×1024", plan.drawn_pairs))
        steer = recorded()
        if "steady" in plan.sections:
            large = drawn(LARGE_PX, plan.drawn_pairs, task("draw 2560×2048", plan.drawn_pairs))
            total = 3 * (plan.warmup_pairs + plan.steady_pairs)
            steady = parts["steady"] = measure_steady([small, large, steer], plan, task("steady state", total))
            bars.extend(of_steady(steady))
            del large
        if "searches" in plan.sections:
            total = 2 * (plan.warmup_pairs + plan.searched_pairs)
            total += len(SCENES) * plan.losses * len(RATES_HZ) * (SEEN_PAIRS + HIDDEN_PAIRS)
            found = parts["searches"] = searches([small, steer], plan, task("searches", total))
            bars.extend(of_searches(found))
        if "time" in plan.sections:
            total = plan.warmup_pairs + plan.stills_pairs
            scenes = [measure_stills(STILLS, plan, task(f"time, {STILLS.name}", total))]
            for sequence in (steer, small):
                total = plan.warmup_pairs + plan.timed_pairs
                scenes.append(measure_sequence(sequence, plan, task(f"time, {sequence.name}", total)))
            parts["scenes"] = scenes
            bars.extend(bar for scene in scenes for bar in of_scene(scene))
        if "throughput" in plan.sections:
            total = 2 * plan.rounds * (plan.warmup_pairs + plan.pairs_per_round)
            throughput = parts["throughput"] = measure_throughput(steer, plan, task("throughput", total))
            bars.extend(of_throughput(throughput))
        if "handover" in plan.sections:
            total = round(plan.handover_s * RATE_HZ)
            handover = parts["handover"] = measure_handover(small, plan, task("120 pairs/s", total))
            bars.extend(of_handover(handover))
        if "memory" in plan.sections:
            # In another process, which is not disturbed to tell how far it is.
            task(f"memory, {plan.memory_pairs} pairs", None)
            memory = parts["memory"] = measure_memory(small, plan)
            bars.extend(of_memory(memory))
        if "start" in plan.sections:
            task("start", None)
            start = parts["start"] = measure_start(small.pairs[0], small.rig, plan.starts)
            bars.extend(of_start(start))
    return Report(
        smoke=plan.smoke,
        machine=machine,
        load=Load(started_at=started_at, ended_at=now(), at_start=at_start, at_end=os.getloadavg()),
        bars=bars,
        **parts,
    )
