#!/usr/bin/env python3
"""Track a recording through the service that runs live; the same as `needletrack replay`.

.venv/bin/python tools/replay_capture.py RECORDING --output tracks.jsonl
"""

import sys

try:
    import typer

    from needletrack.cli import replay
except ModuleNotFoundError as error:
    sys.exit(f"replay_capture: {error}: run `make env`, then .venv/bin/python tools/replay_capture.py ...")

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="markdown")
app.command()(replay)

if __name__ == "__main__":
    app()
