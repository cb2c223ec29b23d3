"""`python -m needletrack`: the command line, also where the package is not installed."""

from needletrack.cli import app

if __name__ == "__main__":
    app(prog_name="needletrack")
