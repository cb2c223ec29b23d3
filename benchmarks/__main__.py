"""`python -m benchmarks`; imports late, since the processes that it starts import this file first."""

if __name__ == "__main__":
    from benchmarks.cli import main

    main()
