"""Draw the figures of docs/explanation/concepts.md: ``.venv/bin/python docs/drawings/make_drawings.py``.

The curves come from the project's own code (light kernel, levels), so drawings and programs agree.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.data.lattice import level_of_sigma
from mbtf_gen.sampling.light_kernel import LightKernel

FOLDER = Path(__file__).parent
# Distinguishable by color-blind readers (Okabe and Ito).
BLUE, ORANGE, GREEN, RED, GRAY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#666666"


def heights(x: Any) -> Any:
    """Heights of period 1, the highest point at 0."""

    def shape(at: Any) -> Any:
        phase = 2 * np.pi * (np.asarray(at) - 0.14)
        return 0.6 * np.sin(phase) + 0.25 * np.sin(3 * phase + 1.0) + 0.1 * np.sin(7 * phase)

    return 0.16 * (shape(x) - shape(np.linspace(0, 1, 4001)).max())


def bare(axes: Any) -> None:
    """No frame, equal scales."""
    axes.set_aspect("equal")
    axes.axis("off")


def arrow(
    axes: Any, start: tuple[float, float], end: tuple[float, float], color: str, **options: Any
) -> None:
    """An arrow in data coordinates."""
    style = {"arrowstyle": "-|>", "color": color, "lw": 1.6, "shrinkA": 0, "shrinkB": 0, **options}
    axes.annotate("", xy=end, xytext=start, arrowprops=style)


def first_hit(x: float, direction: tuple[float, float]) -> tuple[float, float]:
    """Where the ray from (x, 0) down along `direction` meets the surface."""
    t = np.linspace(0, 1, 200001)
    along = heights(x + t * direction[0])
    k = int(np.argmax(t * direction[1] <= along))
    return x + t[k] * direction[0], float(along[k])


def tile(plot: Any) -> Any:
    """Section through a tile: the geometry of B(x, ω_i, ω_o)."""
    figure, axes = plot.subplots(figsize=(8, 2.9))
    x = np.linspace(-0.35, 1.35, 700)
    axes.fill_between(x, heights(x), -0.42, color="#e8e4dc")
    axes.plot(x, heights(x), color="black", lw=1.4)
    axes.plot([-0.35, 1.36], [0, 0], color=GRAY, ls="--", lw=1)
    axes.text(-0.34, 0.015, "reference plane z = 0", ha="left", va="bottom", color=GRAY, fontsize=9)
    for border in (0.0, 1.0):
        axes.plot([border, border], [-0.42, 0.05], color=GRAY, lw=0.8, ls=":")
    axes.annotate(
        "", xy=(1, -0.38), xytext=(0, -0.38), arrowprops={"arrowstyle": "<->", "color": GRAY, "lw": 1}
    )
    axes.text(0.5, -0.375, "one tile", va="bottom", ha="center", color=GRAY, fontsize=9)
    at, view = 1.02, np.array([0.86, 0.5])
    hit = first_hit(at, (-view[0], -view[1]))
    end = (at + 0.42 * view[0], 0.42 * view[1])
    axes.plot([at, hit[0]], [0, hit[1]], color=BLUE, lw=1.6, ls=(0, (4, 2)))
    arrow(axes, (at, 0), end, BLUE)
    axes.text(end[0] + 0.01, end[1], r"$\omega_o$ to the viewer", color=BLUE, va="center")
    light = np.array([-0.5, 0.87])
    top = (hit[0] + 0.52 * light[0], hit[1] + 0.52 * light[1])
    arrow(axes, hit, top, ORANGE)
    axes.text(top[0] - 0.015, top[1], r"$\omega_i$ to the light", color="#9a6a00", va="center", ha="right")
    axes.plot(at, 0, "o", color=BLUE, ms=5)
    axes.text(at + 0.015, -0.02, r"$\mathbf{x}$", color=BLUE, va="top", fontsize=12)
    axes.plot(*hit, "o", color=RED, ms=5)
    axes.text(hit[0] - 0.01, hit[1] - 0.04, "visible point", color=RED, va="top", ha="center", fontsize=9)
    axes.set_xlim(-0.36, 1.75)
    axes.set_ylim(-0.43, 0.45)
    bare(axes)
    return figure


def orientation(plot: Any) -> Any:
    """Image rows, texel centers, and (u, v)."""
    figure, axes = plot.subplots(figsize=(4.2, 3.3))
    columns, rows = 4, 3
    shade = np.linspace(0.95, 0.7, columns * rows).reshape(rows, columns)
    for j in range(rows):
        for i in range(columns):
            corner = (i / columns, 1 - (j + 1) / rows)
            axes.add_patch(
                plot.Rectangle(corner, 1 / columns, 1 / rows, fc=str(shade[j, i]), ec="white", lw=1.5)
            )
            center = ((i + 0.5) / columns, 1 - (j + 0.5) / rows)
            axes.plot(*center, "o", color=BLUE, ms=4)
            axes.text(center[0], center[1] - 0.05, f"[{j}, {i}]", ha="center", va="top", fontsize=8)
    arrow(axes, (0, -0.04), (1.12, -0.04), "black")
    arrow(axes, (-0.03, 0), (-0.03, 1.14), "black")
    axes.text(1.14, -0.04, "u", va="center", style="italic")
    axes.text(-0.03, 1.17, "v", ha="center", style="italic")
    axes.text(-0.06, 0, "0", ha="right", va="center", fontsize=9)
    axes.text(-0.06, 1, "1", ha="right", va="center", fontsize=9)
    axes.text(0.5, 1.03, "image row 0", ha="center", va="bottom", color=GRAY, fontsize=9)
    axes.set_xlim(-0.15, 1.2)
    axes.set_ylim(-0.12, 1.25)
    bare(axes)
    return figure


def footprint(plot: Any) -> Any:
    """Footprints of three levels on the finest texels, and the weights of the levels."""
    figure, (left, right) = plot.subplots(1, 2, figsize=(9, 3.2), width_ratios=(1, 1.6))
    n = 16
    for k in range(n + 1):
        left.plot([0, 1], [k / n, k / n], color="#d5d5d5", lw=0.6)
        left.plot([k / n, k / n], [0, 1], color="#d5d5d5", lw=0.6)
    angle = np.linspace(0, 2 * np.pi, 200)
    for level, color in ((1, BLUE), (2, GREEN), (4, RED)):
        sigma = 0.5 * 2.0**-level
        left.plot(0.5 + sigma * np.cos(angle), 0.5 + sigma * np.sin(angle), color=color, lw=1.8)
        left.text(0.5, 0.5 + sigma + 0.015, rf"$\sigma_{level}$", color=color, ha="center", va="bottom")
    left.set_title("1 σ of levels 1, 2 and 4 on level 4's texels", fontsize=9)
    bare(left)
    sigma = np.exp2(-np.linspace(0, 4, 801)) / 2
    fractional = level_of_sigma(sigma)
    for level in range(5):
        # Between adjacent levels, footprints are interpolated.
        share = np.maximum(1 - np.abs(fractional - level), 0)
        right.plot(
            sigma, share, lw=1.8, color=(BLUE, ORANGE, GREEN, "#CC79A7", RED)[level], label=f"level {level}"
        )
    right.set_xscale("log", base=2)
    right.set_xlabel("footprint σ in tile widths")
    right.set_ylabel("weight of the level")
    right.legend(fontsize=8, loc="upper center", ncols=5, bbox_to_anchor=(0.5, 1.18), frameon=False)
    right.spines[["top", "right"]].set_visible(False)
    return figure


def light(plot: Any) -> Any:
    """Arriving radiance over the elevation, near the zenith and at the horizon."""
    figure, axes = plot.subplots(figsize=(7, 3))
    kernel = LightKernel(1.0)
    elevation = np.radians(np.linspace(-4, 16, 2001))
    for degrees, color in ((0.5, RED), (2, ORANGE), (10, BLUE)):
        omega_i = np.array([np.cos(np.radians(degrees)), 0, np.sin(np.radians(degrees))])
        directions = np.stack([np.cos(elevation), np.zeros_like(elevation), np.sin(elevation)], axis=-1)
        radiance = kernel.radiance(directions, np.broadcast_to(omega_i, directions.shape))
        axes.plot(
            np.degrees(elevation),
            radiance,
            color=color,
            lw=1.8,
            label=f"light {degrees:g}° above the horizon",
        )
    axes.axvspan(-4, 0, color="#eeeeee")
    axes.text(
        -2,
        axes.get_ylim()[1] * 0.5,
        "below the\nhorizon:\nno light",
        ha="center",
        va="center",
        fontsize=9,
        color=GRAY,
    )
    axes.set_xlabel("elevation of the direction, degrees")
    axes.set_ylabel("arriving radiance L")
    axes.set_yscale("log")
    axes.set_ylim(1e-1, None)
    axes.legend(fontsize=9, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def periodic(plot: Any) -> Any:
    """A grazing ray that leaves the tile re-enters on the other side."""
    figure, axes = plot.subplots(figsize=(8, 2.2))
    x = np.linspace(-0.12, 1.12, 700)
    axes.fill_between(x, heights(x), -0.42, color="#f1efe9")
    inside = (x >= 0) & (x <= 1)
    axes.fill_between(x[inside], heights(x[inside]), -0.42, color="#dfd9cc")
    axes.plot(x, heights(x), color="black", lw=1.3)
    slope = -0.06
    height = -0.005
    start = 0.56
    pieces = 0
    while pieces < 4:
        t = np.linspace(0, 1.0 - start, 20001)
        z = height + slope * t
        blocked = np.nonzero(z < heights(start + t))[0]
        last = int(blocked[0]) if len(blocked) else len(t) - 1
        axes.plot(start + t[[0, last]], z[[0, last]], color=BLUE, lw=1.8)
        if len(blocked):
            axes.plot(start + t[last], z[last], "o", color=RED, ms=6)
            break
        arrow(
            axes, (start + t[last] - 0.03, z[last] + 0.03 * -slope), (start + t[last], float(z[last])), BLUE
        )
        height, start, pieces = float(z[last]), start + float(t[last]) - 1.0, pieces + 1
        axes.plot(start, height, "o", mfc="white", mec=BLUE, ms=6)
        axes.text(start + 0.015, height + 0.02, "re-enters", color=BLUE, fontsize=9, va="bottom")
    for border, name in ((0.0, "left border"), (1.0, "right border")):
        axes.plot([border, border], [-0.42, 0.03], color=GRAY, ls=":", lw=1)
        axes.text(border, 0.035, name, ha="center", va="bottom", color=GRAY, fontsize=9)
    axes.set_xlim(-0.13, 1.13)
    bare(axes)
    return figure


DRAWINGS: dict[str, Callable[[Any], Any]] = {
    "tile": tile,
    "orientation": orientation,
    "footprint": footprint,
    "light": light,
    "periodic": periodic,
}


def main() -> None:
    """Write every drawing beside this file."""
    import matplotlib

    matplotlib.use("svg")
    # The same file every time.
    matplotlib.rcParams.update({"svg.hashsalt": "mbtf", "svg.fonttype": "path", "font.size": 10})
    from matplotlib import pyplot

    for name, draw in DRAWINGS.items():
        figure = draw(pyplot)
        figure.savefig(
            FOLDER / f"{name}.svg", bbox_inches="tight", metadata={"Date": None}, facecolor="white"
        )
        pyplot.close(figure)


if __name__ == "__main__":
    main()
