"""The benchmark's commands run, and leave their records; what they measure means nothing here."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks import compare
from benchmarks.bars import at_least, at_most
from benchmarks.machine import ROOT
from benchmarks.report import Report

PYTHON = [sys.executable, "-m"]


def test_a_bar_is_met_by_its_own_figure_and_missed_beyond_it() -> None:
    assert at_most("time", 2.0, 2.0, " ms").met
    assert not at_most("time", 2.01, 2.0, " ms").met
    assert at_least("rate", 400.0, 400.0).met
    assert not at_least("rate", 399.0, 400.0).met
    assert at_most("time", 2.0, 2.0, " ms").bar == "≤ 2 ms"


@pytest.mark.slow
def test_every_run_leaves_a_record_with_its_bars(tmp_path: Path) -> None:
    command = [*PYTHON, "benchmarks", "--smoke", "--only", "throughput", "--history", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=120)
    (record,) = tmp_path.glob("*.json")
    report = Report.model_validate_json(record.read_text(encoding="utf-8"))
    assert report.smoke
    assert report.throughput is not None
    (bar,) = report.bars
    assert bar.name in done.stdout
    assert ("met" if bar.met else "MISSED") in done.stdout


def test_a_commit_that_git_does_not_know_is_said_to_be_so() -> None:
    with pytest.raises(SystemExit, match="git knows no commit 'never-there'"):
        compare.main(["never-there"])


@pytest.mark.slow
def test_the_whole_benchmark_runs(tmp_path: Path) -> None:
    command = [*PYTHON, "benchmarks", "--smoke", "--history", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=280)
    (record,) = tmp_path.glob("*.json")
    report = Report.model_validate_json(record.read_text(encoding="utf-8"))
    assert None not in (report.steady, report.searches, report.handover, report.memory, report.start)
    assert len(report.scenes) == 3


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="commits are compared in a clone")
def test_a_commit_is_compared_with_itself(tmp_path: Path) -> None:
    command = [*PYTHON, "benchmarks.compare", "HEAD", "--smoke", "--history", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=280)
    (record,) = tmp_path.glob("compare-*.json")
    (round_,) = json.loads(record.read_text(encoding="utf-8"))["rounds"]
    assert set(round_["this"]["steer-b"]) == set(round_["base"]["steer-b"])
    assert "steer-b: track_pair" in done.stdout
