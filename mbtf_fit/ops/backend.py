"""Back ends: each implements operations, by their type; none knows a model."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

from mbtf_core.errors import InputError
from mbtf_fit.ops.operation import Operation

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
