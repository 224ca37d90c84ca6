"""Every command line that the project shows can be given as it stands, in its order; one option means one
thing."""

from __future__ import annotations

import inspect
import re
import shlex
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from cyclopts import App, CycloptsError, MissingArgumentError
from support.documented import Shown, code_block, in_blocks, shown_commands
from support.paths import ROOT

from mbtf_core.config.settings import resolve
from mbtf_core.errors import MbtfError
from mbtf_fit.cli.app import app as fit
from mbtf_gen.cli.app import app as generate
from mbtf_pipeline.cli.app import app as pipeline
from mbtf_pipeline.collection.recipes import load
from mbtf_pipeline.recipe import Recipe

APPS = {"mbtf-gen": generate, "mbtf-fit": fit, "mbtf-pipeline": pipeline}
COMMON = {"--help", "--help-all", "--version", "--debug"}
# Optional parts, alternatives, omissions.
SYNOPSIS = re.compile(r"[\[\]|…<>]|\.\.\.")


def commands(app: App) -> dict[str, App]:
    """Commands of a program by name; the one without a name is ''."""
    named = {name: app[name] for name in app if not name.startswith("-")}
    return {**({"": app} if app.default_command is not None else {}), **named}


def fault(shown: Shown) -> str:
    """What is wrong with a command line; empty if nothing is."""
    try:
        program, *words = shlex.split(shown.text)
    except ValueError as error:
        return str(error)
    app = APPS[program]
    name = words[0] if words and words[0] in commands(app) else ""
    if name not in commands(app):
        return "no such command" if words and shown.whole else ""
    rest = words[1:] if name else words
    # A command may be only named, with its options or without.
    named = not rest or rest[0].startswith("-")
    if not shown.whole or SYNOPSIS.search(shown.text):
        return unknown_flags(program, name, shown.text)
    if COMMON & set(words):
        return ""
    try:
        command, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
    except MissingArgumentError:
        return unknown_flags(program, name, shown.text) if named else "an argument is missing"
    except CycloptsError as error:
        return str(error)
    try:
        check_values(command, dict(bound.arguments))
    except MbtfError as error:
        return error.message
    return ""


def options_of(command: Any) -> Any:
    """The options of a command where none is given; None where it has none."""
    parameter = inspect.signature(command).parameters.get("options")
    return None if parameter is None else parameter.default


@cache
def names_of(program: str, command: str) -> frozenset[str]:
    """Names of all arguments of a command."""
    arguments = commands(APPS[program])[command].assemble_argument_collection()
    return frozenset(name for argument in arguments for name in argument.names)


def unknown_flags(program: str, command: str, text: str) -> str:
    """What is wrong with the options of a text; empty if nothing is."""
    known = names_of(program, command)
    flags = re.findall(r"(?<![\w-])--?[a-z][\w-]*", text)
    return ", ".join(f"no option {flag}" for flag in flags if flag not in known | COMMON)


def check_values(command: Any, arguments: dict[str, Any]) -> None:
    """Check what a command line says of a configuration.

    Raises
    ------
    MbtfError : a key or a value that there is not
    """
    options = arguments.get("options", options_of(command))
    if hasattr(options, "table"):
        # A configuration that an earlier command writes, which this one reads.
        options = replace(options, config=None)
        arguments_of = {"material", "shards"} & options.configuration.model_fields.keys()
        options.resolve(**dict.fromkeys(arguments_of, "X"))
    if arguments.get("assignments"):
        recipe = ROOT / arguments["recipe"]
        if not recipe.exists():
            recipe = ROOT / "pipelines/quickstart.yaml"
        if "paper" in recipe.name:
            load(recipe, arguments["assignments"])
        else:
            resolve(Recipe, file=recipe, assignments=arguments["assignments"])


def test_every_command_that_is_shown_can_be_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the model that the page on models has in a file."""
    monkeypatch.chdir(tmp_path)
    Path("my_model.py").write_text(code_block("how-to/add-a-model.md", "python"))
    found = shown_commands()
    assert len(found) > 60
    assert {shown.text.split()[0] for shown in found} == set(APPS)
    # Many are shown in several places.
    texts = {(shown.text, shown.whole): shown for shown in found}.values()
    faults = [f"{shown.where}: {shown.text}: {text}" for shown in texts if (text := fault(shown))]
    assert faults == []


def pages_in_order() -> list[Path]:
    """README, then the pages that a reader follows, in the order of the table of contents."""
    names = re.findall(r"^(?:start|how-to)/[\w-]+$", (ROOT / "docs/index.md").read_text(), re.MULTILINE)
    return [ROOT / "README.md", *(ROOT / "docs" / f"{name}.md" for name in names)]


# Output folders of commands without -o; '' is the command without a name.
DEFAULTS = {
    "mbtf-gen": {"": "shards/", "preview": "preview/", "reference": "reference/"},
    "mbtf-fit": {"": "material/", "preview": "preview/"},
}
NAMES = re.compile(r"^[a-z]+$")


def output_of(words: list[str]) -> str | None:
    if "-o" in words:
        return words[words.index("-o") + 1]
    name = words[1] if NAMES.match(words[1]) else ""
    return DEFAULTS.get(words[0], {}).get(name)


def configuration(text: str) -> str:
    """A command without the slice, as the slices of a data set share its folder."""
    return re.sub(r" --slice \S+", "", " ".join(text.split()))


def test_inputs_exist_and_no_output_folder_belongs_to_two_commands() -> None:
    made: dict[str, str] = {}
    faults = []
    for page in pages_in_order():
        for shown in in_blocks(page.read_text(), page.name):
            words = shlex.split(shown.text)
            output = output_of(words)
            for word in words[1:]:
                # A folder, or a file of one.
                known = word in made or f"{Path(word).parent}/" in made or (ROOT / word).exists()
                new = word != output and not known
                if new and word.endswith(("/", ".txt", ".yaml")):
                    faults.append(f"{shown.where}: {shown.text}: nothing made {word}")
            if output and made.setdefault(output, configuration(shown.text)) != configuration(shown.text):
                faults.append(f"{shown.where}: {shown.text}: {output} is that of {made[output]}")
    assert len(made) > 20
    assert faults == []
