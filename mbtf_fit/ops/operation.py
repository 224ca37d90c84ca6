"""Operations: a model is an ordered list of them, which back ends implement by their types.

An operation computes one or more named values from others. Every list starts from the values

- ``u`` (2): position, uv;
- ``level`` (1): fractional level of the footprint, ``clamp(-log2(2σ), 0, k)``;
- ``omega_i``, ``omega_o`` (3): unit vectors towards light and viewer, z > 0;

and its last value is M(u, σ, ω_i, ω_o) in 1/sr, which readers clamp at 0. ``name[a:b]`` names the numbers a
to b - 1 of a value. What does not depend on ``omega_i`` is stage 1, which is computed once for all lights.

An operation is a frozen dataclass. Its fields say what it reads: :data:`Value` a value, :data:`Values`
several values that are concatenated, :data:`TensorName` a tensor of the material, :data:`TextureName` the
tensors ``name.0``, ``name.1``, … of a texture's levels, :data:`NetworkName` the tensors of a network. The
name of an operation in files, and its keys there, are those of the dataclass."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from functools import cache
from typing import (
    Annotated,
    Any,
    ClassVar,
    Generic,
    Literal,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import ConfigDict, TypeAdapter, ValidationError

from mbtf_core.errors import InputError
from mbtf_core.paths import suggest_name

Value = Annotated[str, "value"]
Values = tuple[Value, ...]
TensorName = Annotated[str, "tensor"]
TextureName = Annotated[str, "texture"]
NetworkName = Annotated[str, "network"]

# Values that every list starts from, and their sizes.
INPUTS = {"u": 2, "level": 1, "omega_i": 3, "omega_o": 3}

# Name of a material's sampler, of its network and tensors, and the start of the names of its values.
SAMPLER = "sampler"
# Most operations of a list that is read.
_MOST_OPERATIONS = 1000

_KINDS: dict[str, type[Operation]] = {}
_REFERENCE = re.compile(r"(\w+)(?:\[(\d+):(\d+)\])?")


# A value of a back end.
V = TypeVar("V")


@dataclass(frozen=True)
class Operation:
    """One step of a model.

    Attributes
    ----------
    output : str
        Name of the value that it computes.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)

    output: str

    def __post_init__(self) -> None:
        """
        Raises
        ------
        TypeError : a field is one name, not several
        ValueError : a field is none of the names that it may be
        """
        for name in _lists_of(self.kind()):
            if isinstance(one := getattr(self, name), str):
                raise TypeError(f"{self.kind()}: '{name}' is one name, not several: ('{one}',)")
        for name, choices in _choices_of(self.kind()).items():
            if (given := getattr(self, name)) not in choices:
                hint = suggest_name(str(given), choices)
                raise ValueError(
                    f"{self.kind()} '{self.output}': {name} must be one of {', '.join(choices)}, not "
                    f"'{given}'{hint and f'; {hint}'}"
                )

    def __init_subclass__(cls) -> None:
        other = _KINDS.setdefault(cls.kind(), cls)
        if (other.__module__, other.__name__) != (cls.__module__, cls.__name__):
            raise TypeError(
                f"{other.__module__} has an operation '{cls.kind()}' already; choose another name"
            )
        _KINDS[cls.kind()] = cls

    @classmethod
    def kind(cls) -> str:
        """Its name in files: ``half_vector`` of HalfVector."""
        return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).lower()

    @classmethod
    def signature(cls) -> str:
        """How it is called: ``Product(output, (x, …))``; several values stand in parentheses."""
        several, out = _lists_of(cls.kind()), []
        for f in fields(cls):
            shown = "…" if isinstance(f.default, tuple) else repr(f.default)
            name = f"({f.name}, …)" if f.name in several else f.name
            out.append(name if f.default is MISSING else f"{name}={shown}")
        return f"{cls.__name__}({', '.join(out)})"

    @classmethod
    def summary(cls) -> str:
        """The first paragraph of its docstring on one line, with code between backquotes."""
        text = " ".join((inspect.getdoc(cls) or "").split("\n\n")[0].split())
        return re.sub(r":\w+:`~?(?:\w+\.)*(\w+)`", r"`\1`", text).replace("``", "`")

    def size(self, sizes: Sequence[int]) -> int:
        """Numbers of the output, from those of the inputs in the order of the fields."""
        raise NotImplementedError

    def results(self, sizes: Sequence[int]) -> dict[str, int]:
        """Name and size of each value that it computes."""
        return {self.output: self.size(sizes)}

    @classmethod
    def value_fields(cls) -> list[str]:
        """The fields that name values."""
        return _fields_of(cls.kind(), "value")

    def inputs(self) -> list[str]:
        """The values that it reads, with ranges, in the order of the fields."""
        return self.named("value")

    @staticmethod
    def kinds() -> list[type[Operation]]:
        """All operations of the project."""
        room = __name__.rpartition(".")[0]
        return [kind for kind in Operation.__subclasses__() if kind.__module__.startswith(room)]

    def arguments(self, read: Callable[[str, slice], V]) -> list[V | list[V] | None]:
        """What its fields say of values, in their order.

        Parameters
        ----------
        read : of a name and a range, the value of a back end

        Returns
        -------
        list
            A value for a field with one name, a list for several, None for a field that is left out.
        """
        out: list[V | list[V] | None] = []
        for name in self.value_fields():
            found = getattr(self, name)
            if found is None:
                out.append(None)
            elif isinstance(found, str):
                out.append(read(*parse(found)))
            else:
                out.append([read(*parse(reference)) for reference in found])
        return out

    def named(self, kind: str) -> list[str]:
        """What fields of a kind name: ``value``, ``tensor``, ``texture`` or ``network``."""
        out: list[str] = []
        for name in _fields_of(self.kind(), kind):
            found = getattr(self, name)
            out += [] if found is None else [found] if isinstance(found, str) else found
        return out

    def as_json(self) -> dict[str, Any]:
        """Plain data; optional fields that are None are left out."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if f.default is not None}
        given |= {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None}
        return {
            "operation": self.kind(),
            **{f.name: _plain(given[f.name]) for f in fields(self) if f.name in given},
        }

    def stored(self) -> Operation:
        """The operation as a material stores it, without what only training needs."""
        return self


@cache
def _fields_of(operation: str, kind: str) -> list[str]:
    cls = _KINDS[operation]
    hints = get_type_hints(cls, include_extras=True)
    return [f.name for f in fields(cls) if kind in _marks(hints[f.name])]


@cache
def _lists_of(operation: str) -> list[str]:
    """The fields that name several values."""
    hints = get_type_hints(_KINDS[operation], include_extras=True)
    return [name for name, hint in hints.items() if hint == Values]


@cache
def _choices_of(operation: str) -> dict[str, tuple[str, ...]]:
    """The fields that are one of some names, and these."""
    hints = get_type_hints(_KINDS[operation])
    return {name: get_args(hint) for name, hint in hints.items() if get_origin(hint) is Literal}


def _marks(hint: Any) -> Iterator[str]:
    yield from getattr(hint, "__metadata__", ())
    for part in get_args(hint):
        yield from _marks(part)


def _plain(value: Any) -> Any:
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


@cache
def _adapter(kind: str) -> TypeAdapter[Operation]:
    return TypeAdapter(_KINDS[kind])


def read_operations(data: Any) -> list[Operation]:
    """Operations of a value from plain data of :meth:`Operation.as_json`.

    Raises
    ------
    ValueError : an operation is unknown, or a key is missing, unknown or of a wrong type
    """
    out = parse_operations(data)
    sizes_of(out)
    return out


def parse_operations(data: Any) -> list[Operation]:
    """The same without the check that they compute a value."""
    if not isinstance(data, list):
        raise ValueError("operations are no list")
    if len(data) > _MOST_OPERATIONS:
        raise ValueError(f"has more than {_MOST_OPERATIONS} operations")
    out = []
    for k, entry in enumerate(data):
        given = dict(entry) if isinstance(entry, Mapping) else {}
        kind = given.pop("operation", None)
        if not isinstance(kind, str) or kind not in _KINDS:
            raise ValueError(f"operation {k} is unknown: {kind!r}")
        try:
            out.append(_adapter(kind).validate_python(given))
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise ValueError(f"operation {k} ({kind}): {where}: {first['msg']}") from None
    return out


def parse(reference: str) -> tuple[str, slice]:
    """Name and range of a reference ``name`` or ``name[a:b]``."""
    found = _REFERENCE.fullmatch(reference)
    if found is None:
        raise ValueError(f"'{reference}' names no value")
    name, start, stop = found.groups()
    return name, slice(None) if start is None else slice(int(start), int(stop))


def sizes_of(operations: Sequence[Operation]) -> dict[str, int]:
    """Size of every value of a list.

    Raises
    ------
    ValueError : an operation reads an unknown value, or one of a wrong size, or a value is computed twice, or
        has a name of the sampler
    """
    sizes = dict(INPUTS)
    for operation in operations:
        tensors = [n for kind in ("tensor", "texture", "network") for n in operation.named(kind)]
        for name in [*output_names(operation), *tensors]:
            if name.startswith(SAMPLER):
                raise ValueError(
                    f"'{name}': names that start with '{SAMPLER}' are those of importance sampling"
                )
        found = operation.results(input_sizes(operation, sizes))
        again = next((name for name in found if name in sizes), None)
        if again is not None:
            raise ValueError(f"'{again}' is computed twice")
        sizes |= found
    if not operations or sizes[operations[-1].output] != 3:
        raise ValueError("the last operation gives no color")
    return sizes


def input_sizes(operation: Operation, sizes: Mapping[str, int]) -> list[int]:
    """Sizes of an operation's inputs, from those of all values before it."""
    out = []
    for reference in operation.inputs():
        name, part = parse(reference)
        if name not in sizes:
            hint = suggest_name(name, list(sizes))
            what = f"{operation.kind()} '{operation.output}' reads '{name}', which is not computed"
            raise ValueError(what + (hint and f"; {hint}"))
        size = len(range(sizes[name])[part])
        if size == 0 or (part.stop or 0) > sizes[name]:
            raise ValueError(f"'{reference}' is beyond the {sizes[name]} numbers of '{name}'")
        out.append(size)
    return out


def reached_from(operations: Sequence[Operation], *names: str) -> set[str]:
    """Values that depend on any of these values, themselves included."""
    found = set(names)
    for operation in operations:
        if any(parse(reference)[0] in found for reference in operation.inputs()):
            found |= set(output_names(operation))
    return found


def output_names(operation: Operation) -> list[str]:
    """Names of the values that an operation computes."""
    return [operation.output, *operation.named("further output")]


def stages(operations: Sequence[Operation]) -> tuple[list[Operation], list[Operation]]:
    """(stage 1, which does not depend on the light; stage 2)."""
    lit = reached_from(operations, "omega_i")
    return [o for o in operations if o.output not in lit], [o for o in operations if o.output in lit]


def needed_for(
    operations: Sequence[Operation], wanted: Sequence[str], given: Sequence[str]
) -> list[Operation]:
    """The operations that these values need, where other values are given already."""
    missing, out = set(wanted) - set(given), []
    for operation in reversed(operations):
        if missing & set(output_names(operation)):
            out.append(operation)
            missing |= {parse(reference)[0] for reference in operation.inputs()} - set(given)
    return out[::-1]


F = TypeVar("F", bound=Callable[..., object])


class Backend(Generic[F]):
    """Implementations of operations::

        BACKEND: Backend[...] = Backend("the Mitsuba plugin")

        @BACKEND.implements(Lookup)
        def lookup(op: Lookup, ...): ...

    Parameters
    ----------
    name : what error messages call it
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._functions: dict[type[Operation], F] = {}

    def implements(self, kind: type[Operation]) -> Callable[[F], F]:
        """Register the decorated function as the implementation of an operation."""

        def register(function: F) -> F:
            self._functions[kind] = function
            return function

        return register

    def __getitem__(self, operation: Operation) -> F:
        """The implementation of an operation.

        Raises
        ------
        InputError : there is none
        """
        function = self._functions.get(type(operation))
        if function is None:
            raise InputError(f"{self.name} does not support the operation '{operation.kind()}'")
        return function

    def check(self, operations: Iterable[Operation]) -> None:
        """Refuse a list with an operation that is not implemented.

        Raises
        ------
        InputError : names the first one
        """
        for operation in operations:
            self[operation]
