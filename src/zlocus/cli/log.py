"""The log of a command: everything that is said, with times, and details that the terminal shows only on request."""

from __future__ import annotations

import logging
from contextlib import suppress
from pathlib import Path

from zlocus.core.progress import LineProgress, Progress

# Details of a run come from this logger, at the level DEBUG; Python programs may listen to it too.
LOGGER = "zlocus"
LINE = "%(asctime)s %(message)s"
TIME = "%Y-%m-%dT%H:%M:%S%z"


class _Details(logging.Handler):
    """Shows details as notes of a progress. What is not a detail is said on the terminal already."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(logging.DEBUG)
        self._progress = progress

    def emit(self, record: logging.LogRecord) -> None:
        """Show a record that is a detail."""
        if record.levelno == logging.DEBUG:
            with suppress(OSError):  # the terminal has gone
                self._progress.note(record.getMessage())


class KeptWarnings(logging.Handler):
    """Keeps our warnings as sentences, until it is closed."""

    def __init__(self, sentences: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._sentences = sentences
        logging.getLogger(LOGGER).addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a warning."""
        if record.levelno == logging.WARNING:
            self._sentences.append(record.getMessage().removeprefix("zlocus: "))

    def close(self) -> None:
        """Listen no more."""
        logging.getLogger(LOGGER).removeHandler(self)
        super().close()


class _LogProgress(LineProgress):
    """Progress as lines of a log."""

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger

    def note(self, sentence: str) -> None:
        """See `Progress`."""
        self._logger.info(sentence)


def log_of_command(path: Path | None, progress: Progress | None) -> tuple[logging.Logger, Progress]:
    """The logger of a command, and the progress that writes to it.

    path : file that lines are appended to, None for no file; progress : shows details, None where they are not wanted.

    Raises
    ------
    OSError
        The file cannot be opened.
    """
    logger = logging.getLogger(LOGGER)
    logger.setLevel(logging.DEBUG)
    if path is not None:
        file = logging.FileHandler(path, encoding="utf-8")
        file.setFormatter(logging.Formatter(LINE, TIME))
        logger.addHandler(file)
    if progress is not None:
        logger.addHandler(_Details(progress))
    return logger, _LogProgress(logger)


def close_log(logger: logging.Logger) -> None:
    """Take the log of a command from its logger, and close it."""
    logger.setLevel(logging.NOTSET)
    for handler in logger.handlers[:]:
        logger.removeHandler(handler)
        handler.close()
