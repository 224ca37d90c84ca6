"""Messages and exit codes of the errors that reach a user."""

from __future__ import annotations

import pytest

from mbtf_core.errors import EngineError, InputError, MbtfError, PartialError, UsageError


def test_message_says_where_what_and_cure() -> None:
    error = InputError("unknown key 'hight'", where="material.yaml:3", hint="did you mean 'height'?")
    assert error.message == "material.yaml:3: unknown key 'hight'\n  did you mean 'height'?"
    assert str(error) == error.message
    assert InputError("no map").message == "no map"
    assert (error.what, error.where, error.hint) == (
        "unknown key 'hight'",
        "material.yaml:3",
        "did you mean 'height'?",
    )


@pytest.mark.parametrize(
    ("error", "code"), [(MbtfError, 1), (UsageError, 2), (InputError, 3), (EngineError, 3), (PartialError, 4)]
)
def test_exit_codes_are_those_of_the_contract(error: type[MbtfError], code: int) -> None:
    assert error("x").exit_code == code
    assert issubclass(error, MbtfError)
