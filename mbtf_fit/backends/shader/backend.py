"""What implementations of operations in shaders have in common: values, and the code that they write.

An implementation is called once per material, with the values that the operation's fields name. It returns an
expression of its result, of four numbers at most; or a list of expressions, of four numbers each and of the
rest; or a :class:`Value`, whose code it has written itself. Of several results it returns a tuple.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, NamedTuple

from mbtf_fit.backends.shader.images import F16, F32, Layout, TexelImage, half_rows
from mbtf_fit.backends.shader.syntax import Syntax
from mbtf_fit.ops import Backend

SHADER: Backend[Callable[..., Any]] = Backend("the shader generator")


class Number(NamedTuple):
    """A number in a shader: a component of a vector of `width` numbers, or, of width 1, a variable."""

    variable: str
    component: int = 0
    width: int = 1

    def __str__(self) -> str:
        return self.variable if self.width == 1 else f"{self.variable}.{'xyzw'[self.component]}"


@dataclass(frozen=True)
class Value:
    """Numbers in a shader. As text, an expression of a number, or of a vector of two to four.

    Attributes
    ----------
    numbers : where they are
    lit : whether they depend on the light
    """

    numbers: tuple[Number, ...]
    lit: bool = False

    @classmethod
    def of(cls, name: str, size: int, lit: bool = False) -> Value:
        """Of a variable of one to four numbers."""
        return cls(tuple(Number(name, c, size) for c in range(size)), lit)

    @classmethod
    def of_array(cls, name: str, size: int, lit: bool = False, width: int = 4) -> Value:
        """Of the first numbers of an array of vectors of `width` numbers."""
        return cls(tuple(Number(f"{name}[{k // width}]", k % width, width) for k in range(size)), lit)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, part: slice) -> Value:
        return Value(self.numbers[part], self.lit)

    def __add__(self, other: Value) -> Value:
        return Value(self.numbers + other.numbers, self.lit or other.lit)

    def __str__(self) -> str:
        variables, components = {n.variable for n in self.numbers}, [n.component for n in self.numbers]
        first = self.numbers[0]
        if len(variables) > 1:
            return f"float{len(self)}({', '.join(self.scalars())})"
        if components == list(range(first.width)):
            return first.variable
        return f"{first.variable}.{''.join('xyzw'[c] for c in components)}"

    def scalars(self) -> list[str]:
        """An expression of each number."""
        return [str(number) for number in self.numbers]

    def vectors(self) -> list[str]:
        """Expressions of four numbers each, and of the rest."""
        return [str(self[k : k + 4]) for k in range(0, len(self), 4)]


def in_fours(scalars: Sequence[str]) -> list[str]:
    """Expressions of numbers as expressions of four numbers each, and of the rest."""
    parts = [scalars[k : k + 4] for k in range(0, len(scalars), 4)]
    return [p[0] if len(p) == 1 else f"float{len(p)}({', '.join(p)})" for p in parts]


class Code:
    """The code of a material while operations write it.

    Parameters
    ----------
    syntax : the language
    tensors : of the material, by name
    kept : values of stage 1 that stage 2 reads
    precise : textures and networks that need single precision, because they move lookups

    Attributes
    ----------
    globals : constants and functions
    fields : what stage 1 leaves for stage 2, members of the structure ``Seen``
    bodies : statements of stage 1 and of stage 2
    lit : whether the current operation depends on the light, so that its code is part of stage 2
    images : by the names of their tensors
    weights : vectors (n, 4) of the networks' layers
    matrices : those of cooperative vectors
    """

    def __init__(
        self, syntax: Syntax, tensors: Mapping[str, F32], kept: Collection[str], precise: Collection[str]
    ) -> None:
        self.syntax, self.tensors = syntax, tensors
        self.globals: list[str] = []
        self.fields: list[str] = []
        self.bodies: tuple[list[str], list[str]] = ([], [])
        self.lit = False
        self.images: dict[str, TexelImage] = {}
        self.weights: list[F32] = []
        self.matrices: list[F16] = []
        self.precise, self._kept = precise, kept
        self._included: set[str] = set()
        self._names = 0

    def write(self, *lines: str) -> None:
        """Append statements."""
        self.bodies[self.lit].extend(f"  {line}" for line in lines)

    @contextmanager
    def stage_of(self, *values: Value) -> Iterator[None]:
        """Write to stage 1 where none of these values depends on the light."""
        before, self.lit = self.lit, any(value.lit for value in values)
        yield
        self.lit = before

    def name(self, hint: str) -> str:
        """A name that nothing else has."""
        self._names += 1
        return f"{re.sub('[^A-Za-z0-9]+', '_', hint).strip('_') or 'value'}_{self._names}"

    def let(self, kind: str, expression: str, hint: str = "t") -> str:
        """A local variable of a type, and its value."""
        name = self.name(hint)
        self.write(f"{kind} {name} = {expression};")
        return name

    def variable(self, kind: str, hint: str, count: int = 0, *, kept: bool | None = None) -> str:
        """A variable, or an array. Stage 2 reads it where it is `kept`, by default where it reads a value of
        this name."""
        name = self.name(hint)
        declaration = f"{kind} {name}{f'[{count}]' if count else ''};"
        if not self.lit and (hint in self._kept if kept is None else kept):
            self.fields.append(declaration)
            return f"seen.{name}"
        self.write(declaration)
        return name

    def result(self, hint: str, size: int, found: str | Sequence[str] | Value) -> Value:
        """The value of what an implementation returns."""
        if isinstance(found, Value):
            return found
        vectors = [found] if isinstance(found, str) else found
        if len(vectors) > 1:
            name = self.variable("float4", hint, len(vectors))
            self.fill(name, vectors, size)
            return Value.of_array(name, size, self.lit)
        kind = "float" if size == 1 else f"float{size}"
        if not self.lit and hint in self._kept:
            name = self.variable(kind, hint)
            self.write(f"{name} = {vectors[0]};")
        else:
            name = self.let(kind, vectors[0], hint)
        return Value.of(name, size, self.lit)

    def fill(self, name: str, vectors: Sequence[str], size: int) -> None:
        """Assign expressions of four numbers each, and of the rest, to an array of vectors of four."""
        padding = ", 0.0" * (-size % 4)
        last = f"float4({vectors[-1]}{padding})" if padding else vectors[-1]
        self.write(*(f"{name}[{k}] = {v};" for k, v in enumerate([*vectors[:-1], last])))

    def include(self, library: str) -> None:
        """Put a file of this folder, with functions in the common part of both languages, before the
        material's code."""
        if library not in self._included:
            self._included.add(library)
            self.globals.append(files(__package__).joinpath(f"{library}.slang").read_text())

    def constants(self, kind: str, hint: str, values: Sequence[str]) -> str:
        """A constant array of a type."""
        name = self.name(hint)
        line = self.syntax.array.format(type=kind, name=name, count=len(values), values=", ".join(values))
        self.globals.append(line)
        return name

    def scalar(self, tensor: str) -> float:
        """A tensor ()."""
        return float(self.tensors[tensor])

    def matrix(self, matrix: F32) -> int:
        """Keep a matrix for cooperative vectors; the place of its first byte among them."""
        first = sum(other.nbytes for other in self.matrices)
        self.matrices.append(half_rows(matrix))
        return first

    def image(self, source: str, layout: Layout = "plain", half: bool = False) -> TexelImage:
        """The image of a texture, or of one tensor; whether half precision suffices."""
        if source not in self.images:
            self.include("textures")
            levels = [t for name, t in self.tensors.items() if name.rpartition(".")[0] == source]
            levels = [self.tensors[f"{source}.{s}"] for s in range(len(levels))] or [self.tensors[source]]
            self.images[source] = TexelImage(self.name(source), source, layout, tuple(levels), half)
        return self.images[source]

    def pair(self, image: TexelImage, level: str, u: str) -> str:
        """Two adjacent levels of an image, an expression of the type ``Pair``."""
        name, count = f"{image}_pair", len(image.levels)
        if name not in self._included:
            self._included.add(name)
            table = self.constants("int3", f"{image}_levels", [image.level(s) for s in range(count)])
            self.globals.append(
                f"Pair {name}(float level, float2 u) {{\n"
                f"  float l = clamp(level, 0.0, {count - 1}.0);\n"
                f"  int s = max(min(int(l), {count - 2}), 0);\n"
                f"  Corners fine = corners({table}[min(s + 1, {count - 1})], u);\n"
                f"  return Pair(corners({table}[s], u), fine, l - float(s));\n"
                "}"
            )
        return f"{name}({level}, {u})"
