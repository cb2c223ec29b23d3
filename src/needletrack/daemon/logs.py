"""Structured logs on stderr: JSON lines for the journal, colours for a terminal."""

import json
import logging
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from structlog.typing import EventDict, WrappedLogger

# What a record has by itself; the rest came with it as `extra`.
_OWN = {*logging.makeLogRecord({}).__dict__, "message", "asctime", "taskName"}


@contextmanager
def logged(context: Mapping[str, Any], stream: TextIO | None = None, level: str = "INFO") -> Iterator[None]:
    """What the package logs goes to `stream` (stderr), each record with time, level, logger and `context`.

    Afterwards it goes where it went before.
    """
    stream = stream or sys.stderr

    handler = logging.StreamHandler(stream)
    handler.setFormatter(_coloured(context) if stream.isatty() else _Lines(context))
    logger = logging.getLogger("needletrack")
    before_us = logger.handlers, logger.propagate, logger.level
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.handlers, logger.propagate = before_us[0], before_us[1]
        logger.setLevel(before_us[2])


class _Lines(logging.Formatter):
    """A JSON object for each record, as structlog writes it: it takes 0.1 s to load, for which no daemon waits."""

    def __init__(self, context: Mapping[str, Any]) -> None:
        super().__init__()
        self._context = context

    def format(self, record: logging.LogRecord) -> str:
        at = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="microseconds")
        values = {
            **self._context,
            "event": record.getMessage(),
            "level": record.levelname.lower(),
            "logger": record.name,
            **{name: value for name, value in record.__dict__.items() if name not in _OWN},
            "timestamp": at.replace("+00:00", "Z"),
        }
        if record.exc_info:
            # What a defect leaves, told frame by frame; nobody waits for anything then.
            from structlog.tracebacks import ExceptionDictTransformer

            kind, error, trace = record.exc_info
            if kind is not None and error is not None:
                values["exception"] = ExceptionDictTransformer()((kind, error, trace))
        return json.dumps(values, default=repr)


def _coloured(context: Mapping[str, Any]) -> logging.Formatter:
    import structlog

    def in_context(logger: "WrappedLogger", method: str, event: "EventDict") -> "EventDict":
        return {**context, **event}

    return structlog.stdlib.ProcessorFormatter(
        foreign_pre_chain=[
            structlog.stdlib.add_log_level,
            structlog.stdlib.add_logger_name,
            structlog.stdlib.ExtraAdder(),
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            in_context,
        ],
        processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, structlog.dev.ConsoleRenderer()],
    )
