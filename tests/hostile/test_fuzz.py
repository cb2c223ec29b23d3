"""A short run of the coverage-guided fuzzer; `make fuzz` runs longer."""

from pathlib import Path

import pytest
from tests.hostile import fuzz
from tests.hostile.edges import EDGES

pytest.importorskip("atheris", reason="atheris has no wheel for this platform or Python")


@pytest.mark.slow
@pytest.mark.parametrize("name", [edge.name for edge in EDGES])
def test_nothing_ends_the_process(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert fuzz.main([name, "--seconds", "3", "--kept", str(tmp_path)]) == 0, capfd.readouterr().err
