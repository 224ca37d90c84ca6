"""Every configuration and every option of the three programs refuses what it cannot use, in one or two lines
that name the place; the cases are made from the schemas, so that a new field or option is covered at once."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import pytest
from cyclopts import App
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from support.commands import call

import mbtf_fit.cli.app
import mbtf_gen.cli.app
import mbtf_pipeline.cli.app
from mbtf_core.config.settings import Settings, build
from mbtf_core.config.yaml_file import parse_value, read_yaml
from mbtf_core.errors import InputError

APPS: dict[str, App] = {
    "mbtf-gen": mbtf_gen.cli.app.app,
    "mbtf-fit": mbtf_fit.cli.app.app,
    "mbtf-pipeline": mbtf_pipeline.cli.app.app,
}
# Values of which every type that is not free text refuses some: no number, no choice, out of range.
CANDIDATES = ("no-such-value", "1.5.5", "-1e300", "1e300", "nan", "{no: such}")
# Modules of configurations that the commands load when they run.
MODULES = (
    "mbtf_core.run.workers",
    "mbtf_fit.cli.export",
    "mbtf_fit.cli.pictures",
    "mbtf_gen.tile.fibers.cloth_file",
    "mbtf_gen.tile.maps.material_file",
    "mbtf_gen.tile.mesh_file",
    "mbtf_pipeline.collection.recipes",
    "mbtf_pipeline.recipe",
)
# What a command needs before it reads its options.
NEEDED = {("mbtf-gen", "publish"): ["--license", "CC0-1.0"]}


def models() -> list[type[Settings]]:
    """Every configuration of the programs."""
    for module in MODULES:
        import_module(module)
    found: dict[str, type[Settings]] = {}
    waiting = list(Settings.__subclasses__())
    while waiting:
        model = waiting.pop()
        waiting += model.__subclasses__()
        if model.__module__.startswith("mbtf_"):
            found[f"{model.__module__}.{model.__name__}"] = model
    return [found[name] for name in sorted(found)]


def refused(field: FieldInfo, read: Callable[[str], Any]) -> list[str]:
    """The candidates that a field's own type refuses, as a flag or a file gives them."""
    kind: Any = Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
    out = []
    for text in CANDIDATES:
        try:
            TypeAdapter(kind).validate_python(read(text))
        except ValidationError:
            out.append(text)
    return out


def commands() -> Iterator[tuple[str, str, App]]:
    """(program, command or empty, its application)."""
    for program, app in APPS.items():
        if app.default_command is not None:
            yield program, "", app
        for name in app:
            if not name.startswith("-"):
                yield program, name, app[name]


COMMANDS = {f"{program} {name}".strip(): (program, name, app) for program, name, app in commands()}


def line_of(command: str, *more: str) -> list[str]:
    """A command line whose positional arguments name no file, and then `more`."""
    program, name, app = COMMANDS[command]
    positional = [
        p
        for p in inspect.signature(app.default_command).parameters.values()  # type: ignore[arg-type]
        if p.kind is p.POSITIONAL_ONLY
    ]
    words = [f"nowhere-{number}" for number in range(len(positional))]
    return [program, *([name] if name else []), *words, *NEEDED.get((program, name), []), *more]


def refusal(words: list[str], *fragments: str) -> str:
    """The message of a command line that is refused: usage, one or two lines, nothing else."""
    done = call(words)
    assert done.code == 2, (words, done)
    assert done.out == "", words
    lines = done.err[done.err.index("error: ") :].splitlines()
    assert len(lines) <= 2, (words, lines)
    assert "Traceback" not in done.err, words
    for text in fragments:
        assert text in done.err, (words, done.err)
    return done.err


@pytest.fixture(autouse=True)
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty current folder, in which nothing may be written."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    yield folder
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("model", models(), ids=lambda m: f"{m.__module__}.{m.__name__}")
def test_a_file_is_refused_with_line_and_key(model: type[Settings], tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    alone = not any(field.is_required() for field in model.model_fields.values())
    for name, field in model.model_fields.items():
        for text in refused(field, parse_value):
            path.write_text(f"# a comment\n{name}: {text}\n")
            with pytest.raises(InputError) as caught:
                build(model, read_yaml(path), source=str(path))
            message = caught.value.message
            assert len(message.splitlines()) <= 2, message
            assert message.startswith(str(path)), message
            if alone:
                assert message.startswith(f"{path}:2: "), message
                assert name in message, message
        misspelt = f"{name}{name[-1]}"
        if misspelt in model.model_fields:
            continue
        path.write_text(f"\n\n{misspelt}: 1\n")
        with pytest.raises(InputError) as caught:
            build(model, read_yaml(path), source=str(path))
        message = caught.value.message
        assert message.startswith(f"{path}:3: unknown key '{misspelt}'"), message
        assert f"did you mean '{name}'" in message, message


def option_cases() -> list[tuple[str, str, str, FieldInfo]]:
    """(command, flag, key, field) of every option, at the first command that has it."""
    found: dict[tuple[str, str], tuple[str, str, str, FieldInfo]] = {}
    for command, (program, name, app) in COMMANDS.items():
        parameter = inspect.signature(app.default_command).parameters.get("options")  # type: ignore[arg-type]
        options: Any = None if parameter is None else parameter.default
        for option in getattr(options, "table", ()):
            # The line gives a needed option already.
            if option.flag not in NEEDED.get((program, name), []):
                case = command, option.flag, option.key, field_of(options.configuration, option.key)
                found.setdefault((option.flag, option.key), case)
    return list(found.values())


def field_of(model: type[BaseModel], key: str) -> FieldInfo:
    *sections, name = key.split(".")
    for section in sections:
        model = model.model_fields[section].annotation  # type: ignore[assignment]
    return model.model_fields[name]


@pytest.mark.parametrize(("command", "flag", "key", "field"), option_cases(), ids=lambda part: str(part)[:40])
def test_an_option_is_refused_with_its_flag(command: str, flag: str, key: str, field: FieldInfo) -> None:
    for text in refused(field, str)[:2]:
        refusal(line_of(command, f"{flag}={text}"), flag)
        refusal(line_of(command, "--set", f"{key}={text}"), key)
    misspelt = f"{key}{key[-1]}"
    refusal(line_of(command, "--set", f"{misspelt}=1"), misspelt, key.rpartition(".")[2])


def test_negative_values_reach_their_option() -> None:
    for flag, value in (("--queries", "-5/texel"), ("--target-error", "-2%"), ("--spp", "-4")):
        for words in ([flag, value], [f"{flag}={value}"]):
            refusal(line_of("mbtf-gen", *words), f"{flag}: ", "must be")
    refusal(line_of("mbtf-fit", "--time", "-5s"), "--time: ", "must be a positive duration")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_flag_is_refused_where_it_is_misspelt_or_has_no_value(command: str) -> None:
    _, _, app = COMMANDS[command]
    for argument in app.assemble_argument_collection():
        flags = [name for name in argument.names if name.startswith("--")]
        if not flags or not argument.parameter.parse:
            continue
        flag = flags[0]
        refusal(line_of(command, f"{flag}{flag[-1]}"), flag)
        takes, _ = argument.token_count()
        if takes:
            refusal(line_of(command, flag), flag)
            kinds = (argument.hint, *get_args(argument.hint))
            if any(kind in (int, float) or get_origin(kind) is Literal for kind in kinds):
                refusal(line_of(command, flag, "no-such-value"), flag)
    refusal(line_of(command, "one-word-more"), "one-word-more")
