"""What several commands of ``mbtf-gen`` share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from mbtf_core.errors import UsageError
from mbtf_core.options import Options
from mbtf_gen.config.generator import GeneratorConfig

G = TypeVar("G", bound=GeneratorConfig)


def resolve_config(options: Options[G], material: str | None, presets: Sequence[str] = ()) -> G:
    """Configuration of a command for a material.

    Raises
    ------
    UsageError : no material, or a flag or an assignment is at fault
    InputError : the file is at fault
    """
    if material is None and options.config is None:
        raise UsageError("no material given", hint="mbtf-gen heightfield.exr --queries 400/texel -o shards/")
    return options.resolve(presets, material=material)
