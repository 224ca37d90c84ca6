"""docs/troubleshooting.md lists every message of the programs, and none that they no longer make."""

from __future__ import annotations

import re

import pytest
from support.messages import DOCUMENT, GAP, Source, collect, item, listed, relays


def test_every_message_is_listed() -> None:
    known = set(listed())
    missing = [f"{item(m.pattern)}    {m.file}:{m.line}" for m in collect() if m.pattern not in known]
    assert not missing, "docs/troubleshooting.md lacks:\n" + "\n".join(missing)


def test_no_listed_message_is_stale() -> None:
    made = {m.pattern for m in collect()}
    stale = [pattern for pattern in listed() if pattern not in made]
    assert not stale, "docs/troubleshooting.md lists what is not made any more:\n" + "\n".join(stale)


def test_no_message_is_listed_twice() -> None:
    found = listed()
    assert sorted(found) == sorted(set(found))


def test_every_group_of_messages_is_explained() -> None:
    parts = re.split(r"^#{2,3} (.+)$", DOCUMENT.read_text(encoding="utf-8"), flags=re.MULTILINE)
    for heading, text in zip(parts[1::2], parts[2::2], strict=True):
        after = text.rpartition("\n- `")[2].partition("\n")[2].strip() if listed(text) else text.strip()
        assert after or not text.strip(), f"'{heading}' does not say what to do"


# Functions whose message is what another one said: of this project (collected there), of the validator,
# Mitsuba or the system (shown as it is), or a text chosen by the caller.
RELAYS = {
    "mbtf_gen/atomic.py": {"_temporary", "remove_file"},
    "mbtf_gen/config.py": {"_effects"},
    "mbtf_gen/console.py": {"_usage_message", "run"},
    "mbtf_gen/durations.py": {"asked_duration"},
    "mbtf_gen/engine.py": {"_llvm_error", "check_llvm", "load_mitsuba"},
    "mbtf_gen/generation.py": {"generate", "plan", "prepare"},
    "mbtf_gen/locks.py": {"take_lock"},
    "mbtf_gen/map_names.py": {"_lost_warning", "find_maps"},
    "mbtf_gen/material.py": {"_assemble", "_heights"},
    "mbtf_gen/material_checks.py": {
        *("flat_warning", "orientation_warning", "relief_warning", "seam_warning", "suggestion_warning"),
    },
    "mbtf_gen/output_folder.py": {"_clear"},
    "mbtf_gen/repairs.py": {"faults", "job", "mend"},
    "mbtf_gen/selftest_checks.py": {"_cuda"},
    "mbtf_gen/settings.py": {"_explain", "build"},
    "mbtf_gen/shard_files.py": {"write"},
    "mbtf_gen/verification.py": {
        "_content_fault",
        "_manifest_faults",
        "_record_of",
        "examine",
    },
    "mbtf_gen/wording.py": {"explain"},
}


def test_messages_that_cannot_be_read_off_the_source_are_known() -> None:
    assert relays() == {f"{file}:{function}" for file, found in RELAYS.items() for function in found}


SOURCE = """
def name(x):
    return f"is {x}" if x else "is nothing"

def refuse(x, warnings):
    what = f"holds {x} pixels" if x else "holds none"
    if x == 1:
        raise InputError(what, where=x, cure="not this")
    if x == 2:
        raise ValueError("must " + f"be {x:.3f}" + " or so")
    if x == 3:
        return EngineError(name(x))
    if x == 4:
        raise PartialError(str(x))
    warnings.append(f"{x}: odd" if x else "even")
    log.warning(f"slow ({x})")
    raise AttributeError("of the protocol")
"""


PATTERNS = [
    "holds … pixels",
    "holds none",
    "must be … or so",
    "is …",
    "is nothing",
    "…: odd",
    "even",
    "slow (…)",
]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_messages_are_found_in_a_source(pattern: str) -> None:
    assert pattern in {m.pattern for m in Source(SOURCE, "some/file.py").messages()}


def test_nothing_else_is_found_in_a_source() -> None:
    assert {m.pattern for m in Source(SOURCE, "some/file.py").messages()} == {*PATTERNS, GAP}


def test_well_known_messages_are_among_those_collected() -> None:
    found = {(m.kind, m.pattern) for m in collect()}
    assert ("error", "no such file") in found
    assert ("error", "unknown key '…'") in found  # made of parts, raised by another function
    assert ("error", "must be a whole number") in found  # from a table
    assert ("error", "has the same content as …") in found  # a fault that verify reports
    assert ("warning", "…: its alpha channel is not used") in found


def test_the_table_of_exit_codes_is_right() -> None:
    from mbtf_gen import console, errors

    codes = {int(m) for m in re.findall(r"^\| (\d+) \|", DOCUMENT.read_text(encoding="utf-8"), re.MULTILINE)}
    told = {getattr(errors, n) for n in dir(errors) if n.startswith("EXIT_")} | {console.EXIT_INTERNAL}
    assert codes == told
