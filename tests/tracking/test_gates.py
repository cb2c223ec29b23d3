"""Each gate on both sides of its threshold; and that docs/status.md says what the code does."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from tests.tracking.scenes import RIG, scene

from needletrack.errors import NeedleNotFound
from needletrack.geometry.epipolar import epipolar_lines
from needletrack.geometry.transform import orientation_along
from needletrack.records import (
    REASON_MEANING,
    Float,
    NeedleCurve,
    NeedleTrack,
    Quality,
    Reason,
    Status,
    TipPose,
)
from needletrack.tracking.gates import GateParameters, weaknesses
from needletrack.tracking.needle import Needle, Range, Workspace
from needletrack.tracking.parameters import TrackingParameters
from needletrack.tracking.refine import Refined, RefineModels, refine
from needletrack.tracking.shape import told_of_curve

GATES = GateParameters()
GOOD = Quality(reprojection_rms_px=0.05, epipolar_rms_px=0.2, coverage=1.0)
PAGE = Path(__file__).parents[2] / "docs" / "status.md"


@cache
def good() -> Refined:
    """A needle against which nothing speaks."""
    p = TrackingParameters()
    models = RefineModels(p.needle, p.workspace, p.beside, p.fit, p.ends, p.tip, p.refine)
    return refine(scene("dark").images, RIG, scene("dark").truth.centerline_mm, models)


def curve(
    points_mm: Float | None = None, sigma_mm: float | Float = 0.05, length_mm: float | None = None
) -> NeedleCurve:
    points = good().fit.points_mm if points_mm is None else points_mm
    n = len(points)
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    sigma = np.broadcast_to(sigma_mm, (n,))
    return NeedleCurve(points, sigma, np.full(n, 2), np.zeros(n), length if length_mm is None else length_mm)


def reasons(
    refined: Refined | None = None,
    shape: NeedleCurve | None = None,
    quality: Quality = GOOD,
    previous: NeedleTrack | None = None,
    needle: Needle | None = None,
    workspace: Workspace | None = None,
    along_epipolar_lines: float = 0.0,
) -> tuple[Reason, ...]:
    return weaknesses(
        refined or good(),
        shape or curve(),
        quality,
        needle or Needle(),
        workspace or Workspace(),
        GATES,
        previous,
        along_epipolar_lines=along_epipolar_lines,
    )


def refused(**changes: object) -> Reason:
    with pytest.raises(NeedleNotFound) as lost:
        reasons(**changes)  # type: ignore[arg-type]
    assert lost.value.stage == "gates"
    return Reason(lost.value.reason)


def with_tip_sigma(wanted_mm: float) -> Refined:
    """The good needle, its tip's largest standard deviation in any direction being the wanted one."""

    def excess(sigma_mm: float) -> float:
        covariance = with_tip(sigma_mm=(sigma_mm, sigma_mm)).tip_covariance_mm2
        return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])) - wanted_mm

    each_mm = brentq(excess, 1e-3, 4.0)
    return with_tip(sigma_mm=(each_mm, each_mm))


def with_tip(**changes: object) -> Refined:
    return replace(good(), tip=replace(good().tip, **changes))  # type: ignore[arg-type]


def before(off_mm: float, status: Status = Status.OK) -> NeedleTrack:
    """A track whose tip lay so far from where it is now."""
    tip_mm = curve().points_mm[-1] + np.array([0.0, 0.0, off_mm])
    along = np.array([0.0, 1.0, 0.0])
    tip = TipPose(tip_mm, along, orientation_along(along), np.eye(3), None, 2)
    return NeedleTrack(0, status, () if status is Status.OK else (Reason.LOW_COVERAGE,), curve(), tip)


def test_nothing_speaks_against_a_good_needle() -> None:
    assert reasons() == ()
    assert reasons(previous=before(0.5)) == ()


# Weaknesses: a shape is given, and what is weak is told.


def with_rms(rms_px: float) -> Refined:
    return replace(good(), fit=replace(good().fit, rms_px=rms_px))


Change = Callable[[float], dict[str, object]]


@pytest.mark.parametrize(
    ("reason", "threshold", "change"),
    [
        (Reason.LOW_COVERAGE, -GATES.min_coverage, lambda x: {"quality": replace(GOOD, coverage=-x)}),
        (Reason.HIGH_RESIDUAL, GATES.max_reprojection_rms_px, lambda x: {"refined": with_rms(x)}),
        (Reason.HIGH_UNCERTAINTY, GATES.max_sigma_mm, lambda x: {"shape": curve(sigma_mm=x)}),
        (Reason.HIGH_UNCERTAINTY, GATES.max_sigma_mm, lambda x: {"refined": with_tip_sigma(x)}),
        (Reason.TIP_NOT_SEEN, -GATES.min_tip_contrast, lambda x: {"refined": with_tip(contrast=(99.0, -x))}),
        (
            Reason.TIP_DISAGREES,
            GATES.max_tip_disagreement_mm,
            lambda x: {"refined": with_tip(each_mm=(60.0, 60.0 - x))},
        ),
        (Reason.TIP_DISAGREES, GATES.max_tip_epipolar_px, lambda x: {"quality": replace(GOOD, epipolar_rms_px=x)}),
        (Reason.JUMP, GATES.max_step_mm, lambda x: {"previous": before(x)}),
    ],
    ids=["coverage", "residual", "sigma", "sigma of the tip", "contrast", "tips apart", "tips off the lines", "jump"],
)
def test_a_weakness_is_told_beyond_its_threshold(reason: Reason, threshold: float, change: Change) -> None:
    little = 0.02 * abs(threshold)
    assert reasons(**change(threshold + little)) == (reason,)  # type: ignore[arg-type]
    assert reasons(**change(threshold - little)) == ()  # type: ignore[arg-type]


def test_what_is_not_known_is_weak() -> None:
    assert reasons(replace(good(), base_is_known=False)) == (Reason.AMBIGUOUS_BASE,)
    assert reasons(replace(good(), tip_is_free=False)) == (Reason.TIP_NOT_SEEN,)
    assert reasons(quality=replace(GOOD, coverage=None)) == (Reason.LOW_COVERAGE,)


def test_a_tip_that_hangs_by_nothing_is_none() -> None:
    seen = np.full(len(curve().points_mm), 2)
    seen[-5:] = 0
    assert reasons(shape=replace(curve(), seen=seen)) == ()
    seen[-6:] = 0
    assert reasons(shape=replace(curve(), seen=seen)) == (Reason.TIP_NOT_SEEN,)


def test_an_end_that_hardly_stands_out_has_to_be_agreed_upon_better() -> None:
    contrast = (99.0, 1.01 * GATES.min_tip_contrast)
    for share, found in ((0.65, ()), (0.7, (Reason.TIP_DISAGREES,))):
        apart = (60.0, 60.0 - share * GATES.max_tip_disagreement_mm)
        assert reasons(with_tip(each_mm=apart, contrast=contrast)) == found


def test_a_few_uncertain_points_are_allowed() -> None:
    n = len(curve().points_mm)
    sigma_mm = np.full(n, 0.05)
    sigma_mm[: int(0.04 * n)] = 2.0
    assert reasons(shape=curve(sigma_mm=sigma_mm)) == ()
    sigma_mm[: int(0.07 * n)] = 2.0
    assert reasons(shape=curve(sigma_mm=sigma_mm)) == (Reason.HIGH_UNCERTAINTY,)


def test_only_an_ok_track_can_be_jumped_from() -> None:
    assert reasons(previous=before(40.0, Status.DEGRADED)) == ()


def at_angle(angle_deg: float, share: float) -> Float:
    """A line of which a share runs at an angle to the epipolar lines of the right view, the rest across them."""
    middle_mm = np.array([12.0, 0.0, 250.0])
    ahead_mm = middle_mm + np.array([1.0, 0.0, 0.0])
    # Which slope in space has that angle in the picture is found by bisection.
    low, high, down = 0.0, 10.0, np.array([0.0, 1.0, 0.0])
    for _ in range(60):
        slope = (low + high) / 2
        low, high = (slope, high) if picture_angle(middle_mm, ahead_mm + slope * down) < angle_deg else (low, slope)
    along = np.array([1.0, low, 0.0]) / np.hypot(1.0, low)
    u = np.linspace(0.0, 1.0, 400)
    points = np.where(
        (u < share)[:, None],
        u[:, None] * 40.0 * along,
        share * 40.0 * along + (u - share)[:, None] * np.array([0.0, 40.0, 0.0]),
    )
    return np.asarray(middle_mm - np.array([15.0, 20.0, 0.0]) + points)


def picture_angle(start_mm: Float, end_mm: Float) -> float:
    left_px, right_px = RIG.project(np.stack([start_mm, start_mm + 0.01 * (end_mm - start_mm)]))
    line = epipolar_lines(RIG.fundamental, RIG.left.undistort(left_px))[0]
    along = np.diff(RIG.right.undistort(right_px), axis=0)[0]
    return float(np.degrees(np.arcsin(abs(line[:2] @ along) / np.linalg.norm(along))))


@pytest.mark.parametrize(
    ("angle_deg", "share", "is_weak"),
    [(4.0, 0.6, True), (4.0, 0.4, False), (25.0, 1.0, False), (9.0, 0.9, True)],
)
def test_a_long_stretch_along_the_epipolar_lines_is_told(angle_deg: float, share: float, is_weak: bool) -> None:
    points_mm = at_angle(angle_deg, share)
    fit = replace(good().fit, parameters=np.linspace(0.0, 1.0, len(points_mm)), points_mm=points_mm)
    covariance_mm2 = np.broadcast_to(0.01 * np.eye(3), (len(points_mm), 3, 3))
    *_, along = told_of_curve(fit, covariance_mm2, RIG, GATES.epipolar_angle_deg)
    found = reasons(shape=curve(points_mm), along_epipolar_lines=along)
    assert found == ((Reason.ALONG_EPIPOLAR_LINES,) if is_weak else ())


def test_all_weaknesses_are_told_in_the_order_of_the_list() -> None:
    found = reasons(
        refined=replace(with_tip(contrast=(1.0, 1.0), sigma_mm=(3.0, 3.0)), base_is_known=False),
        quality=Quality(0.1, 5.0, 0.2),
        previous=before(50.0),
    )
    assert found == (
        Reason.AMBIGUOUS_BASE,
        Reason.LOW_COVERAGE,
        Reason.HIGH_UNCERTAINTY,
        Reason.TIP_NOT_SEEN,
        Reason.TIP_DISAGREES,
        Reason.JUMP,
    )


# No needle of the configured kind and place: no shape is given.


def test_what_leaves_the_workspace_is_no_needle() -> None:
    points_mm = curve().points_mm
    box = Workspace(z_mm=Range(min=points_mm[:, 2].min() - 0.1, max=points_mm[:, 2].max() + 0.1))
    assert reasons(workspace=box) == ()
    tight = Workspace(z_mm=Range(min=points_mm[:, 2].min() - 0.1, max=points_mm[:, 2].max() - 0.1))
    assert refused(workspace=tight) is Reason.OUTSIDE_WORKSPACE
    outside = points_mm.copy()
    outside[-1, 2] = np.nan
    assert refused(shape=curve(outside, length_mm=60.0)) is Reason.OUTSIDE_WORKSPACE


def test_length_has_limits() -> None:
    needle = Needle(min_length_mm=20.0, max_length_mm=80.0)
    for length_mm in (20.1, 79.9):
        assert reasons(shape=curve(length_mm=length_mm), needle=needle) == ()
    assert refused(shape=curve(length_mm=19.9), needle=needle) is Reason.TOO_SHORT
    assert refused(shape=curve(length_mm=80.1), needle=needle) is Reason.TOO_LONG


def test_width_has_limits_that_allow_for_blur_and_saturation() -> None:
    needle = Needle(min_diameter_mm=0.8, max_diameter_mm=1.0)
    # A streak shows a fifth less than the thinnest, saturation a third of a millimetre more than the thickest.
    for diameter_mm in (0.65, 0.9, 1.34):
        assert reasons(replace(good(), diameter_mm=diameter_mm), needle=needle) == ()
    for diameter_mm in (0.63, 1.36):
        wrong = replace(good(), diameter_mm=diameter_mm)
        assert refused(refined=wrong, needle=needle) is Reason.WIDTH_OUT_OF_RANGE


# The page


def test_the_page_tells_every_reason_in_its_own_words() -> None:
    page = PAGE.read_text(encoding="utf-8")
    headings = re.findall(r"^### `(\w+)`\n\n(.+)$", page, flags=re.M)
    assert [code for code, _ in headings] == [reason.value for reason in Reason]
    for code, sentence in headings:
        assert sentence == f"*{REASON_MEANING[Reason(code)]}*", f"docs/status.md: {code}"


def test_the_page_says_of_every_reason_when_and_what_to_do() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for section in re.split(r"^### ", page, flags=re.M)[1:]:
        code = section.split("`")[1]
        assert "**Set when** " in section, f"docs/status.md: {code}"
        assert "**Do:** " in section, f"docs/status.md: {code}"


def test_the_page_gives_the_thresholds_of_the_code() -> None:
    page = PAGE.read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| ([\d.]+) ", page, flags=re.M))
    assert rows == {name: f"{value:g}" for name, value in GATES.model_dump().items()}


def test_the_page_says_which_reasons_leave_no_shape() -> None:
    page = PAGE.read_text(encoding="utf-8")
    for section in re.split(r"^### ", page, flags=re.M)[1:]:
        code = Reason(section.split("`")[1])
        stated = re.search(r"^Status: (invalid|degraded|degraded or invalid)\.$", section, flags=re.M)
        assert stated is not None, f"docs/status.md: {code}"
        invalid = {Reason.NO_CANDIDATE, Reason.NO_STEREO_MATCH, *NO_NEEDLE}
        either = {Reason.LOW_COVERAGE, Reason.HIGH_UNCERTAINTY}
        wanted = "invalid" if code in invalid else "degraded or invalid" if code in either else "degraded"
        assert stated[1] == wanted, f"docs/status.md: {code}"


NO_NEEDLE = {Reason.OUTSIDE_WORKSPACE, Reason.TOO_SHORT, Reason.TOO_LONG, Reason.WIDTH_OUT_OF_RANGE}
