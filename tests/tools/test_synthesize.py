import json
import shlex
from pathlib import Path

import numpy as np
from tools.synthesize import main

from needletrack.recording.asl import AslRecording
from needletrack.synthetic.background import Background
from needletrack.synthetic.needle import NeedleMotion
from needletrack.synthetic.rig import default_rig
from needletrack.synthetic.world import LIGHT_ON_DARK, World


def test_what_is_written_reads_back_as_the_world_with_its_truth(tmp_path: Path) -> None:
    folder = tmp_path / "drawn"
    asked = "--count 2 --rate 30 --size 320 256 --seed 3 --lighting light --contrast 5"
    main([str(folder), *shlex.split(asked)])
    world = World(
        default_rig((320, 256)),
        NeedleMotion.random(3),
        Background(contrast=5.0),
        LIGHT_ON_DARK,
        seed=3,
        skew_ns=20_000,
    )
    recording = AslRecording(folder)
    document = json.loads((folder / "truth.json").read_text())
    assert len(recording) == len(document["frames"]) == 2
    expected = list(world.pairs(30.0, 2, start_s=1.0))
    for index, ((pair, truth), told) in enumerate(zip(expected, document["frames"], strict=True)):
        read = recording.read(index)
        assert (read.captured_at_ns, read.skew_us) == (pair.captured_at_ns, 20.0)
        np.testing.assert_array_equal(read.left.image, pair.left.image)
        np.testing.assert_array_equal(read.right.image, pair.right.image)
        assert told["t_ns"] == pair.captured_at_ns
        np.testing.assert_allclose(told["centerline_mm"], truth.centerline_mm, atol=1e-6)
        np.testing.assert_array_equal(told["visible"], truth.visible)
    np.testing.assert_allclose(recording.rig.project([[0, 0, 250]]), world.rig.project([[0, 0, 250]]))


def test_without_a_needle_the_truth_holds_no_shape(tmp_path: Path) -> None:
    folder = tmp_path / "absent"
    main([str(folder), *shlex.split("--count 1 --size 320 256 --absent")])
    (frame,) = json.loads((folder / "truth.json").read_text())["frames"]
    assert frame == {"index": 0, "t_ns": 1_000_000_000}
