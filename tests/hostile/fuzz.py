"""Coverage-guided fuzzing of the parsers: python -m tests.hostile.fuzz --seconds 60 [EDGE ...]; `make fuzz`.

Each edge runs in a process of its own, with limits on memory and time; what ended one is kept in build/fuzz/EDGE and
named, and the exit code is 1.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
# Of one input.
_HANGS_S, _MOST_MB = 20, 3000
# Parsers in Python, whose branches lead the fuzzer; what is compiled is seen from outside.
_INSTRUMENTED = ["needletrack", "yaml", "tomllib", "mcap", "rosbags", "csv", "json", "ast"]
_RUNS = re.compile(r"Done (\d+) runs")


def fuzz_one(name: str, seconds: int, corpus: Path, kept: Path) -> None:
    """Fuzz an edge in this process, which ends with it."""
    import atheris

    with atheris.instrument_imports(include=_INSTRUMENTED, enable_loader_override=False):
        from tests.hostile.edges import BY_NAME

    edge = BY_NAME[name]
    for number, content in enumerate(edge.valid()):
        (corpus / f"valid-{number}").write_bytes(content)
    words = corpus.parent / "words"
    entries = ("".join(f"\\x{byte:02x}" for byte in word[:60]) for word in edge.dictionary)
    words.write_text("".join(f'"{entry}"\n' for entry in entries))
    with edge.folder() as folder:

        def target(content: bytes) -> None:
            told = edge.refusal(folder, content)
            assert told is None or folder.name in told or edge.file.rsplit("/", maxsplit=1)[-1] in told, told

        options = [f"-max_total_time={seconds}", f"-timeout={_HANGS_S}", f"-rss_limit_mb={_MOST_MB}", "-len_control=0"]
        longest = max(len(content) for content in edge.valid())
        options += [f"-max_len={2 * longest + 1000}", f"-artifact_prefix={kept}/", f"-dict={words}"]
        atheris.Setup([name, *options, str(corpus)], target)
        atheris.Fuzz()


def main(arguments: list[str] | None = None) -> int:
    """Fuzz the edges named, or all, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("edges", nargs="*", metavar="EDGE", help="such as rig, mcap, bag1; without any: all")
    parser.add_argument("--seconds", type=int, default=60, help="for each edge")
    parser.add_argument("--corpus", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--kept", type=Path, default=ROOT / "build" / "fuzz", help="folder for what ended a process")
    asked = parser.parse_args(arguments)
    if asked.corpus is not None:
        fuzz_one(asked.edges[0], asked.seconds, asked.corpus, asked.kept)
        return 0
    from tests.hostile.edges import EDGES

    failed = [name for name in asked.edges or [edge.name for edge in EDGES] if not _passes(name, asked)]
    if failed:
        sys.stderr.write(f"failed: {', '.join(failed)}; {asked.kept} holds what did it\n")
    return 1 if failed else 0


def _passes(name: str, asked: argparse.Namespace) -> bool:
    kept = asked.kept / name
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        corpus = Path(folder) / "corpus"
        corpus.mkdir()
        command = [sys.executable, "-m", "tests.hostile.fuzz", name, "--seconds", str(asked.seconds)]
        done = subprocess.run(
            [*command, "--corpus", str(corpus), "--kept", str(kept)],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", "OMP_NUM_THREADS": "1", "TMPDIR": folder},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            check=False,
        )
        said = done.stderr.decode(errors="replace")
        runs = _RUNS.search(said)
        grown = len(list(corpus.iterdir()))
        count = runs[1] if runs else "?"
        sys.stdout.write(f"{name:14} {count:>8} files read, {grown} kept as a corpus, exit {done.returncode}\n")
        sys.stdout.flush()
        if done.returncode:
            sys.stderr.write(said[-3000:])
    return done.returncode == 0


if __name__ == "__main__":
    sys.exit(main())
