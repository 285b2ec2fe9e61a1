"""A frame of a pinhole camera on tiles, by steps that are recorded (recordings.py): images, and their gradients.

What `Call.prepare` and `Composite` do by Dr.Jit's AD, in a few functions of arrays: the projection with the boxes on
the screen, the compositing, and the adjoint of both. In between, lists and rows are sorted, which needs no tracing.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import drjit as dr

from drgs import runtime
from drgs.settings import RenderSettings
from drgs.tracing import projection, tiles
from drgs.tracing.arrays import Float, Lib, UInt32, UInt64
from drgs.tracing.composite import Compositor
from drgs.tracing.kernels import HitModel, HitNumbers, numbers_of
from drgs.tracing.primitives import Projected
from drgs.tracing.recordings import padded, replay
from drgs.tracing.records import RECORD, pack_records
from drgs.tracing.rows import MemoryBudget, SortedRows, found_hits, sort_rows
from drgs.tracing.sort_keys import ascending, compacted
from drgs.tracing.walk import Part, pixels_a_lane
from drgs.tracing.weights import PIXELS, signed


class View(NamedTuple):
    """What the steps of a frame depend on besides arrays.

    Attributes:
        settings: Those of the render with a black background, which is an array.
        response: That of the settings.
        width, height: Size of the image, in pixels.
        coefficients: SH coefficients of a Gaussian and channel.
        want: Extra outputs: `depth`, `median`, `count`.
        needed: Names of the inputs that gradients are wanted by.
    """

    settings: RenderSettings
    response: Any
    width: int
    height: int
    coefficients: int
    want: frozenset
    needed: tuple[str, ...]


class Frame:
    """Images of a view, and their gradients by its inputs.

    Args:
        view: Of which settings, size and outputs.
        settings: With the background.
        pinhole: (fx, skew, cx, fy, cy).
        inputs: Flat arrays without a graph: raw parameters and `w2c`.
    Attributes:
        images: Flat images by name, without those of `extra`.
        extra: Outputs without a derivative.
        certificate: That of `Output`.
        banded: The compositor of rows that were made and sorted band by band; None: there is one band.
    """

    def __init__(self, view: View, settings: RenderSettings, pinhole: tuple[float, ...], inputs: dict) -> None:
        lib = runtime.dr_types()
        self.view = view
        chosen = runtime.backend().variant
        wide, narrow = _pinhole(chosen, pinhole)
        self.given = {"inputs": inputs, "pinhole": wide}
        found = replay(_projected, view, self.given)
        lists = self._lists(lib, found)
        self.seen = {
            "record": found["record"],
            "index": lists.index,
            "start": lists.start,
            "end": lists.end,
            "pinhole": narrow,
            "numbers": list(_numbers(chosen, settings)),
        }
        self.certificate: dict = {"pairs": lists.pairs}
        self.banded: Compositor | None = None
        if view.settings.order == "ray":
            self.certificate |= {"rays": view.width * view.height, "redone": 0}  # rows hold every hit
            if not tiles.is_one_band(dr.width(lists.index)):
                self._take(self._composited_in_bands(lists))
                return
            self._sort_hits(lists)
        out, self.finals = replay(_composited, view, self.seen)
        self._take(out)

    def _take(self, out: dict) -> None:
        """Keep images apart from what has no derivative."""
        self.extra = {name: out.pop(name) for name in ("median", "count") if name in out}
        self.images = out

    def _lists(self, lib: Lib, found: dict) -> tiles.Lists:
        """The lists of tiles, with an index as long as `padded` says."""
        view = self.view
        words = found.pop("words", None)
        seen, pairs = int(found.pop("seen")[0]), int(found.pop("pairs")[0])
        tested = tiles.is_tested(pairs, seen)
        if tested is None or not pairs:
            return self._lists_by_blocks(lib, found, words, seen)
        what = f"({dr.width(found['amount'])} Gaussians, {view.width}x{view.height} pixels)"
        tiles.check_pairs(pairs, what)
        ordered = {} if words is None else {"words": ascending(lib, words)}
        keys = replay(_keys, (view, padded(pairs), tested), found | ordered)
        keys, count = compacted(lib, keys, tiles.NO_KEY, None if tested else pairs)
        keys = ascending(lib, keys)
        trims = tiles.is_trimmed(view.settings) and not view.want & {"depth", "count"}
        cut = None
        if trims and count:
            keys, cut = replay(_remaining, view, {"keys": keys, "record": found["record"]})
            keys, count = compacted(lib, keys, tiles.NO_KEY)
        index, start, end = replay(_lists, (view, dr.width(found["amount"])), {"keys": keys} | ordered)
        return tiles.Lists(index, start, end, *_tiles(view), count, cut)

    def _lists_by_blocks(self, lib: Lib, found: dict, words: UInt64 | None, seen: int) -> tiles.Lists:
        """The same where boxes are so large that blocks of tiles are tested first, which is not recorded; or empty."""
        view = self.view
        order = dr.arange(lib.UInt32, dr.width(found["amount"]))
        if words is not None:
            order = lib.UInt32(ascending(lib, words) & 0xFFFFFFFF)
            dr.eval(order)
        boxes = found["amount"], found["x"], found["y"]
        lists = tiles.listed(lib, view.settings, view.width, view.height, found["record"], order, *boxes, seen)
        if tiles.is_trimmed(view.settings) and not view.want & {"depth", "count"} and lists.pairs:
            lists = tiles.shorter(lib, lists, view.settings, found["record"], dr.width(order))
        entries = dr.width(lists.index)
        entry = dr.minimum(dr.arange(lib.UInt32, padded(entries)), dr.opaque(lib.UInt32, entries - 1))
        lists.index = dr.gather(lib.UInt32, lists.index, entry)
        dr.eval(lists.index)
        return lists

    def _sort_hits(self, lists: tiles.Lists) -> None:
        """Find and sort the hits of each pixel."""
        cut = {} if lists.cut is None else {"cut": lists.cut}
        words, start, count = replay(_hits, self.view, self.seen | cut)
        sort_rows(words.torch(), signed(lists.end - lists.start).long(), signed(count).view(-1, PIXELS))
        self.seen |= {"words": words, "first": start, "count": count}

    def _composited_in_bands(self, lists: tiles.Lists) -> dict:
        """Images of so many hits that their rows are made and sorted band by band, which is not recorded."""
        compositor = _compositor(self.view, self.seen)
        view: Any = compositor.traversal
        view.lists.cut = lists.cut
        view.budget = MemoryBudget(tiles.order_bytes() if self.view.needed else 0)
        compositor.parts = view.parts(1)
        self.banded = compositor
        return _images(self.view, compositor)

    def compositor(self) -> Compositor:
        """The compositor after `forward`, with the final states of its rays; of a view whose gradients are needed."""
        return self.banded or composited(self.view, self.seen, self.finals)

    def gradients(self, cotangents: dict) -> dict:
        """Gradients by the inputs that are needed, flat, by name.

        Args:
            cotangents: Flat, by name of the image.
        """
        if self.banded is not None:
            record = self.banded.adjoint(cotangents)["record"]
            dr.eval(record)
            return replay(_unprojected, self.view, self.given | {"slopes": record})
        return replay(_gradients, self.view, self.given | {"seen": self.seen, "finals": self.finals, "g": cotangents})


@functools.lru_cache(maxsize=64)
def _numbers(variant: str, settings: RenderSettings) -> HitNumbers:
    """Opaque numbers of settings."""
    made = numbers_of(runtime.dr_types(), settings)
    dr.eval(made)
    return made


@functools.lru_cache(maxsize=64)
def _pinhole(variant: str, pinhole: tuple[float, ...]) -> tuple[list[Float], list[Float]]:
    """Opaque Float64 of a pinhole, for the projection, and Float, for rays."""
    lib = runtime.dr_types()
    wide = [dr.opaque(lib.Float64, x) for x in pinhole]
    narrow = [lib.Float(x) for x in wide]
    dr.eval(wide, narrow)
    return wide, narrow


# Steps: functions of a view and arrays.


def projected(view: View, inputs: dict, pinhole: list[Float]) -> Projected:
    """The Gaussians on the screen, with the graph of the inputs.

    Args:
        inputs: Those of a `Frame`.
        pinhole: Float64, as in its `given`.
    """
    given = runtime.dr_types(), inputs, inputs["w2c"], pinhole, view.settings
    return projection.project_screen(*given, view.width, view.height, view.coefficients)


def _projected(view: View, a: dict) -> dict:
    """Records, boxes on the screen, and the words that sort Gaussians by their centers."""
    lib = runtime.dr_types()
    found = projected(view, a["inputs"], a["pinhole"])
    record = pack_records(lib, found.record)
    seen, amount, x, y = tiles.screen_boxes(lib, found, view.width, view.height)
    seen = dr.select(seen, lib.UInt32(1), lib.UInt32(0))
    out = {"record": record, "amount": amount, "x": list(x), "y": list(y)}
    if view.settings.order != "ray":
        out["words"] = tiles.depth_words(lib, found.key, dr.arange(lib.UInt32, dr.width(amount)))
    dr.eval(out, seen)
    return out | {"seen": dr.sum(seen), "pairs": dr.sum(lib.UInt64(amount))}


def _tiles(view: View) -> tuple[int, int]:
    """Columns and rows of tiles."""
    return -(-view.width // tiles.TILE), -(-view.height // tiles.TILE)


def _order(lib: Lib, a: dict, count: int) -> UInt32:
    """Gaussians in the order of the lists."""
    return lib.UInt32(a["words"] & 0xFFFFFFFF) if "words" in a else dr.arange(lib.UInt32, count)


def _keys(what: tuple[View, int, bool], a: dict) -> UInt64:
    """Keys of pairs of a tile and a Gaussian, for no fewer pairs than there are; tested, if they are."""
    lib = runtime.dr_types()
    view, pairs, is_tested = what
    order = _order(lib, a, dr.width(a["amount"]))
    boxes = a["amount"], a["x"], a["y"]
    columns, _ = _tiles(view)
    return tiles.keys_of_boxes(lib, view.settings, columns, a["record"], order, *boxes, pairs, is_tested)


def _lists(what: tuple[View, int], a: dict) -> tuple[UInt32, UInt32, UInt32]:
    """Entries of all lists, and of each tile the first and the one behind the last."""
    lib = runtime.dr_types()
    view, count = what
    lists = tiles.lists_of_keys(lib, a["keys"], _order(lib, a, count), *_tiles(view))
    return lists.index, lists.start, lists.end


def _remaining(view: View, a: dict) -> tuple[UInt64, Float]:
    """Keys without those whose tails a tile need not look at, and what is taken off squared extents there."""
    lib = runtime.dr_types()
    count = dr.width(a["record"]) // RECORD
    lists = tiles.lists_of_keys(lib, a["keys"], _order(lib, a, count), *_tiles(view))
    dr.eval(lists.start, lists.end)
    cut, mask = tiles.remaining(lib, lists, view.settings, a["record"], count)
    return dr.select(mask & (a["keys"] != tiles.NO_KEY), a["keys"], tiles.NO_KEY), cut


def _compositor(view: View, a: dict) -> Compositor:
    """The compositor of what was projected and listed, without parts."""
    lib = runtime.dr_types()
    size = view.width, view.height
    seen = tiles.TileTraversal(lib, view.settings, None, a["pinhole"], *size, False)
    model = HitModel(lib, view.settings, numbers=HitNumbers(*a["numbers"]))
    lists = tiles.Lists(a["index"], a["start"], a["end"], *_tiles(view), dr.width(a["index"]))
    seen.look(model, a["record"], [], 0, lists)
    compositor = Compositor(lib, view.settings, seen, view.want, model=model)
    compositor.ready({"record": a["record"]}, RECORD)
    return compositor


def _whole(view: View, a: dict) -> Compositor:
    """The compositor with all pixels as one part."""
    compositor = _compositor(view, a)
    seen: Any = compositor.traversal
    if view.settings.order != "ray":
        compositor.parts = seen.parts(pixels_a_lane())
        return compositor
    lib = compositor.lib
    rows = SortedRows(lib, a["index"], a["first"], a["first"] + a["count"], a["words"])
    compositor.parts = [seen.whole_band(1, rows)]
    return compositor


def composited(view: View, seen: dict, finals: list) -> Compositor:
    """The compositor of a frame: as it is after `forward`.

    Args:
        view, seen, finals: Those of the `Frame`; no other arrays are read.
    """
    compositor = _whole(view, seen)
    compositor.finals = [[(compositor.parts[0], finals)]]
    return compositor


def _hits(view: View, a: dict) -> tuple[Float, UInt32, UInt32]:
    """Words of all hits, and where the row of each pixel starts and how many it has."""
    seen: Any = _compositor(view, a).traversal
    part: Part = seen.whole_band(pixels_a_lane())
    return found_hits(seen.lib, part, dr.width(a["start"]), a.get("cut"))


def _images(view: View, compositor: Compositor) -> dict:
    """Flat images, and what the adjoint needs is left in the compositor."""
    keep = {"replay"} if view.needed else set()
    return compositor.composited(frozenset(view.want | keep))


def _composited(view: View, a: dict) -> tuple[dict, list]:
    """Flat images, and final states of the rays if gradients are needed."""
    compositor = _whole(view, a)
    out = _images(view, compositor)
    ((_, states),) = compositor.finals[0]
    return out, states if view.needed else []


def _gradients(view: View, a: dict) -> dict:
    """Gradients by inputs."""
    slopes = composited(view, a["seen"], a["finals"]).adjoint(a["g"])["record"]
    return _unprojected(view, a | {"slopes": slopes})


def _unprojected(view: View, a: dict) -> dict:
    """Gradients by inputs from those by the columns of the records."""
    with dr.resume_grad():
        p = dict(a["inputs"])
        ends = {name: type(p[name])(p[name]) for name in view.needed}
        dr.enable_grad(ends)
        p |= ends
        found = projected(view, p, a["pinhole"])
        reached = [(x, slope) for x, slope in zip(found.record, a["slopes"], strict=False) if dr.grad_enabled(x)]
        for x, slope in reached:
            dr.set_grad(x, slope)
        dr.enqueue(dr.ADMode.Backward, [x for x, _ in reached])
        dr.traverse(dr.ADMode.Backward)
        return {name: dr.grad(x) + dr.zeros(type(x), dr.width(x)) for name, x in ends.items()}
