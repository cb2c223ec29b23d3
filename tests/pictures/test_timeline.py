import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from needletrack.pictures.palette import STATUS_COLOR
from needletrack.pictures.png import rendered
from needletrack.pictures.timeline import Moment, timeline_figure
from needletrack.publish.message import RunContext, Source, TrackMessage
from needletrack.records import NeedleTrack, Reason, Status, StereoPair

TrueTrack = Callable[[int], tuple[NeedleTrack, StereoPair]]

PERIOD_NS = 33_333_333


def axes_named(figure: Figure, name: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_label() == name)


def moment(index: int, status: Status = Status.OK) -> Moment:
    if status is Status.INVALID:
        return Moment(1_000_000_000 + index * PERIOD_NS, status)
    return Moment(
        captured_at_ns=1_000_000_000 + index * PERIOD_NS,
        status=status,
        tip_mm=np.array([index, -index, 200 + index], dtype=float),
        tip_sigma_mm=np.array([0.1, 0.1, 0.3]),
        length_mm=30.0 + index,
        reprojection_rms_px=0.1,
        latency_ms=20.0,
    )


def test_a_message_and_its_track_are_the_same_moment(true_track: TrueTrack) -> None:
    track, pair = true_track(-1)
    run = RunContext("bench", Source.REPLAY, "c0", "d0")
    message = TrackMessage.from_track(track, pair, run, dropped={}, published=None)
    message = message.model_copy(update={"latency_ms": 21.5})
    of_track, of_message = Moment.of_track(track, latency_ms=21.5), Moment.of_message(message)
    assert (of_message.captured_at_ns, of_message.status) == (track.captured_at_ns, Status.OK)
    assert of_message.latency_ms == of_track.latency_ms == 21.5
    assert of_message.length_mm == pytest.approx(of_track.length_mm, abs=1e-6)
    assert of_message.reprojection_rms_px == of_track.reprojection_rms_px == 0.14
    for name in ("tip_mm", "tip_sigma_mm"):
        np.testing.assert_allclose(getattr(of_message, name), getattr(of_track, name), atol=1e-6)
    assert track.tip is not None
    assert of_track.tip_mm is not None
    assert of_track.tip_sigma_mm is not None
    np.testing.assert_allclose(of_track.tip_mm, track.tip.position_mm)
    np.testing.assert_allclose(of_track.tip_sigma_mm, [0.03, 0.04, 0.08])


def test_an_invalid_track_has_a_moment_without_values(true_track: TrueTrack) -> None:
    _, pair = true_track(0)
    lost = Moment.of_track(NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason.NO_CANDIDATE,)))
    assert lost == Moment(pair.captured_at_ns, Status.INVALID)


def test_values_stand_over_time_and_break_where_there_are_none() -> None:
    moments = [moment(n, Status.INVALID if n in (4, 5) else Status.OK) for n in range(12)]
    # The order of arrival does not matter.
    figure = timeline_figure(moments[::-1])
    rendered(figure)
    for name, expected in {
        "x": np.arange(12.0),
        "y": -np.arange(12.0),
        "z": 200 + np.arange(12.0),
        "length": 30 + np.arange(12.0),
        "reprojection": np.full(12, 0.1),
        "latency": np.full(12, 20.0),
    }.items():
        expected[4:6] = np.nan
        (line,) = axes_named(figure, name).lines
        seconds, values = (np.asarray(data, dtype=float) for data in line.get_data())
        np.testing.assert_allclose(seconds, np.arange(12) * PERIOD_NS / 1e9)
        np.testing.assert_array_equal(values, expected)


def test_the_band_shows_each_pairs_status() -> None:
    statuses = [Status.OK] * 4 + [Status.DEGRADED] * 3 + [Status.INVALID] * 2 + [Status.OK]
    figure = timeline_figure([moment(n, status) for n, status in enumerate(statuses)])
    picture = rendered(figure).astype(float)
    axes = axes_named(figure, "status")
    middles = np.column_stack([np.arange(10) * PERIOD_NS / 1e9, np.full(10, 0.5)])
    columns, rows = (axes.transData.transform(middles) * (1, -1) + (-0.5, picture.shape[0] - 0.5)).T
    at = picture[np.round(rows).astype(int), np.round(columns).astype(int)]
    np.testing.assert_allclose(at, [255 * np.array(to_rgb(STATUS_COLOR[s])) for s in statuses], atol=1)
    written = "".join(text.get_text() for text in figure.texts)
    assert "10 pairs in 0.30 s: 5 ok, 3 degraded, 2 invalid" in written


def test_what_no_pair_has_is_left_out() -> None:
    deterministic = [dataclasses.replace(moment(n), latency_ms=None) for n in range(3)]
    names = {axes.get_label() for axes in timeline_figure(deterministic).axes}
    assert names == {"status", "x", "y", "z", "length", "reprojection"}
    lost = timeline_figure([moment(n, Status.INVALID) for n in range(3)])
    assert {axes.get_label() for axes in lost.axes} == {"status"}
    assert rendered(lost).any()


def test_one_pair_is_a_run() -> None:
    assert rendered(timeline_figure([moment(0)])).any()


def test_no_pair_is_no_run() -> None:
    with pytest.raises(ValueError, match="at least one track"):
        timeline_figure([])
