"""Common command-line behavior of the three programs: errors, exit codes, JSON, progress.

A program defines its commands with cyclopts, in an application of :func:`new_app`, and passes it to
:func:`run`. ``mbtf-fit shards/`` runs the default command, ``mbtf-fit info …`` a named one. A command has a
keyword parameter ``console: Console = CONSOLE``, returns None or an exit code, and raises
:class:`~mbtf_core.errors.MbtfError` for every error that a user can cause. Results go to standard output.
Progress, notes and warnings (of any logger of the packages) go to standard error.
"""

from __future__ import annotations

import contextlib
import difflib
import json as json_module
import logging
import os
import re
import sys
import traceback
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from cyclopts import App, CycloptsError, Group, Parameter, UnusedCliTokensError
from pydantic_core import to_jsonable_python

from mbtf_core.app.options import HELP_ALL, MORE, Switch, show_whole_page
from mbtf_core.app.progress import BarProgress, LineProgress, Progress
from mbtf_core.errors import (
    EXIT_BAD_INPUT,
    EXIT_INTERRUPTED,
    EXIT_OK,
    EXIT_USAGE,
    MbtfError,
    UsageError,
    printable,
    reason,
)
from mbtf_core.run import signals

EXIT_INTERNAL = 1
_EXIT_BROKEN_PIPE = 141
# Whether the running command has printed its result.
_reported = False
_PACKAGES = ("mbtf_core", "mbtf_gen", "mbtf_fit", "mbtf_pipeline")


def _plain(value: Any) -> Any:
    """An array, a NumPy number or anything else that JSON does not know, in its types."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


@Parameter(name="*", group=MORE)
@dataclass(frozen=True)
class Console:
    """Output of a command; every command has a keyword parameter `console` of this type.

    Attributes
    ----------
    json : print one JSON object on standard output instead of text
    quiet : no progress and no notes; warnings and errors stay
    debug : an error shows its traceback; the logs of developers are shown
    """

    json: Annotated[Switch, Parameter(help="Print one JSON object on standard output.")] = False
    quiet: Annotated[Switch, Parameter(alias="-q", help="Hide progress and notes.")] = False
    debug: Annotated[Switch, Parameter(help="Show the traceback of an error.")] = False

    def note(self, text: str) -> None:
        """A line for people, on standard error."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    def report(self, data: Mapping[str, Any], text: str) -> None:
        """The command's result, on standard output: `data` as one JSON object with ``--json``, else `text`.

        Paths, arrays, NumPy numbers and pydantic models are converted; NaN and infinities become null.
        """
        global _reported
        _reported = True
        if self.json:
            plain = to_jsonable_python(dict(data), inf_nan_mode="null", fallback=_plain)
            text = json_module.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False)
        print(text)

    @contextlib.contextmanager
    def progress(self, total: float | None, label: str, unit: str = "") -> Iterator[Progress]:
        """Progress of a job of `total` units.

        On a terminal a bar; elsewhere a line every ten seconds and one at the end.
        """
        kind: type[Progress] = Progress
        if not self.quiet:
            kind = BarProgress if sys.stderr.isatty() else LineProgress
        bar = kind(total, label, unit)
        try:
            yield bar
        finally:
            bar._close()


# Default of every command's `console` parameter: text, with progress.
CONSOLE = Console()


def new_app(name: str, description: str, *examples: str) -> App:
    """A cyclopts application for :func:`run`, with ``--help``, ``--help-all`` and ``--version``.

    Parameters
    ----------
    name : of the program
    description : one sentence
    examples : command lines that its help shows
    """

    def version() -> str:
        from importlib.metadata import version as installed

        return f"{name} {installed('mbtf')}"

    app = App(
        name=name,
        help="\n".join([f"{description}\n", *(f"- `{example}`" for example in examples)]),
        group_parameters=Group.create_default_parameters("Options"),
        help_flags=("--help", "-h", HELP_ALL),
        version=version,
        help_format="markdown",
        default_parameter=Parameter(negative_iterable=()),
        exit_on_error=False,
        print_error=False,
        suppress_keyboard_interrupt=False,
        result_action="return_value",
    )
    app.register_install_completion_command(group=MORE)
    app["--version"].group = MORE
    app["--help"].show = False
    return app


class _LogHandler(logging.Handler):
    """Prints log records as plain lines on the current standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        prefix = f"{record.levelname.lower()}: " if record.levelno > logging.INFO else ""
        print(prefix + printable(record.getMessage()), file=sys.stderr, flush=True)


def _route_logs(tokens: Sequence[str], debug: bool) -> None:
    level = logging.WARNING if {"-q", "--quiet"} & set(tokens) else logging.INFO
    for package in _PACKAGES:
        logger = logging.getLogger(package)
        logger.handlers = [_LogHandler()]
        logger.propagate = False
        logger.setLevel(logging.DEBUG if debug else level)


def _commands(app: App) -> list[str]:
    return [name for name in app if not name.startswith("-")]


def _missed_command(app: App, tokens: Sequence[str], text: str) -> str:
    """Message of a failed line of the default command that may have meant another one; empty where none."""
    words = [token for token in tokens if not token.startswith("-") and not os.path.exists(token)]
    if not words:
        return ""
    if tokens[0] != words[0]:
        # The value of an option may be named like a command.
        meant = words if text.startswith("unexpected argument") else words[: words[0] in text]
        late = next((word for word in meant if word in _commands(app)), None)
        return "" if late is None else f"{text}\n  did you mean: {app.name[0]} {late} {tokens[0]} …"
    near = difflib.get_close_matches(words[0], _commands(app), n=1, cutoff=0.75)
    if not near or near[0] == words[0]:
        return ""
    return f"{printable(words[0])}: no such file or command\n  did you mean: {app.name[0]} {near[0]}"


def _usage_message(app: App, fault: CycloptsError, tokens: Sequence[str]) -> str:
    """Message of a command-line error, with a pointer to the help."""
    if isinstance(fault, UnusedCliTokensError) and fault.unused_tokens:
        text = f"unexpected argument '{reason(fault.unused_tokens[0])}'"
    else:
        text = reason(fault, 300)
    if missed := _missed_command(app, tokens, text):
        return missed
    command = f" {tokens[0]}" if tokens and tokens[0] in _commands(app) else ""
    return f"{text}\n  see {app.name[0]}{command} --help"


def _fail(text: str, code: int, debug: bool, json: bool) -> int:
    if signals.interrupted():
        # Libraries turn an interruption into errors of their own.
        text, code = signals.message(), EXIT_INTERRUPTED
    with contextlib.suppress(OSError):
        if debug:
            traceback.print_exc()
        print(f"error: {text}", file=sys.stderr, flush=True)
        if json and not _reported:
            found = {"error": text.replace("\n  ", "; "), "exit_code": code}
            print(json_module.dumps(found, indent=2, ensure_ascii=False), flush=True)
    return code


@contextlib.contextmanager
def _library_warnings(shown: bool) -> Iterator[None]:
    """Hide Python's raw warnings, which are for developers, unless they are asked for."""
    with warnings.catch_warnings():
        if not shown and not sys.warnoptions:
            warnings.simplefilter("ignore")
        yield


def _check_tokens(tokens: Sequence[str]) -> None:
    """Refuse empty arguments, which paths would take as the current folder, and those that are not text."""
    for before, token in zip(("", *tokens), tokens, strict=False):
        if token in ("", "--output=", "-o="):
            where = (token or before).rstrip("=")
            hint = "check the variable of the shell that it is made from"
            raise UsageError("is empty", where=where if where.startswith("-") else "an argument", hint=hint)
        if not token.isascii() and any("\ud800" <= c <= "\udfff" for c in token):
            raise UsageError("is not UTF-8 text", where=token, hint="rename the file or folder")


def _with_negative_values(tokens: Sequence[str]) -> list[str]:
    """Tokens with ``--flag -5s`` as ``--flag=-5s``: cyclopts takes ``-5s`` for an option."""
    joined: list[str] = []
    for token in tokens:
        if re.match(r"-\.?\d", token) and joined and re.fullmatch(r"--[a-z][a-z-]*", joined[-1]):
            token = f"{joined.pop()}={token}"
        joined.append(token)
    return joined


def format_table(rows: list[list[str]]) -> str:
    """Rows of cells as lines of columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)


def run(app: App, argv: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit code; no exception leaves except SystemExit.

    Parameters
    ----------
    app : made by :func:`new_app`
    argv : arguments after the program's name; the process's own by default

    Exit codes: 0 done, 2 usage, 3 bad input or machine, 4 partial and resumable, 130 interrupted by
    SIGINT or SIGTERM, 1 a bug.
    Errors are one or two lines on standard error; ``--debug`` anywhere adds the traceback and the warnings of
    libraries. With ``--json``, a failure prints an object with ``error`` and ``exit_code``, unless the
    command has printed its result.
    """
    global _reported
    _reported = False
    tokens = sys.argv[1:] if argv is None else list(argv)
    # Known before the line is parsed, which may fail.
    debug, as_json = "--debug" in tokens, "--json" in tokens
    show_whole_page(HELP_ALL in tokens)
    _route_logs(tokens, debug)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            # A terminal that lacks Greek letters or ± shows question marks.
            stream.reconfigure(errors="replace")
    try:
        with signals.raising(), _library_warnings(debug):
            _check_tokens(tokens)
            result = app(_with_negative_values(tokens))
        # None where it was closed before the start.
        if sys.stdout is not None:
            sys.stdout.flush()
        if signals.interrupted():
            raise KeyboardInterrupt
        return result if type(result) is int else EXIT_OK
    except MbtfError as error:
        if missed := _missed_command(app, tokens, error.message.splitlines()[0]):
            return _fail(missed, EXIT_USAGE, debug, as_json)
        return _fail(error.message, error.exit_code, debug, as_json)
    except CycloptsError as error:
        return _fail(_usage_message(app, error, tokens), EXIT_USAGE, debug, as_json)
    except KeyboardInterrupt:
        return _fail(signals.message(), EXIT_INTERRUPTED, debug, as_json)
    except BrokenPipeError:
        # The reader of the output has exited (`| head`); Python would fail again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _EXIT_BROKEN_PIPE
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and not (error.name or "mbtf_").startswith("mbtf_"):
            text = f"the Python package '{error.name}' is missing\n  run: mbtf-gen doctor"
            return _fail(text, EXIT_BAD_INPUT, debug, as_json)
        if isinstance(error, OSError) and error.strerror:
            place = "" if error.filename is None else f"{reason(str(error.filename))}: "
            return _fail(f"{place}{error.strerror}", EXIT_BAD_INPUT, debug, as_json)
        hint = "" if debug else " (run again with --debug for the traceback)"
        text = f"internal error: {type(error).__name__}: {reason(error, 1000)}{hint}"
        return _fail(text, EXIT_INTERNAL, debug, as_json)
