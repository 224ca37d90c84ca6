"""Errors a user can meet, each with its exit code.

Every failure that a user can cause or fix is raised as an :class:`MbtfError`; the command lines print it
as one or two lines (what, where, what to do) and exit with its code. Anything else is a bug.
"""

from __future__ import annotations

EXIT_OK = 0
EXIT_USAGE = 2
EXIT_BAD_INPUT = 3
EXIT_PARTIAL = 4
EXIT_INTERRUPTED = 130


_BLANKS = str.maketrans("\n\r\t", "   ")


def printable(text: str) -> str:
    """`text` with line breaks and tabs as blanks, and what else cannot be shown written as escapes.

    Names and values come from files of anyone's making; a terminal would obey the codes in them.
    """
    if text.isprintable():
        return text
    text = text.translate(_BLANKS)
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class MbtfError(Exception):
    """Base of all errors that reach a user as a message.

    Parameters
    ----------
    what : what is wrong, in one line
    where : file, key or line the fault lies in; printed before `what`
    hint : what to do about it; printed after `what`
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
    """The command line makes no sense (exit code 2)."""

    exit_code = EXIT_USAGE


class InputError(MbtfError):
    """A file or a configuration value cannot be used (exit code 3)."""

    exit_code = EXIT_BAD_INPUT


class EngineError(MbtfError):
    """The machine cannot run the renderer or the trainer (exit code 3)."""

    exit_code = EXIT_BAD_INPUT


class PartialError(MbtfError):
    """Work is unfinished but what was done is kept; the same command resumes (exit code 4)."""

    exit_code = EXIT_PARTIAL


class Interrupted(MbtfError):
    """The user or the system ended the run (exit code 130); what was done is kept."""

    exit_code = EXIT_INTERRUPTED


def reason(fault: BaseException | str | None, longest: int = 160) -> str:
    """What another library said went wrong, fit to stand in brackets within a message: one line, at most
    `longest` characters."""
    text = printable(" ".join((str(fault) or type(fault).__name__).split()))
    return text if len(text) <= longest else f"{text[: longest - 3]}..."
