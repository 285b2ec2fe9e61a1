"""Docstrings: one dialect, and arguments that are said in noun phrases or sentences, never in fragments."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest
from test_architecture import modules

SECTIONS = re.compile(r"(Args|Attributes|Returns|Yields|Raises|Gradients|References?):(.*)")
ARGUMENT = re.compile(r"    (\*{0,2}[\w`.]+(?:(?:,| and) \*{0,2}[\w`.]+)*): (.*)")

# Symbols and names of programs, which are written small wherever they stand; also a list of names.
SMALL = re.compile(r"(lambda|gamma|a|d|fy|torch|viser|base64)\b|\w+,|\w*[.(=_]")

# What opens a phrase that says nothing without the name of what it is about: "Of the cotangents.", "As given.", "Its."
FRAGMENT = re.compile(
    r"(of|as|at|by|for|from|in|on|to|with|without|over|per|between|behind|beside|besides|under|above|below|across|along"
    r"|after|before|until|around|against|through|within|only|also|like|whose|where|when|which)\b"
    r"|(its|theirs?|the same|these|those|one)[.;:]",
    re.IGNORECASE,
)


def docstrings() -> Iterator[tuple[str, str, list[str]]]:
    """(module, name, lines) of every docstring of the package."""
    for module, tree in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node)
                if text:
                    yield module, getattr(node, "name", ""), text.splitlines()


def arguments(lines: list[str]) -> Iterator[tuple[str, str]]:
    """(name, first line of its description) of everything in sections `Args` and `Attributes`."""
    is_inside = False
    for line in lines:
        if found := SECTIONS.fullmatch(line):
            is_inside = found[1] in ("Args", "Attributes")
        elif line and not line.startswith(" "):
            is_inside = False
        elif is_inside and (found := ARGUMENT.fullmatch(line)):
            yield found[1], found[2]


def faults(lines: list[str]) -> Iterator[str]:
    """What is wrong with a docstring."""
    for name, description in arguments(lines):
        if FRAGMENT.match(description):
            yield f"{name}: a fragment: {description}"
        elif description[:1].islower() and not SMALL.match(description):
            yield f"{name}: begins with a small letter: {description}"
    for above, line in zip(lines[2:], lines[3:], strict=False):
        if SECTIONS.fullmatch(line) and not above and any(map(SECTIONS.fullmatch, lines[: lines.index(line)])):
            yield f"an empty line before {line}"
    for line in lines:
        if "``" in line:
            yield f"two backticks, one is enough: {line.strip()}"
        elif line in ("References:", "Parameters:", "Params:", "Return:", "Throws:", "Arguments:"):
            yield f"another dialect's section: {line}"


def test_arguments_are_no_fragments():
    """Each description of an argument or attribute can be read by itself, and sections follow one another closely."""
    found: dict[str, list[str]] = {}
    for module, name, lines in docstrings():
        for fault in faults(lines):
            found.setdefault(module, []).append(f"{name}: {fault}")
    assert found == {}


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("Seed of the cotangents.", 0),
        ("Of the cotangents.", 1),
        ("of the cotangents.", 1),
        ("As for `drgs.render`.", 1),
        ("Its.", 1),
        ("Its own name.", 0),
        ("(N, 3) means.", 0),
        ("lambda of every group.", 0),
        ("names of the photographs.", 1),
        ("`wxyz`, or `xyzw`.", 0),
        ("drgs.cameras.Camera.", 0),
        ("Where it listens.", 1),
        ("None where there is none.", 0),
    ],
)
def test_a_fragment_is_found(text, count):
    """What opens with a preposition, or with nothing but a pronoun, is one; what opens with a noun is none."""
    lines = ["What it does.", "", "Args:", f"    first, *others: {text}", "        Of a second line nothing is asked."]
    assert len([*faults(lines)]) == count
    assert len([*faults([*lines, "Returns:", "    Of what is returned nothing is asked."])]) == count
    assert len([*faults([*lines, "", "Returns:", "    Something."])]) == count + 1
    assert len([*faults([*lines, "References:", "    Somebody, ``Something``."])]) == count + 2
