"""The look that all pictures share: a dark page measured in pixels, its colours, its heading."""

from collections.abc import Sequence
from typing import Literal

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from needletrack.pictures.palette import MUTED, PAGE, PANEL, RULE, STATUS_COLOR, TEXT
from needletrack.records import NeedleTrack, Status

MARGIN_PX = 28
HEADING_PX = 112
# Of a page that has nothing to show but its heading and a sentence.
EMPTY_PX = 280
_PILL_PX = 40

Anchor = Literal["left", "center", "right"]


class Page(Figure):
    """A dark figure of width_px × height_px on which everything is placed in pixels from the top left."""

    def __init__(self, width_px: int, height_px: int) -> None:
        # At 72 dots an inch, a point is a pixel: font sizes and line widths are pixels too.
        super().__init__(figsize=(width_px / 72, height_px / 72), dpi=72, facecolor=PAGE)
        self.width_px, self.height_px = width_px, height_px

    def box(self, x: float, y: float, width: float, height: float) -> tuple[float, float, float, float]:
        """A rectangle with its top left corner at pixel (x, y), in matplotlib's shares of the figure."""
        return (
            x / self.width_px,
            1 - (y + height) / self.height_px,
            width / self.width_px,
            height / self.height_px,
        )

    def axes_at(self, x: float, y: float, width: float, height: float, label: str) -> Axes:
        """Axes with their top left corner at pixel (x, y), in the page's style; `label` names them."""
        axes = self.add_axes(self.box(x, y, width, height), label=label, facecolor=PANEL)
        axes.tick_params(colors=MUTED, labelsize=17, length=5, width=1, color=RULE)
        for spine in axes.spines.values():
            spine.set(color=RULE, linewidth=1.5)
        return axes

    def write(
        self,
        x: float,
        y: float,
        text: str,
        size: float = 20,
        color: str = TEXT,
        anchor: Anchor = "left",
        bold: bool = False,
    ) -> None:
        """Text whose baseline begins (or ends, or has its middle) at pixel (x, y)."""
        self.text(
            x / self.width_px,
            1 - y / self.height_px,
            text,
            fontsize=size,
            color=color,
            ha=anchor,
            va="baseline",
            fontweight="bold" if bold else "normal",
        )

    def write_status(self, x: float, y: float, status: Status) -> float:
        """The status in its colour, top left corner at pixel (x, y); returns its width in pixels."""
        width = 44 + 17 * len(status.value)
        self.add_artist(
            FancyBboxPatch(
                (x / self.width_px, 1 - (y + _PILL_PX) / self.height_px),
                width / self.width_px,
                _PILL_PX / self.height_px,
                boxstyle=f"round,pad=0,rounding_size={12 / self.width_px}",
                mutation_aspect=self.width_px / self.height_px,
                facecolor=STATUS_COLOR[status],
                edgecolor="none",
                transform=self.transFigure,
            )
        )
        self.write(x + width / 2, y + 28, status.value.upper(), 22, PAGE, "center", bold=True)
        return width

    def write_legend(self, x: float, y: float, handles: Sequence[Artist], at_right: bool = False) -> None:
        """A legend on one line that begins (or ends) at pixel x and has its lower edge at pixel y."""
        self.legend(
            handles=list(handles),
            loc="lower right" if at_right else "lower left",
            bbox_to_anchor=(x / self.width_px, 1 - y / self.height_px),
            ncols=len(handles),
            fontsize=19,
            labelcolor=TEXT,
            frameon=False,
            borderaxespad=0,
            borderpad=0,
            handlelength=1.4,
            columnspacing=1.5,
        )

    def write_heading(self, title: str, subtitle: str, track: NeedleTrack | None) -> None:
        """A title with one line under it, and a track's status with its reasons at the right."""
        self.write(MARGIN_PX, 50, title, 30, bold=True)
        self.write(MARGIN_PX, 86, subtitle, 20, MUTED)
        if track is None:
            return
        width = 44 + 17 * len(track.status.value)
        self.write_status(self.width_px - MARGIN_PX - width, 22, track.status)
        if track.reasons:
            codes = " · ".join(reason.value for reason in track.reasons[:3])
            more = f" (+{len(track.reasons) - 3})" if len(track.reasons) > 3 else ""
            self.write(self.width_px - MARGIN_PX, 86, codes + more, 19, STATUS_COLOR[track.status], "right")


def number(value: float, digits: int = 2) -> str:
    """A number with a true minus sign."""
    text = f"{value:.{digits}f}"
    # A rounded negative zero is no negative number.
    return text.lstrip("-") if float(text) == 0 else text.replace("-", "−")
