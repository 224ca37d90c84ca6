"""The user's request for effects (``--effects``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from mbtf_core.errors import UsageError
from mbtf_gen.effects.catalog import EFFECTS


@dataclass(frozen=True)
class EffectsRequest:
    """The user's request: ``auto``, ``all`` or ``none``, and effects forced on or off."""

    base: Literal["auto", "all", "none"]
    forced: dict[str, bool]

    @property
    def auto(self) -> frozenset[str]:
        """Effects that are left to the plan."""
        return frozenset(EFFECTS.keys() - self.forced.keys()) if self.base == "auto" else frozenset()

    @classmethod
    def parse(cls, text: str) -> EffectsRequest:
        """Read ``auto``, ``all``, ``none``, ``+x``, ``-x``, or a comma-separated list of them.

        Raises
        ------
        UsageError : an unknown word
        """
        base: Any = "auto"
        forced: dict[str, bool] = {}
        for position, word in enumerate(w.strip() for w in text.split(",")):
            if position == 0 and word in ("auto", "all", "none"):
                base = word
            elif word[:1] in ("+", "-") and word[1:] in EFFECTS:
                forced[word[1:]] = word[0] == "+"
            else:
                raise UsageError(
                    f"'{word}' is not an effect",
                    where="--effects",
                    hint=f"auto, all or none, then +x or -x with x of {', '.join(EFFECTS)}",
                )
        return cls(base, forced)
