"""Published numbers of a paper recipe, for ratios beside measured ones.

Papers use their own data, light and units. Only ratios between methods on the same material are comparable,
and a material of the same name or kind is not the same material.
"""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field

from mbtf_core.config.settings import Settings

# Numbers by material and method.
_Errors = dict[str, dict[str, float]]


class Published(Settings):
    """Numbers of one source."""

    source: str = Field(description="publication, with table or figure")
    mse: _Errors = Field({}, description="MSE in any unit, by material and method")
    psnr: _Errors = Field({}, description="PSNR in dB, by material and method")
    levels: dict[str, dict[str, list[float]]] = Field(
        {}, description="MSE at each level in any unit, the finest first, by material and method"
    )
    weights: dict[str, str] = Field({}, description="number of network weights in words, by model")
    timing: str = Field("", description="times of one evaluation, a sentence")


def mse_ratio(
    published: Sequence[Published], material: str, method: str, base: str
) -> tuple[float, str] | None:
    """MSE of a method divided by that of another, from the first source that has both.

    Parameters
    ----------
    published : sequence of Published
    material : str
        Name of the material.
    method, base : str
        Methods above and below the line.

    Returns
    -------
    (float, str) or None
        The ratio and its source; None if unknown.
    """
    for found in published:
        row = found.mse.get(material, {})
        if method in row and base in row:
            return row[method] / row[base], found.source
        row = found.psnr.get(material, {})
        if method in row and base in row:
            return 10.0 ** ((row[base] - row[method]) / 10.0), found.source
    return None


def level_ratios(
    published: Sequence[Published], material: str, method: str
) -> tuple[list[float], str] | None:
    """MSE at each level over that at the finest, the finest first, and their source; None if unknown."""
    for found in published:
        if values := found.levels.get(material, {}).get(method):
            return [value / values[0] for value in values], found.source
    return None


def network_weights(published: Sequence[Published], model: str) -> tuple[str | None, str | None]:
    """Number of network weights of a model in words, and its source."""
    return next(((p.weights[model], p.source) for p in published if model in p.weights), (None, None))
