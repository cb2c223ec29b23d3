import numpy as np
import pytest
from benchmarks.frames import SEQUENCE, STILLS, PreloadedRecording, Scene, pairs_of
from benchmarks.subjects import Reference

from needletrack.tracking.reference import reference_stages


@pytest.mark.parametrize("scene", [STILLS, SEQUENCE], ids=lambda scene: scene.name)
def test_the_reference_method_is_timed_as_a_whole(scene: Scene) -> None:
    recording = PreloadedRecording(scene.folder)
    pair = recording.read(0)
    subject = Reference(recording.rig)

    lap = subject(pair)

    truth = reference_stages(pair.left.image, pair.right.image, recording.rig)
    assert subject.points_mm is not None
    np.testing.assert_array_equal(subject.points_mm, truth.points_mm)
    assert set(lap.stages_ms) == {"segmentation", "skeleton", "matching", "reconstruction"}


def test_a_loop_turns_at_both_ends_and_has_as_many_pairs_as_asked() -> None:
    recording = PreloadedRecording(STILLS.folder)

    pairs = list(pairs_of(recording, 11))

    images = [pair.left.image for pair in pairs]
    order = [next(i for i in range(5) if recording.read(i).left.image is image) for image in images]
    assert order == [0, 1, 2, 3, 4, 3, 2, 1, 0, 1, 2]
    stamps = [pair.captured_at_ns for pair in pairs]
    assert stamps == sorted(set(stamps))
