"""Selection of channels and layers of EXR files."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from pathlib import Path

from mbtf_core.errors import InputError

# Channels of one image, in order; Y comes after XYZ, which contains a Y.
_SETS = ("RGB", "XYZ", "Y")


def layers(names: list[str]) -> dict[str, list[str]]:
    """Images in a file: label → channels in order.

    ``R G B (A)``, ``X Y Z`` or ``Y (A)`` of one prefix are an image whose label is the prefix (empty for
    none); every other channel is an image by itself, labeled with its whole name.
    """
    out: dict[str, list[str]] = {}
    left = set(names)
    for layer in sorted({n.rpartition(".")[0] for n in names}):
        prefix = f"{layer}." if layer else ""
        base = next((b for b in _SETS if all(prefix + c in left for c in b)), None)
        if base is not None:
            taken = [prefix + c for c in base]
            if base != "XYZ" and f"{prefix}A" in left:
                taken.append(f"{prefix}A")
            out[layer] = taken
            left -= set(taken)
    return {**out, **{name: [name] for name in sorted(left)}}


def choose_channels(
    names: list[str], path: Path, channel: str | None, prefer: Callable[[str], bool] | None = None
) -> list[str]:
    """Channels to read, in order.

    Parameters
    ----------
    channel : the name of a channel or of a layer; None to choose: the only image, else the only one whose
        label `prefer` accepts, else the one without a prefix, else the only one of several channels

    Raises
    ------
    InputError : no such channel, or the choice is unclear
    """
    found = layers(names)
    listed = ", ".join(sorted(names))
    if channel is not None:
        if channel in names:
            return [channel]
        if channel in found:
            return found[channel]
        near = difflib.get_close_matches(channel, [*names, *found], n=1, cutoff=0.5)
        raise InputError(
            f"has no channel or layer '{channel}'",
            where=path,
            hint=f"did you mean '{near[0]}'?" if near and near[0] else f"it has {listed}",
        )
    if len(found) == 1:
        return next(iter(found.values()))
    preferred = [label for label in found if label and prefer is not None and prefer(label)]
    if len(preferred) == 1:
        return found[preferred[0]]
    if not preferred and "" in found:
        return found[""]
    images = [label for label, channels in found.items() if channels != [label]]
    if not preferred and len(images) == 1:
        return found[images[0]]
    raise InputError(
        f"which of its channels are meant is unclear: {listed}",
        where=path,
        hint="name one in a material.yaml, such as height: {file: "
        f"{path.name}, channel: {next(iter(found))}}}, or keep the channels R, G, B",
    )
