"""Where along its curve a needle begins: from flanks of known steps, from drawn sleeves, from what is remembered."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import gaussian_filter1d
from tests.tracking.scenes import ARC, RIG, Scene, scene

from needletrack.geometry import spline
from needletrack.records import Float
from needletrack.tracking.beside import Beside, BesideParameters, look_beside
from needletrack.tracking.ends import EndsParameters, Observed, Stretch, base_end, is_crossed, needle_stretch
from needletrack.tracking.needle import EntrySide

SPACING_MM = 0.4
N = 200
ARC_MM: Float = np.linspace(0.0, (N - 1) * SPACING_MM, N)
SMOOTHED_MM = BesideParameters().smooth_along_mm
PARAMETERS = EndsParameters()
Mask = npt.NDArray[np.bool_]


def view(needle: Mask, flank: Float | None = None, line: Float | None = None) -> Beside:
    """What one view may show across a straight curve; flank (N,) or (2, N) grey levels."""
    flanks = np.full((2, N), 200.0) if flank is None else np.broadcast_to(flank, (2, N)).copy()
    return Beside(flanks, np.where(needle, 800.0, 0.0) if line is None else line)


def between(start: int, stop: int) -> Mask:
    at = np.arange(N)
    return (at >= start) & (at < stop)


def stretch(left: Beside, right: Beside, start: int, stop: int) -> Stretch:
    """The needle's part of a curve that was followed from start to stop."""
    return needle_stretch((left, right), start, stop, SPACING_MM, PARAMETERS)


# The sleeve


def stepped(at: int, before: float = 40.0, after: float = 200.0) -> Float:
    """Grey levels (N,) beside the curve that change at an index, blurred as averaging along the needle does."""
    return np.asarray(gaussian_filter1d(np.where(np.arange(N) < at, before, after), SMOOTHED_MM / SPACING_MM))


@pytest.mark.parametrize("before", [40.0, 185.0, 255.0])
@pytest.mark.parametrize("followed_from", [35, 50, 60], ids=["into the sleeve", "to it", "not quite to it"])
def test_the_needle_begins_where_the_flanks_of_both_views_change(before: float, followed_from: int) -> None:
    shown = view(between(50, 160), stepped(50, before))
    found = stretch(shown, shown, followed_from, 160)
    assert found.sleeve is not None
    assert found.sleeve.index == pytest.approx(50, abs=1)
    assert found.sleeve.step_gray == pytest.approx(abs(200.0 - before), rel=0.15)
    assert (found.start, found.stop) == (found.sleeve.index, 160)


def test_without_a_sleeve_the_stretch_is_what_was_followed() -> None:
    shown = view(between(40, 150))
    assert stretch(shown, shown, 40, 150) == Stretch(40, 150, None)


def test_what_shines_on_in_the_sleeve_is_cut_at_the_edge() -> None:
    # A highlight of the sleeve goes on in line with the needle, fainter than it.
    line = np.where(between(60, 160), 800.0, np.where(between(20, 60), 200.0, 0.0))
    shown = view(between(20, 160), stepped(60), line)
    assert stretch(shown, shown, 20, 160).start == pytest.approx(60, abs=1)


def test_where_the_needle_goes_on_as_before_no_sleeve_begins() -> None:
    # Something wide and dark behind it, on whose edge it does not end.
    shown = view(between(20, 160), stepped(60))
    assert stretch(shown, shown, 20, 160) == Stretch(20, 160, None)


def test_the_sleeve_may_stand_at_the_other_end() -> None:
    shown = view(between(40, 150), stepped(150, 200.0, 40.0))
    found = stretch(shown, shown, 40, 150)
    assert found.sleeve is not None
    assert found.start == 40
    assert found.stop == found.sleeve.index == pytest.approx(150, abs=1)


def test_a_hidden_stretch_beside_the_sleeve_belongs_to_the_needle() -> None:
    # Of 12 mm, and of 28, where at most 20 are allowed.
    shown = view(between(50, 160), stepped(50))
    assert stretch(shown, shown, 80, 160).start == pytest.approx(50, abs=1)
    assert stretch(shown, shown, 120, 160) == Stretch(120, 160, None)


def crossed(at: int, length_mm: float, level: float = 40.0) -> Float:
    return np.where(between(at, at + round(length_mm / SPACING_MM)), level, 200.0)


@pytest.mark.parametrize(
    ("left_flank", "right_flank"),
    [
        (np.stack([stepped(50), np.full(N, 200.0)]), stepped(50)),
        (stepped(50), stepped(80)),
        (stepped(50, 196.0), stepped(50, 196.0)),
        (crossed(100, 3.0), crossed(100, 3.0)),
        (crossed(60, 3.0), crossed(90, 3.0)),
    ],
    ids=["one side", "two places", "too faint", "a rod across", "a vessel behind"],
)
def test_what_else_changes_beside_the_needle_is_no_sleeve(left_flank: Float, right_flank: Float) -> None:
    needle = between(30, 160)
    assert stretch(view(needle, left_flank), view(needle, right_flank), 30, 160) == Stretch(30, 160, None)


@pytest.mark.parametrize(
    "flank",
    [np.stack([stepped(50), np.full(N, 200.0)]), np.stack([stepped(50), stepped(50, 255.0)])],
    ids=["one side", "darker and brighter"],
)
def test_where_the_needle_ends_without_a_change_on_both_sides_is_no_sleeve(flank: Float) -> None:
    shown = view(between(50, 160), flank)
    assert stretch(shown, shown, 50, 160) == Stretch(50, 160, None)


def test_a_rod_across_does_not_hide_the_sleeve() -> None:
    shown = view(between(50, 170), np.minimum(stepped(50, 60.0), crossed(110, 3.0, 20.0)))
    found = stretch(shown, shown, 50, 170)
    assert found.sleeve is not None
    assert found.start == pytest.approx(50, abs=1)


def test_what_begins_on_both_sides_in_both_views_crosses() -> None:
    at = 150
    free, hidden = view(between(20, at)), view(between(20, at), crossed(at, 4.0, 120.0))
    earlier = view(between(20, at), crossed(at - 40, 4.0, 120.0))
    one_side = view(between(20, at), np.stack([crossed(at, 4.0, 120.0), np.full(N, 200.0)]))
    for views, is_hidden in (
        ((free, free), False),
        ((hidden, hidden), True),
        ((earlier, earlier), False),
        # A vessel behind the needle crosses it elsewhere in the other view.
        ((hidden, earlier), False),
        ((hidden, one_side), False),
    ):
        assert is_crossed(views, at * SPACING_MM, ARC_MM, PARAMETERS) == is_hidden


def extended(shown: Scene, beyond_mm: float = 8.0) -> tuple[Float, float, float]:
    """The drawn needle's curve, straight on beyond both ends, and where on it the needle begins and ends, mm."""
    truth = shown.truth
    ahead = np.arange(1, round(beyond_mm / 0.1) + 1)[:, None] * 0.1
    whole = np.concatenate(
        [
            truth.centerline_mm[0] - ahead[::-1] * truth.tangents[0],
            truth.centerline_mm,
            truth.tip_mm + ahead * truth.tip_direction,
        ]
    )
    length_mm = float(spline.arc_length(truth.centerline_mm)[-1])
    start_mm = float(len(ahead) * 0.1)
    return spline.resample(whole, round((length_mm + 2 * start_mm) / SPACING_MM) + 1), start_mm, start_mm + length_mm


def observed(shown: Scene, points_mm: Float, diameter_mm: float) -> Observed:
    left, right = shown.images
    right_mm = RIG.right_from_left.apply(points_mm)
    return (
        look_beside(left, RIG.left, points_mm, diameter_mm, BesideParameters()),
        look_beside(right, RIG.right, right_mm, diameter_mm, BesideParameters()),
    )


@pytest.mark.parametrize("name", ["dark", "light", "steel"])
def test_a_drawn_sleeves_edge_is_the_base(name: str) -> None:
    shown = scene(name)
    points_mm, base_mm, tip_mm = extended(shown)
    start, stop = (round(at_mm / SPACING_MM) for at_mm in (base_mm, tip_mm))
    left, right = observed(shown, points_mm, ARC.diameter_mm)
    found = stretch(left, right, start + 10, stop)
    assert found.sleeve is not None
    # It faces away from the cameras: its rim, 2.5 mm off the axis, hides 2.5 mm times the slope of 0.12 or, for the
    # right camera, 0.25; the edge is found to one spacing, where it is blurred over 0.5 mm.
    assert -0.5 < found.start * SPACING_MM - base_mm < 2.5 * 0.25 + 0.5
    assert found.stop == stop


# Base and tip without a sleeve

ENDS_MM = np.array([[-30.0, -20.0, 250.0], [20.0, 35.0, 250.0]])
LINE_MM = ENDS_MM[0] + np.linspace(0, 1, 50)[:, None] * (ENDS_MM[1] - ENDS_MM[0])


@pytest.mark.parametrize(("side", "end"), [("left", 0), ("top", 0), ("right", -1), ("bottom", -1), ("none", None)])
def test_the_entry_side_tells_base_from_tip(side: EntrySide, end: int | None) -> None:
    assert base_end(LINE_MM, RIG, side, None) == end
    turned = {0: -1, -1: 0, None: None}[end]
    assert base_end(LINE_MM[::-1], RIG, side, None) == turned


def test_the_base_is_where_it_was() -> None:
    assert base_end(LINE_MM, RIG, "none", ENDS_MM[0] + 2.0) == 0
    assert base_end(LINE_MM, RIG, "none", ENDS_MM[1] - 2.0) == -1
    # Where it was has more to say than the side of the image.
    assert base_end(LINE_MM, RIG, "left", ENDS_MM[1] - 2.0) == -1


def test_a_base_that_was_elsewhere_says_nothing() -> None:
    far = ENDS_MM[0] - [40.0, 0.0, 0.0]
    assert base_end(LINE_MM, RIG, "none", far) is None
    assert base_end(LINE_MM, RIG, "right", far) == -1
    # Both ends of a short needle are near to it.
    short = LINE_MM[:4]
    assert base_end(short, RIG, "none", short[0]) is None
