"""Command-line options generated from a typed configuration.

A field names its flag beside its type; help, default, type and order are the field's own::

    train: Annotated[Count, Flag("--queries")] = Field("100/texel", description="number of training queries")

A command names the keys that it takes (all of them by default) and receives the given values::

    @takes_options(GeneratorConfig, "geometry", "seed")
    def inspect(material: str, /, *, options: Options[GeneratorConfig], console: Console = CONSOLE) -> None:
        config = options.resolve(material=material)

``--config FILE`` and ``--set a.b=c`` come with them.
"""

from __future__ import annotations

import functools
import inspect
import os
import shlex
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, Literal, TypeVar, Union

from cyclopts import Parameter
from pydantic import BaseModel, TypeAdapter
from pydantic.fields import FieldInfo

from mbtf_core.config.settings import Settings, resolve
from mbtf_core.errors import UsageError
from mbtf_core.store import split_url

S = TypeVar("S", bound=Settings)
C = TypeVar("C", bound=Callable[..., Any])

# What a description says of a default that only the command knows.
_DEFAULT = "; default: "
_METAVARS = {int: "INT", float: "FLOAT"}

if TYPE_CHECKING:
    PathText = str
else:
    # A path as it was given, of type str; shells complete it as a file.
    PathText = str | Path
Switch = Annotated[bool, Parameter(negative="", show_default=False)]


def _refuse_url(kind: object, path: Path) -> None:
    """Only data sets are written to object stores."""
    if split_url(path) is not None:
        raise ValueError("is a URL, but only data sets are written to object stores; name a local folder")


Output = Annotated[Path, Parameter(name=["--output", "-o"], help="Output folder.", validator=_refuse_url)]
DataOutput = Annotated[Path, Parameter(name=["--output", "-o"], help="Output folder or URL.")]
Overwrite = Annotated[Switch, Parameter(help="Replace existing output.")]
Time = Annotated[str | None, Parameter(metavar="DURATION", help="Time budget: 90s, 2min, 1h.")]
ClusterOption = Annotated[
    str | None,
    Parameter(
        name="--cluster",
        metavar="WHERE",
        help="Run on workers: local, local:4, a YAML file of a batch system, or tcp://scheduler:8786.",
    ),
]
DryRun = Annotated[Switch, Parameter(help="Write nothing; only report what would be done.")]
Verbose = Annotated[Switch, Parameter(alias="-v", help="Print all details.")]
Config = Annotated[Path | None, Parameter(help="YAML file with the options.")]
Set = Annotated[
    list[str] | None,
    Parameter(
        name="--set", metavar="KEY=VALUE", help="Set any key of the configuration, such as a.b=c. Repeatable."
    ),
]


@dataclass(frozen=True)
class Flag:
    """Metadata of a configuration's field: its option on the command line.

    Attributes
    ----------
    name : such as ``--queries``
    metavar : what the help shows for its value; by default the field's type
    """

    name: str
    metavar: str | None = None


@dataclass(frozen=True)
class ConfigOption:
    """One option of a configuration.

    Attributes
    ----------
    flag : such as ``--queries``
    key : dotted, such as ``queries.train``
    type : the choices as a Literal, or str
    metavar : what the help shows for its value; None for choices
    default : as one would write it; empty if there is none
    help : one sentence
    """

    flag: str
    key: str
    type: Any
    metavar: str | None
    default: str
    help: str

    @property
    def parameter(self) -> str:
        """Name of the Python parameter."""
        return self.flag.lstrip("-").replace("-", "_")

    @property
    def annotation(self) -> Any:
        """Type of the Python parameter, with what the help shows."""
        default = self.default or False
        shown = Parameter(name=self.flag, metavar=self.metavar, help=self.help, show_default=default)
        return Annotated[self.type | None, shown]


def config_options(model: type[BaseModel], *keys: str) -> list[ConfigOption]:
    """Options of a configuration in its own order.

    Parameters
    ----------
    keys : dotted keys, of options or of whole sections; all by default
    """
    found = list(_walk(model, ""))
    if not keys:
        return found
    return [o for o in found if any(f"{o.key}.".startswith(f"{key}.") for key in keys)]


def _walk(model: type[BaseModel], prefix: str) -> typing.Iterator[ConfigOption]:
    for name, field in model.model_fields.items():
        flag = next((m for m in field.metadata if isinstance(m, Flag)), None)
        if flag is not None:
            yield _option(flag, f"{prefix}{name}", field)
        elif isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _walk(field.annotation, f"{prefix}{name}.")


def _option(flag: Flag, key: str, field: FieldInfo) -> ConfigOption:
    text, _, default = (field.description or "").partition(_DEFAULT)
    kind = _bare(field.annotation)
    choices = typing.get_origin(kind) is Literal
    return ConfigOption(
        flag.name,
        key,
        kind if choices else str,
        flag.metavar or (None if choices else _METAVARS.get(kind, "TEXT")),
        default or _default_text(field),
        f"{text[:1].upper()}{text[1:]}.",
    )


def _bare(annotation: Any) -> Any:
    """A type without None and metadata."""
    if typing.get_origin(annotation) is Annotated:
        return _bare(typing.get_args(annotation)[0])
    if typing.get_origin(annotation) in (Union, types.UnionType):
        kept = [part for part in typing.get_args(annotation) if part is not type(None)]
        return _bare(kept[0]) if len(kept) == 1 else annotation
    return annotation


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


@dataclass(frozen=True)
class Options(Generic[S]):
    """What a command line says of a configuration.

    Attributes
    ----------
    model : the configuration
    flags : dotted key → its flag
    given : dotted key → its value, for the flags that were given
    config : file with options
    assignments : ``a.b=c``
    """

    model: type[S]
    flags: Mapping[str, str]
    given: Mapping[str, str]
    config: Path | None = None
    assignments: Sequence[str] = ()

    def resolve(self, presets: Sequence[str] = (), **arguments: Any) -> S:
        """The configuration: defaults, file, presets, assignments, flags.

        Parameters
        ----------
        presets : ``a.b=c`` that assignments and flags override
        arguments : values by key that have no flag; a path that is None here and that the file gives is
            relative to the file, so that the file works from anywhere

        Raises
        ------
        InputError : the file is at fault
        UsageError : an assignment or a flag is at fault
        """
        assigned = {text.partition("=")[0].strip() for text in self.assignments}
        doubled = [key for key, value in arguments.items() if value is not None and key in assigned]
        if doubled:
            raise UsageError(
                f"the argument gives '{doubled[0]}' already", where="--set", hint="give one of them"
            )
        resolved = resolve(
            self.model,
            file=self.config,
            presets=presets,
            assignments=self.assignments,
            flags={**arguments, **self.given},
            spelled=self.flags,
        )
        if self.config is None:
            return resolved
        folder = self.config.parent
        paths = [k for k, given in arguments.items() if given is None and k not in assigned]
        located = {k: os.path.normpath(folder / getattr(resolved, k)) for k in paths}
        return resolved.model_copy(update=located)


def takes_options(model: type[BaseModel], *keys: str) -> Callable[[C], C]:
    """Decorator of a command: its parameter `options` becomes a parameter per option, and those of
    ``--config`` and ``--set``.

    Parameters
    ----------
    model : the configuration
    keys : dotted keys of the options or sections that the command takes; all by default

    Raises
    ------
    ValueError
        If two of them have the same flag.
    """
    options = config_options(model, *keys)
    if len({o.flag for o in options}) < len(options):
        raise ValueError(f"two options of {model.__name__} have the same flag: choose one of their keys")

    def decorate(command: C) -> C:
        hints = typing.get_type_hints(command, include_extras=True)
        annotations = {o.parameter: o.annotation for o in options} | {"config": Config, "assignments": Set}
        generated = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
            for name, annotation in annotations.items()
        ]
        parameters: list[inspect.Parameter] = []
        for parameter in inspect.signature(command).parameters.values():
            own = parameter.replace(annotation=hints[parameter.name])
            parameters += generated if parameter.name == "options" else [own]

        def read(arguments: dict[str, Any]) -> Options[Any]:
            values = {o.key: arguments.pop(o.parameter, None) for o in options}
            return Options(
                model,
                {o.key: o.flag for o in options},
                {key: value for key, value in values.items() if value is not None},
                arguments.pop("config", None),
                arguments.pop("assignments", None) or (),
            )

        @functools.wraps(command)
        def run(*args: Any, **kwargs: Any) -> Any:
            return command(*args, options=read(kwargs), **kwargs)

        # For tests of documented commands.
        run.config_options, run.read_options = options, read  # type: ignore[attr-defined]
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in parameters} | {"return": hints["return"]}
        return typing.cast(C, run)

    return decorate


def command_line(*words: object, **options: Any) -> str:
    """A command as a shell takes it, for records.

    Parameters
    ----------
    words : program, command, positional arguments
    options : by parameter's name; None, False and empty lists are left out, `output` becomes ``-o``
    """
    line = [str(word) for word in words]
    for name, value in options.items():
        flag = "-o" if name == "output" else f"--{name.replace('_', '-')}"
        for one in value if isinstance(value, list | tuple) else [value]:
            if one is not None and one is not False:
                line += [flag] if one is True else [flag, str(one)]
    return shlex.join(line)
