"""Job files for make: one machine without a scheduler."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from mbtf_pipeline.emit.places import Places
from mbtf_pipeline.emit.steps import CONFIGS, RECIPE_CONFIG, Step

MAKEFILE = "Makefile"
# Stands for the number of a slice until the rest is escaped.
_INDEX = "\0"


def makefile(name: str, places: Places, steps: Sequence[Step]) -> dict[str, str]:
    """A makefile whose targets are the steps and their slices.

    No target is a file: each command decides by its output folder what is left to do. Fits that train for a
    time run one after another, since they would share the machine's processors.

    Parameters
    ----------
    name : str
        Name of the recipe.
    places : Places
    steps : sequence of Step

    Returns
    -------
    dict of str to str
        File name → content.
    """
    lines = [
        f"# Recipe {name}. Two commands at a time, from the folder that holds the run:",
        f"#     {places.make} -j2",
        "# The same command resumes. With -k, the other slices continue where one fails.",
        "",
        f"ifeq ($(wildcard {CONFIGS}/{RECIPE_CONFIG}),)",
        "$(error run it in its own folder: make -C FOLDER)",
        "endif",
        "",
        f"all: {steps[-1].name}",
    ]
    targets = ["all"]
    timed = any(step.timed for step in steps)
    before = ""
    for step in steps:
        needs = " ".join(step.needs)
        lines += ["", "# " + step.title.rstrip("\\")]
        targets.append(step.name)
        if step.slices:
            parts = [f"{step.name}-{i}" for i in range(1, step.slices + 1)]
            targets += parts
            variable = step.name.upper().replace("-", "_") + "_SLICES"
            lines.append(f"{variable} := {' '.join(parts)}")
            lines.append(f"$({variable}): {step.name}-%: {needs}".rstrip())
            lines += _recipe(step.command(_INDEX), f"slice {_INDEX}/{step.slices} of {step.name}", places)
            lines.append(f"{step.name}: $({variable})")
            continue
        if step.is_fit and timed:
            needs, before = f"{needs} {before}".rstrip(), f"| {step.name}"
        lines += [f"{step.name}: {needs}", *_recipe(step.command(), step.name, places)]
    lines += ["", f".PHONY: {' '.join(targets)}"]
    return {MAKEFILE: "\n".join(lines) + "\n"}


def _recipe(command: str, what: str, places: Places) -> list[str]:
    """Lines that run a command in the current folder, and name it where it fails."""
    text = shlex.quote(f"{what} failed, see above. What is finished is kept; {places.make} resumes")
    lines = [
        f"@cd -- {shlex.quote(places.up)} && {command} \\",
        f"  || {{ code=$?; echo {text} >&2; exit $code; }}",
    ]
    return ["\t" + line.replace("$", "$$").replace(_INDEX, "$*") for line in lines]
