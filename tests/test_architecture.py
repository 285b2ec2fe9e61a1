"""The house: arrows between rooms point down only, and nobody walks through the front door inside."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.core

PACKAGE = Path(__file__).parents[1] / "drgs"

# From the ground up. A module belongs to the longest name that is listed; it may import what stands on its own floor
# and below, never what is above.
FLOORS: list[tuple[set[str], str]] = [
    (
        {
            "lenses",
            "shutters",
            "information.sums",
        },
        "know nothing of the rest: plain data, or math",
    ),
    ({"guards", "io", "display.progress", "display.tables"}, "refuse bad input, show progress: needed from everywhere"),
    (
        {"information.criteria", "information.choices", "information.prior"},
        "what views can be judged and chosen by, by name",
    ),
    ({"settings", "runtime"}, "what a render can be asked for, and the machine it runs on"),
    ({"guards.memory", "guards.camera_checks"}, "guards that know the machine or the settings"),
    ({"cameras", "ellipsoids", "sizes"}, "the two things that a view is made of, and how large it is looked at"),
    ({"splats"}, "cameras and Gaussians as tensors that make them"),
    ({"oracle", "reference"}, "the truth: below the engine, so that it cannot borrow from what it checks"),
    ({"io.run", "display"}, "what is written, for machines and people"),
    ({"scenes"}, "made data sets, path traced by Mitsuba: they know nothing of Gaussians"),
    ({"codecs"}, "Gaussians in the formats of others"),
    ({"files"}, "files, for users"),
    ({"tracing"}, "the engine"),
    ({"integrator", "plugin"}, "rendering with it, from torch and from Mitsuba"),
    (
        {"covariances"},
        "Gaussians by their covariances",
    ),
    ({"rasterize"}, "the same under gsplat's names"),
    ({"deform", "dynamics"}, "Gaussians that move: what comes above sees a scene, by its protocol"),
    ({"features"}, "what Gaussians and pixels are called: teacher maps, decoder, labels, queries"),
    ({"information"}, "what a view says about each parameter, and how that becomes a score"),
    ({"fisher", "gain"}, "both for users"),
    ({"meshing"}, "a surface from depth, cut to what information determines"),
    ({"selection"}, "what chooses among views, by information or by poses"),
    ({"select"}, "policies, for users"),
    ({"data"}, "photographs and their cameras, from disk"),
    ({"sfm"}, "poses and points of photographs: it reads them by data, which knows nothing of it"),
    ({"fitting"}, "the parts of a fit"),
    ({"metrics"}, "pictures against photographs"),
    ({"train", "evaluation"}, "fits, for users, and what they are worth"),
    ({"planner"}, "where to look next, photograph by photograph, for a robot"),
    ({"report"}, "what a fit looked like, as a page"),
    ({"lab"}, "experiments on all of the above"),
    ({"studies"}, "many fits, and what they say together"),
    ({"cluster"}, "all of this in other processes, on one machine or many"),
    ({"viewing"}, "a scene in the browser, whatever command says which"),
    ({"sharing"}, "a scene as a page that is sent"),
    ({"capturing"}, "from photographs to a run and its pages, and where to stand next"),
    ({"crossval", "ladder", "testing"}, "the lab's doors, for users"),
    ({"commands"}, "one module a command: options in, files out"),
    ({"cli"}, "which command it is"),
    ({"", "__main__"}, "the facade, which names what users import, and the program"),
]

# Modules that may `import drgs`.
FACADE = {"cli": "the program", "runtime": "`__version__`, which the package states there"}


@functools.cache
def modules() -> dict[str, ast.Module]:
    """Name without `drgs.` -> its syntax tree; the package itself is ``""``."""
    found = {}
    linked = (PACKAGE / "scenes").glob("*.py")  # a link to the folder beside the package, which rglob does not follow
    for path in sorted([*PACKAGE.rglob("*.py"), *linked]):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = ast.parse(path.read_text(), str(path))
    return found


def imported(tree: ast.AST) -> Iterator[str]:
    """Modules of the package that any statement of a tree imports, wherever it stands; ``""`` is the facade."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            if name == "drgs" or name.startswith("drgs."):
                name = name.removeprefix("drgs").removeprefix(".")
                # `from drgs.x import f`: f is a module or something in x.
                yield name if name in modules() else name.rpartition(".")[0]


def floor_of(module: str) -> int:
    """Number of its floor."""
    fits = [
        (len(entry), number)
        for number, (entries, _) in enumerate(FLOORS)
        for entry in entries
        if module == entry or (entry and module.startswith(f"{entry}."))
    ]
    assert fits, f"{module}: on no floor; add it to FLOORS, with the reason for its place"
    return max(fits)[1]


def test_arrows_point_down():
    """No module imports one from a floor above its own, be it in a function or for types only."""
    found = set()
    for module, tree in modules().items():
        for other in set(imported(tree)) - {""}:  # the facade has a test of its own
            if floor_of(other) > floor_of(module):
                found.add((module, other))
    assert not found


def test_every_floor_is_lived_on():
    """The table names no room that is not there."""
    assert {name for names, _ in FLOORS for name in names} <= set(modules())


def test_commands_are_imported_by_the_program_only():
    """What a command does is its module's business: nothing but the program and other commands starts from there."""
    users = {module for module, tree in modules().items() if any(x.startswith("commands") for x in imported(tree))}
    assert {x for x in users if not x.startswith("commands")} == {"cli"}


def test_nobody_imports_the_facade():
    """Inside, the module that is needed is imported, so that a name has one home."""
    assert {module for module, tree in modules().items() if "" in set(imported(tree))} == set(FACADE)


def circle_of(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """Module -> those that it reaches and that reach it, itself among them; of modules in a circle only."""

    def reached(module: str) -> set[str]:
        seen: set[str] = set()
        rest = set(graph[module])
        while rest:
            seen |= rest
            rest = {x for other in rest for x in graph[other]} - seen
        return seen

    reach = {module: reached(module) for module in graph}
    return {m: {x for x in reach[m] if m in reach[x]} for m in graph if m in reach[m]}


def test_no_circles():
    """No modules know each other, be it in a function or for types only."""
    assert circle_of({module: set(imported(tree)) - {module, ""} for module, tree in modules().items()}) == {}
    assert circle_of({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == {"b": {"b", "c"}, "c": {"b", "c"}}


def test_what_moves_is_imported_where_something_does():
    """Neither a field, its bridge nor its information comes with what users import: what is still runs none of it."""
    graph = {}
    for module, tree in modules().items():
        body = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom | ast.Try)]
        graph[module] = {x for node in body for x in imported(node)}
    seen, rest = set(), {"cli", "commands.fit", "commands.render", "fisher", "integrator", "plugin", "select", "train"}
    while rest:
        seen |= rest
        rest = {x for module in rest for x in graph[module]} - seen
    assert "tracing.call" in seen
    moving = {"deform", "tracing.field", "information.network"}
    assert {x for x in seen if x in moving or x.startswith("dynamics")} == set()


def test_imports_stand_at_the_top():
    """No import depends on what runs before it: the backend is chosen where the engine is imported."""
    marks = re.compile(r"#\s*(noqa\b.*E402|isort)")
    assert not [path.name for path in PACKAGE.rglob("*.py") if marks.search(path.read_text())]


def test_facade_is_typed():
    """Whatever loads at first access, a type checker knows: its imports name the same."""
    import drgs

    block = next(node for node in modules()[""].body if isinstance(node, ast.If))
    names = {alias.asname or alias.name for node in block.body for alias in node.names}
    assert names == {*drgs._NAMES, *drgs._MODULES}
