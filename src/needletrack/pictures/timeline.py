"""A run over time: where the tip went, how long the needle was, how well and how fast it was tracked."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from needletrack.pictures.palette import MUTED, RULE, SEEN_COLOR, STATUS_COLOR, TEXT
from needletrack.pictures.theme import HEADING_PX, MARGIN_PX, Page
from needletrack.records import Float, NeedleTrack, Status, frozen_array

WIDTH_PX = 1500
_LEFT_PX, _ROW_PX, _GAP_PX, _STATUS_PX = 150, 150, 22, 36
_FOOT_PX = 84
_LINE = SEEN_COLOR[2]


class _Tip(Protocol):
    @property
    def position_mm(self) -> tuple[float, float, float]: ...

    @property
    def covariance_mm2(self) -> tuple[tuple[float, float, float], ...]: ...


class _Quality(Protocol):
    @property
    def reprojection_rms_px(self) -> float | None: ...


class Message(Protocol):
    """What a timeline reads of a wire message (`needletrack.publish.message.TrackMessage`)."""

    @property
    def captured_at_ns(self) -> int:
        """The pair's stamp."""

    @property
    def status(self) -> Status:
        """The track's status."""

    @property
    def tip(self) -> _Tip | None:
        """The free end."""

    @property
    def length_mm(self) -> float | None:
        """The needle's length."""

    @property
    def quality(self) -> _Quality:
        """How well the shape explains the images."""

    @property
    def latency_ms(self) -> float | None:
        """From exposure or release to publishing."""


@dataclass(frozen=True, slots=True)
class Moment:
    """What a timeline shows of one stereo pair; None where it is not known.

    tip_mm (3,) in the left camera's frame, tip_sigma_mm (3,) its standard deviations along the axes.
    """

    captured_at_ns: int
    status: Status
    tip_mm: Float | None = None
    tip_sigma_mm: Float | None = None
    length_mm: float | None = None
    reprojection_rms_px: float | None = None
    latency_ms: float | None = None

    def __post_init__(self) -> None:
        for name in ("tip_mm", "tip_sigma_mm"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, frozen_array(value, (3,), name))

    @classmethod
    def of_track(cls, track: NeedleTrack, latency_ms: float | None = None) -> Self:
        """The moment of a track."""
        tip = track.tip
        return cls(
            captured_at_ns=track.captured_at_ns,
            status=track.status,
            tip_mm=None if tip is None else tip.position_mm,
            tip_sigma_mm=None if tip is None else np.sqrt(np.diagonal(tip.covariance_mm2)),
            length_mm=None if track.curve is None else track.curve.length_mm,
            reprojection_rms_px=track.quality.reprojection_rms_px,
            latency_ms=latency_ms,
        )

    @classmethod
    def of_message(cls, message: Message) -> Self:
        """The moment of a wire message."""
        tip = message.tip
        return cls(
            captured_at_ns=message.captured_at_ns,
            status=message.status,
            tip_mm=None if tip is None else np.array(tip.position_mm),
            tip_sigma_mm=None if tip is None else np.sqrt(np.diagonal(np.array(tip.covariance_mm2))),
            length_mm=message.length_mm,
            reprojection_rms_px=message.quality.reprojection_rms_px,
            latency_ms=message.latency_ms,
        )


def timeline_figure(moments: Sequence[Moment], title: str = "Run") -> Page:
    """Status, tip x, y and z with two standard deviations, length, reprojection error and latency over time.

    Time counts in seconds from the first pair's stamp; the rows share it. Where a pair has no value, the
    line is interrupted; a quantity that no pair has is left out. Axes are named "status", "x", "y", "z",
    "length", "reprojection" and "latency". Raises ValueError for an empty run.
    """
    if not moments:
        raise ValueError("a timeline needs at least one track")
    moments = sorted(moments, key=lambda moment: moment.captured_at_ns)
    seconds = np.array([moment.captured_at_ns - moments[0].captured_at_ns for moment in moments]) / 1e9
    tip = np.array([_or_nan(moment.tip_mm) for moment in moments])
    sigma = np.array([_or_nan(moment.tip_sigma_mm) for moment in moments])
    rows = [_Row(name, f"tip {name}, mm", tip[:, i], sigma[:, i]) for i, name in enumerate("xyz")]
    length = _series([moment.length_mm for moment in moments])
    reprojection = _series([moment.reprojection_rms_px for moment in moments])
    latency = _series([moment.latency_ms for moment in moments])
    rows += [
        _Row("length", "length, mm", length),
        _Row("reprojection", "reprojection\nrms, px", reprojection, from_zero=True),
        _Row("latency", "latency, ms", latency, from_zero=True),
    ]
    rows = [row for row in rows if np.isfinite(row.values).any()]
    top = HEADING_PX + _STATUS_PX + _GAP_PX
    page = Page(WIDTH_PX, top + len(rows) * (_ROW_PX + _GAP_PX) + _FOOT_PX)
    counted = {status: sum(moment.status is status for moment in moments) for status in Status}
    summary = ", ".join(f"{count} {status.value}" for status, count in counted.items() if count)
    page.write_heading(title, f"{len(moments)} pairs in {seconds[-1]:.2f} s: {summary}", None)
    width = WIDTH_PX - _LEFT_PX - MARGIN_PX
    status_axes = page.axes_at(_LEFT_PX, HEADING_PX, width, _STATUS_PX, "status")
    edges = _edges(seconds)
    _draw_status(status_axes, edges, [moment.status for moment in moments])
    seen = [status for status, count in counted.items() if count]
    handles = [Patch(color=STATUS_COLOR[status], label=status.value) for status in seen]
    page.write_legend(WIDTH_PX - MARGIN_PX, 90, handles, at_right=True)
    for index, row in enumerate(rows):
        axes = page.axes_at(_LEFT_PX, top + index * (_ROW_PX + _GAP_PX), width, _ROW_PX, row.name)
        _draw_row(axes, seconds, row)
        axes.set_ylabel(row.label, color=TEXT, fontsize=18)
        axes.set_xlim(edges[0], edges[-1])
        axes.yaxis.set_label_coords(-0.06, 0.5)
        if index < len(rows) - 1:
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel("time since the first pair, s", color=TEXT, fontsize=20)
    if not rows:
        status_axes.set_xlabel("time since the first pair, s", color=TEXT, fontsize=20)
        status_axes.tick_params(labelbottom=True, bottom=True)
    return page


@dataclass(frozen=True, slots=True)
class _Row:
    name: str
    label: str
    values: Float
    sigma: Float | None = None
    from_zero: bool = False


def _series(values: Sequence[float | None]) -> Float:
    return np.array(values, dtype=np.float64)


def _or_nan(values: Float | None) -> Float:
    return np.full(3, np.nan) if values is None else values


def _edges(seconds: Float) -> Float:
    """Limits (N + 1,) between moments (N,), half a usual interval beyond the first and the last."""
    half = 0.5 if len(seconds) < 2 else max(float(np.median(np.diff(seconds))) / 2, 1e-6)
    inner = (seconds[:-1] + seconds[1:]) / 2
    return np.concatenate([[seconds[0] - half], inner, [seconds[-1] + half]])


def _draw_status(axes: Axes, edges: Float, statuses: Sequence[Status]) -> None:
    for left, right, status in zip(edges[:-1], edges[1:], statuses, strict=True):
        axes.axvspan(left, right, color=STATUS_COLOR[status], linewidth=0)
    axes.set(yticks=[], xlim=(edges[0], edges[-1]), ylim=(0, 1))
    axes.tick_params(labelbottom=False, bottom=False)
    axes.set_ylabel("status", color=TEXT, fontsize=18, rotation=0, ha="right", va="center")


def _draw_row(axes: Axes, seconds: Float, row: _Row) -> None:
    if row.sigma is not None:
        low, high = row.values - 2 * row.sigma, row.values + 2 * row.sigma
        axes.fill_between(seconds, low, high, color=_LINE, alpha=0.25, linewidth=0)
    axes.plot(seconds, row.values, color=_LINE, linewidth=2.5, marker="o", markersize=5)
    axes.grid(color=RULE, linewidth=1)
    axes.set_axisbelow(True)
    axes.margins(y=0.12)
    if row.from_zero:
        axes.set_ylim(0, 1.2 * max(float(np.nanmax(row.values)), 1e-3))
    axes.locator_params(axis="y", nbins=4)
    axes.yaxis.get_offset_text().set_color(MUTED)
