"""Published numbers, for ratios beside measured ones.

Papers use their own data, light and units. Only ratios between methods on the same material are comparable,
and a material of the same name is not the same material.
"""

from __future__ import annotations

NEUMIP = "Kuznetsov et al. 2021"
HIERARCHICAL = "Xue et al. 2024"

# MSE ×10⁻³ by material: NeuMIP without and with offset, Rainer et al. 2019, Rainer et al. 2020.
_NEUMIP_MSE: dict[str, tuple[float, float, float, float]] = {
    "twisted_wool": (11.31, 3.98, 12.79, 19.03),
    "straight_wool": (1.04, 0.39, 2.30, 1.92),
    "turtle_shell": (3.35, 1.31, 2.83, 4.84),
    "cliff_rock": (6.00, 2.00, 7.89, 10.26),
    "insulation_foam": (9.18, 3.90, 10.04, 21.75),
}
_COLUMNS = ("neumip-baseline", "neumip", "rainer2019", "rainer2020")
# Material of the hierarchical paper of the same kind, and its PSNR in dB: the hierarchical model, NeuMIP. The
# project has no counterpart of "ring" (38.47, 29.89) and "Victorian" (35.25, 30.85).
_HIERARCHICAL_PSNR: dict[str, tuple[str, float, float]] = {
    "turtle_shell": ("turtle shell", 32.18, 30.79),
    "leather_fine": ("leather", 32.79, 28.60),
    "metal_plate": ("metal grid", 30.36, 28.07),
    "twill_silk": ("twill", 29.51, 28.16),
}
# MSE ×10⁻³ of twisted wool with offset by zoom, the finest first.
_ZOOM_MSE = (3.98, 2.10, 1.47, 1.07, 0.74, 1.16, 1.17, 1.08)

# Network weights by model.
WEIGHTS: dict[str, tuple[str, str]] = {
    "neumip": ("3332; 3254 with the three outputs described in the text", NEUMIP),
    "hierarchical": ("about 6500 to 7100, decoder", HIERARCHICAL),
    "rainer2019": ("35725, decoder; 14 channels", NEUMIP),
    "rainer2020": ("38269, decoder; 38 channels", NEUMIP),
}


def mse_ratio(material: str, method: str, base: str) -> tuple[float, str] | None:
    """MSE of a method divided by that of another on the published material of this name or kind, and its
    source; None if unknown."""
    row = _NEUMIP_MSE.get(material)
    if row is not None and method in _COLUMNS and base in _COLUMNS:
        return row[_COLUMNS.index(method)] / row[_COLUMNS.index(base)], NEUMIP
    found = _HIERARCHICAL_PSNR.get(material)
    if found is not None and (method, base) == ("hierarchical", "neumip"):
        kind, better, worse = found
        return 10.0 ** ((worse - better) / 10.0), f"{HIERARCHICAL}, {kind}, from PSNR"
    return None


def level_ratios(material: str, method: str) -> tuple[list[float], str] | None:
    """MSE at each level over that at the finest, the finest first, and their source; None if unknown."""
    if (material, method) != ("twisted_wool", "neumip"):
        return None
    return [value / _ZOOM_MSE[0] for value in _ZOOM_MSE], f"{NEUMIP}, Table 3"
