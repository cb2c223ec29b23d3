from benchmarks.frames import STILLS
from benchmarks.search import STAGES, recorded, row, searched


def test_every_stage_of_a_search_is_measured() -> None:
    rig, (images,) = recorded(STILLS.folder, 1)
    stages, candidates = searched(images, rig)
    assert tuple(stages) == STAGES
    assert all(ms > 0 for ms in stages.values())
    assert candidates >= 1
    name, *cells = row("lab-a", rig, [images], 1).split()
    assert name == "lab-a"
    assert len(cells) == len(STAGES) + 3
    assert float(cells[-1]) == candidates
