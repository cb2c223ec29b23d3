"""Structured logs on stderr: JSON lines for the journal, colours for a terminal."""

import logging
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TextIO

import structlog
from structlog.typing import EventDict, Processor, WrappedLogger


@contextmanager
def logged(context: Mapping[str, Any], stream: TextIO | None = None, level: str = "INFO") -> Iterator[None]:
    """What the package logs goes to `stream` (stderr), each record with time, level, logger and `context`.

    Afterwards it goes where it went before.
    """
    stream = stream or sys.stderr

    def in_context(logger: WrappedLogger, method: str, event: EventDict) -> EventDict:
        return {**context, **event}

    before: list[Processor] = [
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.stdlib.ExtraAdder(),
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        in_context,
    ]
    render: list[Processor] = (
        [structlog.dev.ConsoleRenderer()]
        if stream.isatty()
        else [structlog.processors.dict_tracebacks, structlog.processors.JSONRenderer()]
    )
    handler = logging.StreamHandler(stream)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=before, processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *render]
        )
    )
    logger = logging.getLogger("needletrack")
    before_us = logger.handlers, logger.propagate, logger.level
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.handlers, logger.propagate = before_us[0], before_us[1]
        logger.setLevel(before_us[2])
