"""Command-line options generated from a typed configuration.

A field names its flag beside its type; help, default, type and order are the field's own::

    train: Annotated[Count, Flag("--queries")] = Field("100/texel", description="number of training queries")

A command's options are a class, made of the keys that it takes (all of them by default), and arrive as the
values that were given::

    @options_from(GeneratorConfig, "geometry", "seed")
    class InspectOptions(Options[GeneratorConfig]):
        "Options of ``mbtf-gen inspect``."

    def inspect(material: str, /, *, options: InspectOptions, console: Console = CONSOLE) -> None:
        config = options.resolve(material=material)

``--config FILE`` and ``--set a.b=c`` come with them. Options that several commands share are declared here.
``--help`` describes what most people need and names the rest; ``--help-all`` describes all.
"""

from __future__ import annotations

import os
import shlex
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Generic, Literal, TypeVar, Union

from cyclopts import Group, Parameter, Token
from cyclopts.help import DefaultFormatter, HelpPanel
from pydantic import BaseModel, TypeAdapter
from pydantic.fields import FieldInfo

from mbtf_core.config.settings import Settings, explicit_options, parts_of, resolve
from mbtf_core.errors import UsageError
from mbtf_core.paths import split_url

HELP_ALL = "--help-all"
# Whether the running command line asks for the whole page.
_whole = False


def show_whole_page(whole: bool) -> None:
    """Choose what the next help page describes: all options, or those that most people need."""
    global _whole
    _whole = whole


def _format_more(console: Any, options: Any, panel: HelpPanel) -> None:
    """Options of the group MORE: a panel on the whole page, their names on the short one."""
    if _whole:
        DefaultFormatter()(console, options, panel)
    elif panel.entries:
        names = ", ".join(entry.names[0] for entry in panel.entries)
        console.print(f"{HELP_ALL} describes more options: {names}", markup=False, highlight=False)


# Options that few people need; shown last.
MORE = Group("More options", sort_key=1, help_formatter=_format_more)

S = TypeVar("S", bound=Settings)
C = TypeVar("C", bound="Options[Any]")

# What a description says of a default that only the command knows.
_DEFAULT = "; default: "
_METAVARS = {int: "INT", float: "FLOAT"}

if TYPE_CHECKING:
    PathText = str
else:
    # A path as it was given, of type str; shells complete it as a file.
    PathText = str | Path
Switch = Annotated[bool, Parameter(negative="", show_default=False)]


def whole_number(kind: object, tokens: Sequence[Token]) -> int:
    """Converter of options outside configurations, a ValueError for other numbers: cyclopts itself rounds 8.5
    to 8."""
    return int(tokens[0].value)


def _refuse_url(kind: object, path: Path) -> None:
    """Only data sets are written to object stores."""
    if split_url(path) is not None:
        raise ValueError("is a URL, but only data sets are written to object stores; name a local folder")


Output = Annotated[Path, Parameter(name=["--output", "-o"], help="Output folder.", validator=_refuse_url)]
DataOutput = Annotated[Path, Parameter(name=["--output", "-o"], help="Output folder or URL.")]
MovedMaterial = Annotated[
    PathText | None,
    Parameter(name="--material", metavar="PATH", help="Path of the material, if it was moved."),
]
Overwrite = Annotated[Switch, Parameter(help="Replace existing output.")]
ClusterOption = Annotated[
    str | None,
    Parameter(
        name="--cluster",
        metavar="WHERE",
        group=MORE,
        help="Run on workers: local, local:4, a YAML file of a batch system, or tcp://scheduler:8786.",
    ),
]
DryRun = Annotated[Switch, Parameter(help="Write nothing; only report what would be done.")]
Verbose = Annotated[Switch, Parameter(alias="-v", help="Print all details.")]
Quality = Literal["draft", "standard", "high", "paper"]
QualityOption = Annotated[
    Quality | None,
    Parameter(
        help="Preset of sizes and times; other options override it, and it overrides the file of --config."
    ),
]
Config = Annotated[Path | None, Parameter(group=MORE, help="YAML file with the options.")]
Set = Annotated[
    list[str] | None,
    Parameter(
        name="--set",
        metavar="KEY=VALUE",
        group=MORE,
        help="Set any key of the configuration, such as a.b=c. Repeatable.",
    ),
]


@dataclass(frozen=True)
class Flag:
    """Metadata of a configuration's field: its option on the command line, such as ``--queries``, and what
    the help shows for its value, by default the field's type. ``--help`` only names `rare` ones,
    ``--help-all`` describes them."""

    name: str
    metavar: str | None = None
    rare: bool = False


@dataclass(frozen=True)
class ConfigOption:
    """One option of a configuration: its dotted key, such as ``queries.train``, its flag, and the type of its
    Python parameter with what the help shows."""

    key: str
    flag: str
    annotation: Any

    @property
    def parameter(self) -> str:
        """Name of the Python parameter."""
        return self.flag.lstrip("-").replace("-", "_")


def _walk(model: type[BaseModel], prefix: str) -> Iterator[ConfigOption]:
    for name, field in model.model_fields.items():
        flag = next((m for m in field.metadata if isinstance(m, Flag)), None)
        if flag is not None:
            yield _option(flag, f"{prefix}{name}", field)
        elif isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _walk(field.annotation, f"{prefix}{name}.")


def _option(flag: Flag, key: str, field: FieldInfo) -> ConfigOption:
    text, _, default = (field.description or "").partition(_DEFAULT)
    parts = [part for part in parts_of(field.annotation, containers=False) if part is not type(None)]
    kind: Any = parts[0] if len(parts) == 1 else Union[tuple(parts)]  # noqa: UP007
    choices = any(typing.get_origin(part) is Literal for part in parts) and flag.metavar is None
    shown = Parameter(
        name=flag.name,
        metavar=flag.metavar or (None if choices else _METAVARS.get(kind, "TEXT")),
        help=f"{text[:1].upper()}{text[1:]}.",
        show_default=default or _default_text(field) or False,
    )
    group = [Parameter(group=MORE)] if flag.rare else []
    return ConfigOption(key, flag.name, Annotated[(kind if choices else str) | None, shown, *group])


def _default_text(field: FieldInfo) -> str:
    value = field.get_default(call_default_factory=True)
    if field.is_required() or value is None:
        return ""
    annotated: Any = Annotated[field.annotation, *field.metadata]
    return _written(TypeAdapter(annotated).dump_python(value, mode="json"))


def _written(value: Any) -> str:
    """A value as one writes it on a command line."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list):
        return ",".join(_written(v) for v in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


class Options(Generic[S]):
    """What a command line says of a configuration; made by :func:`options_from`.

    Attributes
    ----------
    config : file with options
    assignments : ``a.b=c``
    """

    configuration: ClassVar[type[Settings]]
    table: ClassVar[Sequence[ConfigOption]] = ()
    config: Path | None
    assignments: list[str] | None

    @property
    def flags(self) -> dict[str, str]:
        """Dotted key → its flag."""
        return {option.key: option.flag for option in self.table}

    @property
    def given(self) -> dict[str, str]:
        """Dotted key → its value, for the flags that were given."""
        values = {option.key: getattr(self, option.parameter) for option in self.table}
        return {key: value for key, value in values.items() if value is not None}

    def explicit(self) -> dict[str, Any]:
        """The options of file and command line, nested, without presets; see :func:`explicit_options`."""
        flags = [f"{key}={value}" for key, value in self.given.items()]
        return explicit_options(self.config, [*(self.assignments or ()), *flags])

    def resolve(self, presets: Mapping[str, Any] | None = None, **arguments: Any) -> S:
        """The configuration: defaults, file, presets, assignments, flags; errors are those of
        :func:`resolve`.

        `arguments` are values by key that have no flag; a path that is None here and that the file gives is
        relative to the file, so that the file works from anywhere.
        """
        assignments = self.assignments or ()
        assigned = {text.partition("=")[0].strip() for text in assignments}
        doubled = [key for key, value in arguments.items() if value is not None and key in assigned]
        if doubled:
            raise UsageError(
                f"the argument gives '{doubled[0]}' already", where="--set", hint="give one of them"
            )
        resolved = resolve(
            typing.cast(type[S], self.configuration),
            file=self.config,
            presets=presets,
            assignments=assignments,
            flags={**arguments, **self.given},
            spelled=self.flags,
        )
        if self.config is None:
            return resolved
        folder = self.config.parent
        paths = [k for k, given in arguments.items() if given is None and k not in assigned]
        located = {k: os.path.normpath(folder / getattr(resolved, k)) for k in paths}
        return resolved.model_copy(update=located)


def options_from(model: type[BaseModel], *keys: str) -> Callable[[type[C]], type[C]]:
    """Decorator of a class of :class:`Options`: gives it a field per option of a configuration, by the dotted
    keys of options or sections or of all, and ``--config`` and ``--set``; a ValueError if two have the same
    flag."""
    table = [o for o in _walk(model, "") if not keys or any(f"{o.key}.".startswith(f"{k}.") for k in keys)]
    if len({o.flag for o in table}) < len(table):
        raise ValueError(f"two options of {model.__name__} have the same flag: choose one of their keys")
    own: list[tuple[str, Any, None]] = [(o.parameter, o.annotation, None) for o in table]
    own += [("config", Config, None), ("assignments", Set, None)]

    def decorate(cls: type[C]) -> type[C]:
        names = {"__module__": cls.__module__, "__doc__": cls.__doc__, "configuration": model, "table": table}
        made = make_dataclass(cls.__name__, own, bases=(cls,), namespace=names, frozen=True, kw_only=True)
        return typing.cast(type[C], Parameter(name="*")(made))

    return decorate


def command_line(*words: object, **options: Any) -> str:
    """A command as a shell takes it, for records: its words, and options by parameter's name. None, False and
    empty lists are left out, `output` becomes ``-o``."""
    line = [str(word) for word in words]
    for name, value in options.items():
        flag = "-o" if name == "output" else f"--{name.replace('_', '-')}"
        for one in value if isinstance(value, list | tuple) else [value]:
            if one is not None and one is not False:
                line += [flag] if one is True else [flag, str(one)]
    return shlex.join(line)
