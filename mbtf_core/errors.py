"""Errors a user can meet, each with its exit code.

Every failure that a user can cause or fix is raised as an :class:`MbtfError`; the command lines print it
as one or two lines (what, where, what to do) and exit with its code. Anything else is a bug.
"""

from __future__ import annotations

from pathlib import Path

EXIT_OK = 0
EXIT_USAGE = 2
EXIT_BAD_INPUT = 3
EXIT_PARTIAL = 4
EXIT_INTERRUPTED = 130


def printable(text: str) -> str:
    """Replace unprintable characters, line breaks among them, by escapes.

    Names and values come from untrusted files and may contain control codes of terminals.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class MbtfError(Exception):
    """Base of all errors that reach a user as a message.

    Parameters
    ----------
    what : the fault, in one line
    where : file, key or line of the fault; printed before `what`
    hint : a remedy; printed after `what`
    """

    exit_code = 1

    def __init__(self, what: str, *, where: object = None, hint: str = "") -> None:
        self.what = printable(what)
        self.where = None if where is None else printable(str(where))
        self.hint = printable(hint)
        super().__init__(self.message)

    @property
    def message(self) -> str:
        """Where and what on one line, the hint on a second."""
        text = f"{self.where}: {self.what}" if self.where else self.what
        return f"{text}\n  {self.hint}" if self.hint else text


class UsageError(MbtfError):
    """The command line is invalid (exit code 2)."""

    exit_code = EXIT_USAGE


class InputError(MbtfError):
    """A file or a configuration value cannot be used (exit code 3)."""

    exit_code = EXIT_BAD_INPUT


class EngineError(MbtfError):
    """The machine cannot run the renderer or the trainer (exit code 3)."""

    exit_code = EXIT_BAD_INPUT


class PartialError(MbtfError):
    """Work is unfinished; finished parts are kept and the same command resumes (exit code 4)."""

    exit_code = EXIT_PARTIAL


class LockedError(PartialError):
    """Another process works on the same files; later, they may be free or finished."""


def check_type(value: object, kinds: type | tuple[type, ...], where: str, hint: str) -> None:
    """Refuse an argument of another type, as callers from Python may pass.

    Raises
    ------
    UsageError : `value` is of none of the `kinds`
    """
    if not isinstance(value, kinds):
        given = "None" if value is None else f"of the type {type(value).__name__}"
        raise UsageError(f"is {given}", where=where, hint=hint)


def unwritable(path: Path, error: OSError) -> PartialError:
    """The error for a file or folder that cannot be written."""
    return PartialError(
        f"cannot be written ({error.strerror or error})",
        where=path,
        hint="finished files are kept; free space or fix the folder, then run the same command again",
    )


def reason(fault: BaseException | str | None, longest: int = 160) -> str:
    """Message of another library's error, on one line of at most `longest` characters."""
    text = printable(" ".join((str(fault) or type(fault).__name__).split()))
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
