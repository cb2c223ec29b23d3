"""The page about a recording: what is on it is what was tracked, and it asks nobody for anything."""

import json
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest
from tests.recording.small_recording import write_recording
from tests.report.html_page import Node, decoded, parsed, points_of
from typer.testing import CliRunner, Result

from needletrack import __version__
from needletrack.cli import app
from needletrack.config import Config
from needletrack.errors import RecordingError
from needletrack.geometry.spline import tangents
from needletrack.publish.message import TrackMessage
from needletrack.recording.asl import AslRecording
from needletrack.records import (
    REASON_MEANING,
    BasePose,
    Float,
    Image,
    NeedleCurve,
    NeedleTrack,
    Reason,
    Status,
    StereoPair,
    TipPose,
)
from needletrack.replay import Replay
from needletrack.report import write_report
from needletrack.scoring import recorded_truth

RECORDINGS = Path(__file__).parents[1] / "data" / "recordings"
MOST_BYTES_A_FRAME = 300_000
MS = 1_000_000


@dataclass
class Kept:
    """A sink that keeps what the page is about."""

    pairs: list[StereoPair]
    tracks: list[NeedleTrack]

    def take(self, pair: StereoPair, track: NeedleTrack, message: TrackMessage) -> None:
        self.pairs.append(pair)
        self.tracks.append(track)


@dataclass(frozen=True)
class Reported:
    """A page with what it is about."""

    text: str
    page: Node
    recording: AslRecording
    pairs: list[StereoPair]
    tracks: list[NeedleTrack]

    def frame(self, number: int) -> Node:
        return self.page.by_id(f"pair-{number}")


def reported(folder: Path, output: Path, *, end: int | None = None, **options: Any) -> Reported:
    kept, recording = Kept([], []), AslRecording(folder)
    replay = Replay(recording, Config(), independent=True, end=end)
    written = write_report(replay, output, Event(), sinks=[kept], **options)
    text = output.read_text(encoding="utf-8")
    assert written.size_bytes == output.stat().st_size
    return Reported(text, parsed(text), recording, kept.pairs, kept.tracks)


@pytest.fixture(scope="module", params=["steel-a", "absent-a", "steer-b"])
def report(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Reported:
    output = tmp_path_factory.mktemp("report") / "report.html"
    return reported(RECORDINGS / request.param, output, end=2)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["report", *map(str, arguments)])


def test_every_pair_is_there_with_its_status_and_reasons(report: Reported) -> None:
    assert len(report.tracks) == min(2, len(report.recording))
    frames = report.page.all("section", "frame")
    assert [frame.attributes["id"] for frame in frames] == [f"pair-{pair.sequence}" for pair in report.pairs]
    for frame, track in zip(frames, report.tracks, strict=True):
        assert frame.one("header").one("span", "status").text == track.status.value
        why = " ".join(node.text for node in frame.all("ul", "why"))
        for reason in Reason:
            assert (f"{reason.value} {REASON_MEANING[reason]}" in why) == (reason in track.reasons)
        assert len(frame.all("svg", "cut-out")) == 2
        assert len(frame.all("svg", "arc")) == (track.curve is not None)


def test_the_head_says_what_was_run_and_how_it_went(report: Reported) -> None:
    text = report.page.text
    for said in (
        str(report.recording.folder),
        report.recording.rig.digest,
        Config().digest,
        f"needletrack {__version__}",
    ):
        assert said in text
    tiles = {tile.text for tile in report.page.all("div", "tile")}
    for status in Status:
        assert f"{sum(track.status is status for track in report.tracks)} {status.value}" in tiles


def test_the_index_leads_to_every_pair(report: Reported) -> None:
    rows = report.page.one("table", "index").one("tbody").all("tr")
    links = {row.one("a").attributes["href"] for row in rows}
    assert links == {f"#pair-{pair.sequence}" for pair in report.pairs}
    targets = {node.attributes["id"] for node in report.page.walk() if "id" in node.attributes}
    for link in report.page.all("a"):
        assert link.attributes["href"].removeprefix("#") in targets


def test_it_asks_no_host_for_anything(report: Reported) -> None:
    for node in report.page.walk():
        assert "src" not in node.attributes
        if "href" in node.attributes:
            assert re.match(r"#|data:image/webp;base64,", node.attributes["href"])
    without_images = re.sub(r"data:image/webp;base64,[A-Za-z0-9+/=]+", "", report.text)
    assert not re.search(r"://|@import|url\(|xmlns", without_images)
    policy = next(node for node in report.page.all("meta") if "http-equiv" in node.attributes)
    assert policy.attributes["content"].startswith("default-src 'none'; img-src data:;")


def test_a_pair_takes_no_more_than_its_share(report: Reported) -> None:
    assert len(report.text.encode()) < (len(report.pairs) + 0.5) * MOST_BYTES_A_FRAME


def test_the_images_are_those_of_the_pair(report: Reported) -> None:
    for pair in report.pairs:
        frame = report.frame(pair.sequence)
        for side, original in (("left", pair.left.image), ("right", pair.right.image)):
            shown = frame.one("svg", "cut-out", side).one("image")
            x, y, width, height = (float(shown.attributes[name]) for name in ("x", "y", "width", "height"))
            image = decoded(shown.attributes["href"])
            assert min(x, y) >= -0.5
            cut_out = original[int(y + 0.5) : int(y + 0.5 + height), int(x + 0.5) : int(x + 0.5 + width)]
            assert cut_out.shape == (height, width)
            like = cv2.resize(cut_out, image.shape[::-1], interpolation=cv2.INTER_AREA)
            # Grey levels are stretched, and the darkest and brightest clipped.
            assert np.corrcoef(image.ravel(), like.ravel())[0, 1] > 0.95


def test_the_curve_is_drawn_where_it_projects(report: Reported) -> None:
    for pair, track in zip(report.pairs, report.tracks, strict=True):
        if track.curve is None:
            continue
        frame = report.frame(pair.sequence)
        projected = report.recording.rig.project(track.curve.points_mm)
        for side, points_px in zip(("left", "right"), projected, strict=True):
            svg = frame.one("svg", "cut-out", side)
            drawn = points_of(svg.one("g", "drawn").all("path", "casing")[0])
            np.testing.assert_allclose(drawn, points_px, atol=0.01)
            # Without anything moving it elsewhere, these are the image's own pixels.
            assert "transform" not in {name for node in svg.walk() for name in node.attributes}
            x, y, width, height = map(float, svg.attributes["viewbox"].split())
            assert (points_px >= (x, y)).all()
            assert (points_px <= (x + width, y + height)).all()
            if track.tip is not None:
                tip = svg.one("circle", "mark", "tip").attributes
                at_px = np.array([float(tip["cx"]), float(tip["cy"])])
                np.testing.assert_allclose(at_px, points_px[-1], atol=0.01)


def test_the_strips_show_the_image_along_the_curve(report: Reported) -> None:
    for pair, track in zip(report.pairs, report.tracks, strict=True):
        if track.curve is None:
            continue
        figure = report.frame(pair.sequence).one("svg", "arc")
        projected = report.recording.rig.project(track.curve.points_mm)
        images = (pair.left.image, pair.right.image)
        for side, image, points_px in zip(("left", "right"), images, projected, strict=True):
            shown = figure.one("image", "strip", side)
            strip = decoded(shown.attributes["href"])
            # From base to tip, at the pixels between which the script points.
            x, width = float(shown.attributes["x"]), float(shown.attributes["width"])
            ends = [(float(figure.attributes[f"data-{end}"]) - x) / width for end in ("start", "end")]
            columns = np.linspace(ends[0], ends[1], len(points_px)) * strip.shape[1] - 0.5
            rows = np.arange(3, strip.shape[0] - 3, 4)
            # Half a pixel a row, the axis in the middle, and to the right of the way what is below.
            beside_px = ((rows + 0.5 - strip.shape[0] / 2) / 2)[:, None, None]
            along = tangents(points_px)
            at_px = points_px + beside_px * np.column_stack([-along[:, 1], along[:, 0]])
            there = looked_up(image, at_px)
            in_strip = looked_up(strip, np.dstack(np.meshgrid(columns, rows)))
            inner = (slice(None), slice(3, -3))
            assert np.corrcoef(in_strip[inner].ravel(), there[inner].ravel())[0, 1] > 0.95


def looked_up(image: Image, at_px: Float) -> Float:
    """The image's grey levels at places (M, N, 2)."""
    x, y = (at_px[..., k].astype(np.float32) for k in (0, 1))
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR), dtype=np.float64)


def test_the_chart_has_a_dot_for_every_axis_point_that_was_seen(report: Reported) -> None:
    for pair, track in zip(report.pairs, report.tracks, strict=True):
        if track.evidence.axis_residual_px is None:
            continue
        figure = report.frame(pair.sequence).one("svg", "arc")
        for side, residual_px in zip(("left", "right"), track.evidence.axis_residual_px, strict=True):
            dots = figure.one("path", "dots", side).attributes["d"]
            assert dots.count("M") == np.isfinite(residual_px).sum()


def test_the_truth_is_shown_where_there_is_one(report: Reported) -> None:
    truth = recorded_truth(report.recording.folder)
    assert report.page.all("input")
    for pair in report.pairs:
        drawn = report.frame(pair.sequence).all("g", "truth")
        true_mm = truth[pair.captured_at_ns].centerline_mm
        assert bool(drawn) == (len(true_mm) > 0)
        if drawn:
            cut_out = report.frame(pair.sequence).one("svg", "cut-out", "left")
            points_px = points_of(cut_out.one("path", "true-axis"))
            np.testing.assert_allclose(points_px, report.recording.rig.project(true_mm)[0], atol=0.01)


def test_without_the_truth_nothing_is_said_of_it(tmp_path: Path) -> None:
    told = run(RECORDINGS / "steel-a", "--independent", "--no-truth", "--output", tmp_path / "report.html")
    assert told.exit_code == 0, told.stderr
    assert re.fullmatch(r"written: \S+report.html, \d\.\d MB, 2 of 2 pairs in full\n", told.stdout)
    page = parsed((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert not [node for node in page.walk() if "truth" in node.classes]
    assert "falsely ok" not in page.one("div", "tiles").text


def ok_track(pair: StereoPair, previous: NeedleTrack | None = None) -> NeedleTrack:
    """A track that is ok, of a straight needle in the middle of the images."""
    points_mm = np.column_stack([np.linspace(-20, 20, 81), np.zeros(81), np.full(81, 250.0)])
    curve = NeedleCurve(points_mm, np.full(81, 0.05), np.full(81, 2), np.zeros(81), 40.0)
    x = np.array([1.0, 0, 0])
    tip = TipPose(points_mm[-1], x, np.array([0, 0, 0, 1.0]), 0.01 * np.eye(3), None, 2)
    return NeedleTrack(pair.captured_at_ns, Status.OK, (), curve, tip, BasePose(points_mm[0], x))


@pytest.mark.parametrize("name", ["absent-a", "steel-a"])
def test_a_false_ok_is_told_loudly(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("needletrack.replay.track_pair", lambda pair, *_: ok_track(pair))
    report = reported(RECORDINGS / name, tmp_path / "report.html", end=1)
    head = report.page.one("main").children[1]
    assert head.classes == {"alarm"}
    assert "1 falsely ok." in head.text
    assert head.one("a").attributes["href"] == "#pair-0"
    frame = report.frame(0)
    assert "false" in frame.classes
    assert "Falsely ok." in frame.one("p", "alarm").text
    # A track that came without residuals has none to show, and its strips all the same.
    assert len(frame.all("image", "strip")) == 2


def test_so_many_pairs_are_shown_in_full_and_the_figures_are_of_all(tmp_path: Path) -> None:
    small = write_recording(tmp_path / "small", [number * 10 * MS for number in range(5)])
    report = reported(small, tmp_path / "report.html", most=2)
    assert len(report.page.all("section", "frame")) == 2
    assert "2 of 5 pairs are shown in full" in report.page.text
    assert "5 tracked of 5 played" in report.page.text
    links = {link.attributes["href"] for link in report.page.one("svg", "trends").all("a")}
    assert links == {f"#{frame.attributes['id']}" for frame in report.page.all("section", "frame")}
    assert not report.page.all("svg", "arc")
    none = reported(small, tmp_path / "none.html", most=0)
    assert none.page.all("section", "frame") == []


def test_a_run_that_was_stopped_gives_a_page_about_what_was_done(tmp_path: Path) -> None:
    stop = Event()
    stop.set()
    replay = Replay(AslRecording(RECORDINGS / "steel-a"), Config())
    written = write_report(replay, tmp_path / "report.html", stop)
    assert written.run.pairs == written.shown == 0
    assert "No pair was tracked." in parsed((tmp_path / "report.html").read_text(encoding="utf-8")).text


def test_a_name_is_text_whatever_is_in_it(tmp_path: Path) -> None:
    small = write_recording(tmp_path / "<b>&amp;'\"", [0])
    report = reported(small, tmp_path / "report.html")
    assert report.page.one("h1").text == "<b>&amp;'\": 1 pair tracked"
    assert report.page.all("b") == []


def test_the_reference_method_is_looked_at_alike(tmp_path: Path) -> None:
    result = run(RECORDINGS / "lab-a", "--method", "reference", "--end", 1, "--output", tmp_path / "report.html")
    assert result.exit_code == 0, result.stderr
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "that of 2017" in text
    assert len(parsed(text).all("section", "frame")) == 1
    assert len(text) < 1.5 * MOST_BYTES_A_FRAME


def refused(*arguments: object) -> str:
    """The one line that the command says when it refuses what it was given."""
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("needletrack: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


def test_a_page_that_cannot_be_written_is_refused_before_anything_is_tracked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("needletrack.replay.track_pair", lambda *_: pytest.fail("was tracked"))
    told = refused(RECORDINGS / "steel-a", "--output", tmp_path / "no" / "report.html")
    assert f"make the folder {tmp_path / 'no'} first" in told
    assert "a folder; name a file" in refused(RECORDINGS / "steel-a", "--output", tmp_path)
    assert "there is no such recording" in refused(tmp_path / "none", "--output", tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == []


def test_a_truth_that_cannot_be_read_is_named_with_the_way_round_it(tmp_path: Path) -> None:
    small = write_recording(tmp_path / "small", [0])
    (small / "truth.json").write_text(json.dumps({"frames": [{"board": 1}]}))
    told = refused(small, "--output", tmp_path / "report.html")
    assert f"{small / 'truth.json'}: not the truth about a recording" in told
    assert "--no-truth" in told
    assert run(small, "--no-truth", "--output", tmp_path / "report.html").exit_code == 0


def test_an_older_page_stays_until_the_new_one_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = shutil.copytree(RECORDINGS / "absent-a", tmp_path / "absent-a")
    output = tmp_path / "report.html"
    output.write_text("older")

    def lost(pair: StereoPair, *_: object) -> NeedleTrack:
        # The images vanish before they are read again for the page.
        shutil.rmtree(folder / "cam0" / "data")
        return ok_track(pair)

    monkeypatch.setattr("needletrack.replay.track_pair", lost)
    with pytest.raises(RecordingError, match="cam0"):
        reported(folder, output, end=1)
    assert output.read_text() == "older"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["absent-a", "report.html"]
