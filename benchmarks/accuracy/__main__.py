"""`python -m benchmarks.accuracy`."""

from benchmarks.accuracy.cli import main

if __name__ == "__main__":
    main()
