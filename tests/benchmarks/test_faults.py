"""The fault table: its rows are told apart, its page is rewritten between its marks, and a fault is survived."""

from pathlib import Path

import pytest
from benchmarks.faults.__main__ import BEGIN, END, FAULTS, line, main, update
from benchmarks.faults.table import Fault, Seen

ROOT = Path(__file__).parents[2]


def test_every_row_has_a_name_of_its_own() -> None:
    names = [(each.group, each.name) for each in FAULTS]
    assert len(set(names)) == len(names)


def test_the_page_holds_a_row_of_every_fault() -> None:
    page = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    table = page[page.index(BEGIN) : page.index(END)]
    missing = [each.name for each in FAULTS if f"| **{each.group}**: {each.name} | {each.injected} |" not in table]
    assert missing == []
    assert "not survived" not in table


def test_a_table_replaces_the_one_before(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    row = line(
        Fault("daemon", "killed", "SIGKILL", lambda stage: Seen("", None, "")), Seen("gone | at once", 1.25, "all")
    )
    update(page, [row], [0.5, 1.5])
    text = page.read_text()
    assert "| **daemon**: killed | SIGKILL | gone / at once | 1.25 s | all |" in text
    assert "was 0.5 before and 1.5 at most" in text
    assert "old" not in text
    assert text.startswith("before\n")
    assert text.endswith("after\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["stopped", "one camera unplugged", "power cut while recording", "link cut", "a false neighbour", "invalid"]
)
def test_a_fault_is_survived(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main([name]) == 0, capfd.readouterr().err
    assert f": {name} |" in capfd.readouterr().out
