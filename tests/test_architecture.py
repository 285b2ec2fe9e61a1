"""The house: rooms import downward and never each other, and nobody inside walks through the front door."""

from __future__ import annotations

import ast
import functools
import graphlib
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.core

PACKAGE = Path(__file__).parents[1] / "drgs"

# From the ground up: each room, a folder or a module of the package's own, with what it is for. A room may import rooms
# of lower floors, and of its own floor as long as none of these comes back to it.
FLOORS: list[dict[str, str]] = [
    {
        "checks": "refuses arguments in one line, and finds what users name: tables, functions of other packages",
        "runtime": "what computes: libLLVM, the backend of Dr.Jit, its threads, memory, the machine",
        "io": "files: whole or not at all, one writer, read without belief; journals and run folders",
        "display": "progress, tables, pictures and films",
    },
    {
        "settings": "every choice of the renderer, and the presets",
        "cameras": "cameras, their lenses, shutters, sizes, and their checks",
        "ellipsoids": "Gaussians, and what a scene is",
        "splats": "both as tensors that a splatting rasterizer takes",
        "dynamics": "a field of planes and lifespans",
        "deform": "Gaussians that this field moves, for users",
    },
    {
        "oracle": "images in float64 by brute force; it knows nothing of the engine that it checks",
        "reference": "the oracle, for users",
        "codecs": "Gaussians in files, 3DGS PLY and the formats of others",
        "files": "PLY, checkpoints and run folders, for users",
        "features": "teacher's maps, their decoder, labels, queries",
        "data": "photographs and their cameras, from disk",
        "sfm": "poses and points of photographs",
        "scenes": "data sets that are path traced",
    },
    {
        "tracing": "the engine: projection, traversals, compositing, its derivatives",
        "integrator": "rendering, from torch",
        "rasterize": "rendering, under gsplat's names",
        "plugin": "rendering, from Mitsuba",
    },
    {
        "information": "what a view says about each parameter, and how that becomes a score",
        "fisher": "information of views, for users",
        "gain": "scores, for users",
        "selection": "chooses among views: the pool, greedy choice, policies",
        "select": "selection, for users",
    },
    {
        "fitting": "fits: configuration, trainer, components, measurement",
        "train": "fits, for users",
        "pruning": "fewer Gaussians for nearly the same images, for users",
        "meshing": "a surface, cut to what information determines",
        "lab": "experiments on rasterizers: crossval, ladder, tradeoff, stress",
        "testing": "crossval as an assertion, for users",
    },
    {
        "viewing": "a scene in the browser",
        "pages": "a fit, or a scene, as one HTML page",
        "capturing": "photographs to a page and the next photographs, step by step",
        "planner": "where a robot looks next, for users",
        "studies": "many fits, and what they say together",
        "cluster": "the same work in other processes",
    },
    {
        "commands": "options in, files out: one module a command",
        "cli": "which command it is",
    },
]

# Rooms that may `import drgs`.
FACADE = {"cli": "the program", "runtime": "`__version__`, which the package states there"}

# Cases of `make check`, which must end within 120 s on two cores: 1,160 of them, beside ruff and mypy, take about that.
# A new case of this mark takes the place of others that take as long.
CORE = 1_200


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
    """Modules that any statement of a tree imports, be it in a function or for types only; ``""`` is the facade."""
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


@functools.cache
def rooms() -> dict[str, dict[str, str]]:
    """Room -> rooms that it imports, and one of its modules that does so."""
    graph: dict[str, dict[str, str]] = {}
    for module, tree in modules().items():
        room = module.partition(".")[0]
        if room not in ("", "__main__"):
            others = {name.partition(".")[0]: module for name in imported(tree)}
            graph.setdefault(room, {}).update({x: by for x, by in others.items() if x not in ("", room)})
    return graph


def test_rooms_do_not_import_each_other():
    """No two rooms know each other, directly or through others, be it in a function or for types only."""
    try:
        graphlib.TopologicalSorter(rooms()).prepare()
    except graphlib.CycleError as error:
        circle = error.args[1][::-1]
        steps = [f"{rooms()[a][b]} imports {b}" for a, b in zip(circle, circle[1:], strict=False)]
        pytest.fail(f"rooms must not import each other: {'; '.join(steps)}")


def test_eight_floors():
    """Each room stands on one of at most eight floors, and imports none from above."""
    floor = {room: number for number, entries in enumerate(FLOORS) for room in entries}
    assert len(FLOORS) <= 8
    assert sum(map(len, FLOORS)) == len(floor)
    assert set(floor) == set(rooms()), "a room has a row of FLOORS, and a row a room"
    assert not [
        (by, other) for room, others in rooms().items() for other, by in others.items() if floor[other] > floor[room]
    ]


def test_make_check_keeps_its_budget(request):
    """What runs before each commit takes two minutes."""
    if request.config.option.markexpr == "core":
        assert len(request.session.items) <= CORE


def test_commands_are_imported_by_the_program_only():
    """What a command does is its module's business: nothing but the program and other commands starts from there."""
    assert {room for room, others in rooms().items() if "commands" in others} == {"cli"}


def test_nobody_imports_the_facade():
    """Inside, the module that is needed is imported, so that a name has one home."""
    users = {module.partition(".")[0] for module, tree in modules().items() if "" in set(imported(tree))}
    assert users == set(FACADE)


def test_what_moves_is_imported_where_something_does():
    """Neither a field nor its information comes with what users import: what is still pays for none of it."""
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
    assert moving <= set(graph)
    assert {x for x in seen if x in moving or x.startswith("dynamics")} == set()


def test_facade_is_typed():
    """Whatever loads at first access, a type checker knows: its imports name the same."""
    import drgs

    block = next(node for node in modules()[""].body if isinstance(node, ast.If))
    names = {alias.asname or alias.name for node in block.body for alias in node.names}
    assert names == {*drgs._NAMES, *drgs._MODULES}
