from benchmarks.frames import STILLS, PreloadedRecording
from benchmarks.measure import Lap, interleaved
from benchmarks.report import Spread

from needletrack.records import StereoPair


def test_methods_take_turns_on_each_pair_and_the_warm_up_is_left_out() -> None:
    recording = PreloadedRecording(STILLS.folder)
    calls: list[tuple[str, int]] = []

    def subject(name: str, pair: StereoPair) -> Lap:
        calls.append((name, pair.sequence))
        return Lap(float(pair.sequence), 0.0, {}, "")

    laps = interleaved(
        {"a": lambda pair: subject("a", pair), "b": lambda pair: subject("b", pair)},
        [recording.read(index) for index in range(3)],
        warmup=1,
        done=lambda: None,
    )

    assert calls == [("a", 0), ("b", 0), ("a", 1), ("b", 1), ("a", 2), ("b", 2)]
    assert {name: [lap.wall_ms for lap in of_method] for name, of_method in laps.items()} == {
        "a": [1.0, 2.0],
        "b": [1.0, 2.0],
    }


def test_a_spread_tells_median_99th_percentile_and_least() -> None:
    spread = Spread.of(float(value) for value in range(101))

    assert spread == Spread(count=101, median=50.0, p99=99.0, least=0.0)
