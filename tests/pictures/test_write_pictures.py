from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from needletrack.pictures.files import write_pictures
from needletrack.recording.asl import AslRecording
from needletrack.records import NeedleTrack, Reason, Status, StereoPair

TrueTrack = Callable[[int], tuple[NeedleTrack, StereoPair]]


@pytest.mark.parametrize("found", [True, False])
def test_three_pictures_are_written_whether_or_not_a_needle_was_found(
    steer: AslRecording, true_track: TrueTrack, tmp_path: Path, found: bool
) -> None:
    track, pair = true_track(-1)
    if not found:
        track = NeedleTrack(pair.captured_at_ns, Status.INVALID, (Reason.NO_CANDIDATE,))
    paths = write_pictures(track, pair, steer.rig, tmp_path / "pictures", "last")
    names = ["last-overlay.png", "last-distance-map.png", "last-shape.png"]
    assert [path.name for path in paths] == names
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == sorted(names)
    for path in paths:
        image = cv2.imread(str(path))
        assert image is not None
        assert image.shape[1] >= 1200
        # Small enough for a README and a repository.
        assert path.stat().st_size < 1_500_000
    if found:
        heights = [image.shape[0] for path in paths if (image := cv2.imread(str(path))) is not None]
        assert min(heights) > 800
