"""Inline SVG: elements, paths and chart panels whose colours come from the page's style sheet.

Inline, so that one drawing serves a light and a dark page; built as a tree, so that it is well-formed whatever the
texts in it are. No drawing names a host: without a namespace, an SVG within HTML needs none.
"""

from dataclasses import dataclass, replace
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt
from markupsafe import Markup
from matplotlib.ticker import MaxNLocator

from needletrack.records import Float

Element = ET.Element
_LONGEST_TICK = 1e15


def element(parent: Element | None, tag: str, text: str | None = None, /, **attributes: object) -> Element:
    """A new element within another (None: of its own); class_ is `class`, and _ within a name is a hyphen."""
    named = {
        name.rstrip("_").replace("_", "-"): value if isinstance(value, str) else digits(value)
        for name, value in attributes.items()
        if value is not None
    }
    # These two are written as they are, in an SVG alone.
    named = {
        {"viewbox": "viewBox", "preserveaspectratio": "preserveAspectRatio"}.get(k, k): v for k, v in named.items()
    }
    made = ET.Element(tag, named) if parent is None else ET.SubElement(parent, tag, named)
    made.text = text
    return made


def drawing(width: float, height: float, title: str, **attributes: object) -> Element:
    """An empty SVG that is as wide as its place on the page allows, with a title for those who do not see it."""
    svg = element(None, "svg", viewbox=f"0 0 {digits(width)} {digits(height)}", role="img", **attributes)
    svg.set("aria-label", title)
    return svg


def markup(svg: Element) -> Markup:
    """The SVG as a piece of HTML."""
    return Markup(ET.tostring(svg, encoding="unicode", short_empty_elements=True))


def digits(value: object, places: int = 2) -> str:
    """A number with no more digits than a drawing needs."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return str(value)
    return f"{float(value):.{places}f}".rstrip("0").rstrip(".") if value else "0"


def line_path(points: Float, places: int = 2) -> str:
    """The path of a polyline (N, 2), interrupted where a point is not finite; a lone point becomes a dot."""
    parts: list[str] = []
    finite = _known(points)
    for index in np.flatnonzero(finite):
        begins = index == 0 or not finite[index - 1]
        x, y = (digits(value, places) for value in points[index].tolist())
        parts.append(f"{'M' if begins else 'L'}{x} {y}")
        if begins and (index + 1 == len(points) or not finite[index + 1]):
            parts.append("h0")
    return "".join(parts)


def _known(points: Float) -> npt.NDArray[np.bool_]:
    return np.asarray(np.isfinite(points).all(axis=1))


def band_path(low: Float, high: Float, places: int = 2) -> str:
    """The closed outlines between two polylines (N, 2), one for every stretch in which both are finite."""
    finite = _known(low) & _known(high)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], finite, [False]]).astype(np.int8)))
    outlines = [np.vstack([low[a:b], high[a:b][::-1]]) for a, b in edges.reshape(-1, 2)]
    return "".join(line_path(outline, places) + "Z" for outline in outlines)


def ticks(low: float, high: float, count: int, *, whole: bool = False) -> list[float]:
    """Round numbers between two limits, about so many; whole: integers alone."""
    values = MaxNLocator(nbins=max(count, 1), steps=[1, 2, 2.5, 5, 10], integer=whole, min_n_ticks=1).tick_values(
        low, high
    )
    slack = 1e-9 * (high - low)
    return [float(value) for value in values if low - slack <= value <= high + slack]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times the powers of ten between two limits, or the powers alone where those are too many."""
    powers = [10.0**power for power in range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)]
    steps = (1, 2, 5) if len(powers) <= 3 else (1,)
    return [step * power for power in powers for step in steps if low <= step * power <= high]


def tick_text(value: float) -> str:
    """A tick's number, with a true minus sign."""
    return f"{value:.6g}".replace("-", "−") if abs(value) < _LONGEST_TICK else f"{value:.0e}"


@dataclass(frozen=True)
class Panel:
    """A chart's rectangle within a drawing: x, y, width and height there, and the ranges of the data; log: of y."""

    svg: Element
    x: float
    y: float
    width: float
    height: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    log: bool = False

    def place(self, xs: npt.ArrayLike, ys: npt.ArrayLike) -> Float:
        """Where data lie (N, 2), from the panel's own top left; beyond it by at most its own height."""
        x, y = np.asarray(xs, dtype=np.float64), np.asarray(ys, dtype=np.float64)
        low, high = self.y_range
        if self.log:
            y, low, high = np.log(np.maximum(y, 1e-9)), float(np.log(low)), float(np.log(high))
        across = (x - self.x_range[0]) / (self.x_range[1] - self.x_range[0]) * self.width
        up = np.clip((y - low) / (high - low), -1, 2)
        return np.column_stack(np.broadcast_arrays(across, (1 - up) * self.height))

    def layer(self, kind: str) -> "Panel":
        """The same panel, drawing into a group of that class: one that the page can hide."""
        return replace(self, svg=element(self.svg, "g", class_=kind))

    def inside(self) -> Element:
        """A drawing within, which hides what lies outside of the panel."""
        return element(self.svg, "svg", x=self.x, y=self.y, width=self.width, height=self.height)

    def frame(self, label: str, unit: str = "", tick_count: int = 4) -> None:
        """Background, grid, ticks of y, and what y is."""
        element(self.svg, "rect", x=self.x, y=self.y, width=self.width, height=self.height, class_="panel")
        low, high = self.y_range
        for value in log_ticks(low, high) if self.log else ticks(low, high, tick_count):
            at = self.y + self.place(self.x_range[0], value)[0, 1]
            element(self.svg, "line", x1=self.x, x2=self.x + self.width, y1=at, y2=at, class_="grid")
            element(self.svg, "text", tick_text(value), x=self.x - 6, y=at + 4, class_="tick end")
        self.label(label, unit)

    def label(self, label: str, unit: str = "") -> None:
        """What y is, at the left of the ticks, upright to be read."""
        middle = self.y + self.height / 2
        for row, text in enumerate([*label.split("\n"), *([unit] if unit else [])]):
            count = label.count("\n") + 1 + bool(unit)
            at = middle + 4 + 15 * (row - (count - 1) / 2)
            element(self.svg, "text", text, x=8, y=at, class_="label" if row < count - bool(unit) else "label unit")

    def line(self, xs: npt.ArrayLike, ys: npt.ArrayLike, kind: str) -> None:
        """A line through data, interrupted where they are not finite."""
        element(self.inside(), "path", d=line_path(self.place(xs, ys), 1), class_=f"line {kind}")

    def band(self, xs: npt.ArrayLike, low: npt.ArrayLike, high: npt.ArrayLike, kind: str) -> None:
        """The area between two lines."""
        element(self.inside(), "path", d=band_path(self.place(xs, low), self.place(xs, high), 1), class_=f"band {kind}")

    def dots(self, xs: npt.ArrayLike, ys: npt.ArrayLike, kind: str) -> None:
        """A dot at every datum that is finite."""
        points = self.place(xs, ys)
        path = "".join(f"M{digits(x, 1)} {digits(y, 1)}h0" for x, y in points[_known(points)].tolist())
        element(self.inside(), "path", d=path, class_=f"dots {kind}")

    def level(self, value: float, text: str) -> None:
        """A dashed line at one value, such as a gate's, with its name; nothing where it is out of range."""
        if not self.y_range[0] <= value <= self.y_range[1]:
            return
        at = self.y + self.place(self.x_range[0], value)[0, 1]
        element(self.svg, "line", x1=self.x, x2=self.x + self.width, y1=at, y2=at, class_="level")
        # Above the line, or below it where it runs along the upper edge.
        element(
            self.svg,
            "text",
            text,
            x=self.x + self.width - 5,
            y=at + (13 if at < self.y + 14 else -4),
            class_="tick end",
        )

    def legend(self, entries: list[tuple[str, str]]) -> None:
        """Names of what is drawn, (text, kind), in the upper left corner."""
        x = self.x + 8.0
        for text, kind in entries:
            element(self.svg, "line", x1=x, x2=x + 16, y1=self.y + 11, y2=self.y + 11, class_=f"line {kind}")
            element(self.svg, "text", text, x=x + 21, y=self.y + 15, class_="tick legend")
            x += 21 + 6.3 * len(text) + 16

    def x_axis(self, text: str, tick_count: int = 12, *, whole: bool = False) -> None:
        """Ticks of x below the panel, and what x is."""
        bottom = self.y + self.height
        for value in ticks(*self.x_range, tick_count, whole=whole):
            at = self.x + float(self.place(value, self.y_range[0])[0, 0])
            element(self.svg, "line", x1=at, x2=at, y1=bottom, y2=bottom + 4, class_="grid")
            element(self.svg, "text", tick_text(value), x=at, y=bottom + 17, class_="tick middle")
        element(self.svg, "text", text, x=self.x + self.width / 2, y=bottom + 35, class_="label middle")
