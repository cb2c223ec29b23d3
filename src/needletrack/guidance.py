"""Holding up the board with guidance: pairs of a live source in, the views that add something recorded.

A view counts when the board shows in both pictures, stood still since the pair before, is sharp, and is elsewhere than
in every view so far; what is still missing is told after each pair.
"""

from collections.abc import Callable
from dataclasses import dataclass
from threading import Event

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from needletrack.calibration.board import Board, BoardView, find_board
from needletrack.calibration.coverage import CELLS, TILTS, WANTED_VIEWS, Coverage, adds_something, coverage
from needletrack.calibration.coverage import displacement_px as moved_px
from needletrack.capture.source import FrameSource
from needletrack.recording.board import BoardRecorder
from needletrack.records import Int

# Corners of a board at rest move by less from pair to pair; a view this near to another adds nothing.
STILL_PX = 1.5
ELSEWHERE_PX = 25.0
_SHARP_PX = 1.5


@dataclass(frozen=True, slots=True)
class Guidance:
    """What a person holding the board needs to know: the last pair's fate, and what is missing.

    accepted: of the views so far; sequence: of the last pair; enough: so many views do, wherever the board is (None:
    all that a calibration needs).
    """

    sequence: int
    accepted: int
    said: str
    covered: Coverage
    enough: int | None = None

    @property
    def missing(self) -> tuple[str, ...]:
        """What to show next, the most useful first; empty where nothing is missing."""
        if self.enough is None:
            return self.covered.missing
        more = self.enough - self.accepted
        return (f"hold the board still at {more} more place{'s' if more > 1 else ''}",) if more > 0 else ()

    @property
    def share(self) -> float:
        """How much of what is wanted is there, 0 to 1."""
        return self.covered.share if self.enough is None else min(1.0, self.accepted / self.enough)

    @property
    def done(self) -> bool:
        """Whether nothing is missing any more."""
        return not self.missing


def collect(
    source: FrameSource,
    board: Board,
    recorder: BoardRecorder,
    stop: Event,
    told: Callable[[Guidance], None] = lambda guidance: None,
    *,
    enough: int | None = None,
) -> Guidance | None:
    """Record the views that add something until nothing is missing, the source ends or `stop` is set.

    enough: end after so many views; without it, once they cover what a calibration needs. Returns the last guidance;
    None where no pair came. Raises as the source and the recorder do.
    """
    views: list[BoardView] = []
    before: BoardView | None = None
    guidance = None
    for pair in source.pairs(stop):
        view = find_board(pair.left.image, pair.right.image, board)
        refusal = _refusal(view, before, views)
        if not refusal:
            recorder.write(pair)
            views.append(view)
        before = view
        height, width = pair.left.image.shape
        covered = coverage(views, board, (width, height))
        guidance = Guidance(pair.sequence, len(views), refusal or "taken", covered, enough)
        told(guidance)
        if guidance.done or stop.is_set():
            break
    return guidance


def _refusal(view: BoardView, before: BoardView | None, views: list[BoardView]) -> str:
    without = [side for side, px in (("left", view.left_px), ("right", view.right_px)) if px is None]
    if without:
        faults = [fault for fault in view.faults if fault]
        return f"not in the {' and the '.join(without)} picture" + (f" ({faults[0]})" if faults else "")
    if any(blur is not None and blur > _SHARP_PX for blur in view.blur_px):
        return "blurred: nearer to the focus, or hold it still"
    if before is None or moved_px(view, before) > STILL_PX:
        return "moving: hold it still"
    if not adds_something(view, views, ELSEWHERE_PX):
        return "taken already: move on"
    return ""


def drawn(guidance: Guidance) -> RenderableType:
    """Guidance for a terminal: a picture of what both views and the tilts cover, and what is missing."""
    covered = guidance.covered
    grids = Table.grid(padding=(0, 3))
    grids.add_row(*(_ninths(covered.corners[side]) for side in (0, 1)), _tilts(covered))
    grids.add_row(Text("left view", style="dim"), Text("right view", style="dim"), Text("tilts", style="dim"))
    wanted = guidance.missing
    next_up = Text(f"next: {wanted[0]}" if wanted else "nothing is missing", style="bold")
    more = [Text(f"also: {sentence}", style="dim") for sentence in wanted[1:4]]
    filled = round(30 * guidance.share)
    bar = Text("█" * filled, style="green") + Text("░" * (30 - filled))
    head = Text(f"{guidance.accepted} of {guidance.enough or WANTED_VIEWS} views  ") + bar
    return Panel(
        Group(head, Text(f"pair {guidance.sequence}: {guidance.said}"), Text(""), grids, Text(""), next_up, *more),
        title="calibration" if guidance.enough is None else "check",
        width=96,
    )


def _ninths(counts: Int) -> Text:
    text = Text()
    for row in range(CELLS):
        for column in range(CELLS):
            is_seen = bool(counts[row, column])
            text.append("███" if is_seen else " · ", style="green" if is_seen else "yellow")
            text.append(" ")
        text.append("\n" if row + 1 < CELLS else "")
    return text


def _tilts(covered: Coverage) -> Text:
    text = Text()
    for index, (name, count) in enumerate(zip(TILTS, covered.tilts, strict=True)):
        text.append(f"{'✓' if count else '·'} {name}", style="green" if count else "yellow")
        text.append("\n" if index + 1 < len(TILTS) else "")
    return text


def plain(guidance: Guidance) -> str:
    """The same on one line, where there is no terminal."""
    wanted = guidance.missing
    return f"pair {guidance.sequence}: {guidance.said}; {guidance.accepted} views; " + (
        f"next: {wanted[0]}" if wanted else "nothing is missing"
    )


class GuidanceShown:
    """Shows guidance on a console: a picture that stays in place on a terminal, lines elsewhere."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False) if console.file.isatty() else None
        self._last = ""

    def __enter__(self) -> "GuidanceShown":
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *raised: object) -> None:
        if self._live is not None:
            self._live.stop()

    def take(self, guidance: Guidance) -> None:
        """Show what is so now."""
        if self._live is not None:
            self._live.update(drawn(guidance), refresh=True)
            return
        said = plain(guidance)
        # A line for each change, not for each pair.
        if said.partition(":")[2] != self._last.partition(":")[2]:
            self._console.print(said, markup=False, highlight=False, soft_wrap=True)
        self._last = said
