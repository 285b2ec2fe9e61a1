"""The report of `drgs crossval` as one HTML file: tables, pictures and maps, nothing outside of it is loaded."""

from __future__ import annotations

import base64
import re

import numpy as np

from drgs.display import pictures
from drgs.lab.image_errors import ErrorRow, error_line

_MEANING = {
    "agreement": "The image and the gradients are the model's.",
    "known deviation": "Gradients differ by choices that are documented.",
    "other convention": "At the conventions found below it agrees; they are not those of the preset.",
    "model difference": "Its image is not the model's: where, and what its error looks like, is below.",
    "undecided": "Gradients differ, and nothing says who is right.",
    "gradient bug": "Gradients of its image, or of one of its paths, are not the derivatives of that image.",
}
_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{{ r.rasterizer }}: {{ r.verdict }}</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; margin: .6rem 0 1.4rem }
td, th { padding: .25rem .7rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: top }
td:first-child, th:first-child, td.text { text-align: left }
img { image-rendering: pixelated; width: 100%; max-width: 24rem; margin: 0 .4rem .4rem 0 }
figure { display: inline-block; margin: 0; width: 24rem; max-width: 100% } figcaption { color: #555 }
.bad { color: #b00020; font-weight: 600 } .good { color: #13693a } .odd { color: #8a5a00; font-weight: 600 }
code { background: #f3f3f3; padding: 0 .25rem }
</style>
<h1>{{ r.rasterizer }}: <span class="{{ color(r.verdict) }}">{{ r.verdict }}</span></h1>
<p>{{ meaning[r.verdict] }} Compared with preset <code>{{ r.preset }}</code> by {{ r.reference }} on
{{ r.gaussians }} Gaussians, {{ r.cameras | length }} views of {{ r.size[0] }}x{{ r.size[1] }} pixels, background
{{ r.background }}. Scene {{ r.scene }}; cameras {{ r.source }}.</p>
{% for line in r.scope %}<p>{{ line }}.</p>
{% endfor %}
<h2>Conventions</h2>
{% if r.conventions %}
<table><tr><th>convention</th><th>preset</th><th>rasterizer</th><th>RMS without it</th><th>RMS with all</th></tr>
{% for c in r.conventions %}<tr><td class="odd">{{ c.name }}</td><td class="text">{{ c.expected }}</td>
<td class="text">{{ c.found }}</td><td>{{ num(c.without) }}</td><td>{{ num(c.with_it) }}</td></tr>{% endfor %}</table>
{% else %}<p>None that differs was found.</p>{% endif %}

<h2>Image</h2>
<p>Differences to the model at the conventions above. Pixels that differ by more than 0.001 hang on a cut-off or on the
order of near ties; where they are few they are left out of the gradients.</p>
<table><tr><th>view</th><th>RMS</th><th>largest</th><th>pixels off by &gt; 0.001</th><th>RMS of alpha</th>
<th>mean of alpha</th><th>worst pixels (x, y)</th></tr>
{% for v in r.image.views %}<tr><td>{{ v.view }}</td><td>{{ num(v.rms) }}</td><td>{{ num(v.max) }}</td>
<td>{{ "%.2f" | format(100 * v.share) }} %</td><td>{{ num(v.alpha.rms) }}</td>
<td>{{ "%+.1e" | format(v.alpha.bias) }}</td>
<td class="text">{% for w in v.worst[:3] %}({{ w.x }}, {{ w.y }}): {{ num(w.difference) }}{{ ", " if not loop.last }}
{% endfor %}</td></tr>{% endfor %}</table>
{% for line in errors %}<p><span class="odd">view {{ line }}.</span></p>
{% endfor %}
{% for row in images %}<div>{% for name, data in row %}<figure><img src="data:image/png;base64,{{ data }}" alt="">
<figcaption>{{ name }}</figcaption></figure>{% endfor %}</div>{% endfor %}

<h2>Gradients</h2>
<p>Of &lt;u, image&gt; with random signs u, by raw parameter. The relative difference is in the L2 norm; the bias is how
much too long the gradient is along the model's; tolerance {{ num(r.tolerance) }}.</p>
<table><tr><th>group</th><th>verdict</th><th>relative</th><th>cosine</th><th>bias</th><th>largest</th><th>why</th>
<th>worst Gaussians</th></tr>
{% for name, g in r.groups.items() %}<tr><td>{{ name }}</td><td class="text {{ color(g.verdict) }}">{{ g.verdict }}</td>
<td>{{ num(g.relative) }}</td><td>{{ "%.6f" | format(g.cosine) }}</td><td>{{ "%+.2g" | format(g.bias) }}</td>
<td>{{ num(g.max) }}</td><td class="text">{{ g.why }}</td>
<td class="text">{% if g.relative > r.tolerance and name != "viewmats" %}
{{ g.worst[:3] | map(attribute="gaussian") | join(", ") }}{% endif %}
</td></tr>{% endfor %}</table>
{% for name, g in r.groups.items() if g.differences %}
<h3>{{ name }}: its own central differences</h3>
<p>{{ g.differences.entries | length }} entries converged with the square of the step, {{ g.differences.left_out }} did
not and are left out, with {{ g.differences.pixels_left_out }} pixels at cut-offs; relative difference
{{ num(g.differences.relative) }}.</p>
<table><tr><th>entry</th><th>gradient</th><th>central difference</th><th>its uncertainty</th></tr>
{% for i in g.differences.entries %}<tr><td>{{ i }}</td><td>{{ "%.5g" | format(g.differences.gradient[loop.index0]) }}
</td><td>{{ "%.5g" | format(g.differences.central[loop.index0]) }}</td>
<td>{{ num(g.differences.uncertainty[loop.index0]) }}</td></tr>{% endfor %}</table>{% endfor %}
{% if r.paths %}<h2>Paths</h2>
<p>Ways to an image that have code of their own. Each is compared with the model, or with plain calls of the rasterizer
that amount to the same.</p>
<table><tr><th>path</th><th>status</th><th>why</th><th>what would test it</th></tr>
{% for p in r.paths %}<tr><td>{{ p.path }}</td><td class="text {{ status[p.status] }}">{{ p.status }}</td>
<td class="text">{{ p.why }}</td><td class="text">{{ p.how }}</td></tr>
{% endfor %}</table>{% endif %}
{% if ladder %}<h2>From this model to the exact one</h2>
<p>One approximation is switched at a time, in the order of the rows / in its reverse as far as there is such a model.
RMS and largest difference of each step of the image; its share of the whole difference, of the image and of each
group's gradient. Shares add up to 100 %; a negative one makes up for another.</p>{{ ladder }}{% endif %}
<h2>Settings</h2><table>{% for k, v in r.settings.items() %}<tr><td>{{ k }}</td><td class="text">{{ v }}</td></tr>
{% endfor %}</table></html>
"""


def html(report: dict, images: list[dict], ladder: str = "") -> str:
    """The page.

    Args:
        report: The `report` of a `drgs.lab.crossval.Result`, with `scene` and `source`.
        images: The `images` of that result: a dict a view of (H, W, 3) arrays.
        ladder: Table of the ladder in Markdown, its cells without markup.
    """
    from jinja2 import Environment
    from markupsafe import Markup

    environment = Environment(autoescape=True)
    rows = []
    for view, row in zip(images, report["image"]["views"], strict=True):
        maps = {
            f"{row['view']}: rasterizer": view["rasterizer"],
            "model at its conventions": view["model"],
            "difference to the model": _difference(view["rasterizer"], view["model"]),
            "exact": view["exact"],
            "difference to exact": _difference(view["rasterizer"], view["exact"]),
        }
        rows.append([(name, base64.b64encode(pictures.png_bytes(x)).decode()) for name, x in maps.items()])
    return environment.from_string(_PAGE).render(
        r=report,
        images=rows,
        errors=[
            f"{view['view']}: {error_line(ErrorRow(**view['error']), report['size'])}"
            for view in report["image"]["views"]
            if view["error"]
        ],
        ladder=Markup(_table(ladder)),
        meaning=_MEANING,
        num=lambda x: f"{x:.1e}",
        status={"agrees": "good", "wrong": "bad", "not tested": "odd"},
        color=lambda verdict: {"agreement": "good", "gradient bug": "bad"}.get(verdict, "odd"),
    )


def _difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return pictures.map_picture(np.abs(a - b).max(-1))


def _table(markdown: str) -> str:
    """Tables and paragraphs of Markdown as HTML."""
    from markupsafe import escape

    parts: list[str] = []
    head = True
    for line in markdown.splitlines():
        cells = re.split(r"(?<!\\)\|", line.strip().removeprefix("|").removesuffix("|"))
        cells = [str(escape(cell.strip().replace("`", "").replace("\\|", "|"))) for cell in cells]
        if not line.startswith("|"):
            if parts and parts[-1].endswith("</tr>"):
                parts.append("</table>")
            parts.append(f"<p>{escape(line)}</p>" if line.strip() else "")
            head = True
        elif set(line) <= set("|-: "):
            continue
        else:
            tag = "th" if head else "td"
            row = "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>"
            parts.append(("<table>" if head else "") + row)
            head = False
    return "\n".join(parts) + ("</table>" if parts and parts[-1].endswith("</tr>") else "")
