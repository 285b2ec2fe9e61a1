"""The page of a run: what is on it, that it is whole by itself, that nothing in a file becomes markup, and its file."""

from __future__ import annotations

import base64
import html.parser
import json
import re
import shlex
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_active import write_still
from test_dynamic_fit import _small_field, blobs, made  # noqa: F401 (a fixture)
from test_dynamic_fit import config as moving_config
from test_semantic_fit import SHORT, dataset, taught  # noqa: F401 (fixtures)
from test_train import config as short_config

from drgs import cli
from drgs.cameras import orbit
from drgs.commands.report import fit_command, report_of
from drgs.display.pictures import file_names
from drgs.files import Run
from drgs.fitting.config import FitConfig, SelectionConfig
from drgs.fitting.resume import lock_run
from drgs.information.prior import Prior
from drgs.pages.report import pictures
from drgs.pages.report.account import account_of
from drgs.settings import RenderSettings
from drgs.train import fit


class Page(html.parser.HTMLParser):
    """What a browser would make of a page: tags with their attributes, and the text of each kind."""

    def __init__(self, path: Path):
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.texts: dict[str, str] = {}
        self._open: list[str] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "input"):
            self._open.append(tag)

    def handle_endtag(self, tag):
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data):
        if self._open:
            self.texts[self._open[-1]] = self.texts.get(self._open[-1], "") + data

    def all(self, tag: str) -> list[dict]:
        """Attributes of the tags of a name."""
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def sections(self) -> set[str]:
        """Ids of the headings."""
        return {attributes["id"] for attributes in self.all("h2")}


@pytest.fixture(scope="module")
def active(tmp_path_factory):
    """The run of an active fit by the command line: two views, two more picked by information, measured on the way."""
    folder = tmp_path_factory.mktemp("active")
    write_still(folder / "data")
    line = f"fit {folder / 'data'} -o {folder / 'run'} --views active --add 2 --every 4 --max-steps 16 --test-every 4"
    assert cli.main(f"{line} --max-gaussians 60 --sh-degree 1 --measure 3 --quiet".split()) == 0
    return folder / "run"


@pytest.fixture
def run(active, tmp_path):
    """A copy that a test may change."""
    return Path(shutil.copytree(active, tmp_path / "run"))


def edited(path: Path, change) -> None:
    """A JSON file after `change` of its value."""
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def page_of(run: Path, tmp_path: Path) -> Page:
    """The page that `drgs report` makes of a run."""
    assert cli.main(["report", str(run), "-o", str(tmp_path / "page.html"), "--quiet"]) == 0
    return Page(tmp_path / "page.html")


def test_a_fit_ends_with_its_report(active):
    """All sections, every view and pick, the numbers of metrics.json; pictures are JPEGs of the stated size."""
    page, metrics = Page(active / "report.html"), json.loads((active / "metrics.json").read_text())
    assert page.sections == {"fit", "views", "renderers", "cameras", "time-spent", "repeat"}
    assert f"{metrics['mean']['psnr']:.2f} dB" in page.texts["b"]
    cells = page.texts["td"]
    for row in metrics["views"]:
        assert f"{row['psnr']:.2f}" in cells
    selection = json.loads((active / "selection.json").read_text())
    assert len(selection["picks"]) == 2
    assert all(f"{pick['score']:.4g}" in cells for pick in selection["picks"])
    assert f"{selection['measured'][0]['mean']['psnr']:.3f}" in cells
    assert len(page.all("svg")) == 3
    images = page.all("img")
    assert len(images) >= 3 * len(metrics["views"])
    for attributes in images:
        kind, _, data = attributes["src"].partition(",")
        assert kind == "data:image/jpeg;base64"
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape[1::-1] == (int(attributes["width"]), int(attributes["height"]))


def test_nothing_is_loaded_from_outside(active):
    """No tag names another place, and the browser is told to run nothing but the page's own script."""
    page, text = Page(active / "report.html"), (active / "report.html").read_text()
    for tag, attributes in page.tags:
        for name in ("src", "href", "xlink:href", "data", "action"):
            assert attributes.get(name, "#").startswith(("#", "data:image/jpeg;base64,")), (tag, name)
    assert not page.all("link")
    assert not re.search(r"@import|url\((?!#)", text)
    policy = next(x["content"] for x in page.all("meta") if x.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'")
    assert "script-src 'sha256-" in policy


def test_charts_share_no_ids(active):
    """Two drawings of one page with the same id would clip each other."""
    drawings = re.findall(r"<svg.*?</svg>", (active / "report.html").read_text(), re.DOTALL)
    used = [set(re.findall(r'xlink:href="#(\w+)"|url\(#(\w+)\)', x)) for x in drawings]
    ids = [{a or b for a, b in found} for found in used]
    assert all(not a & b for i, a in enumerate(ids) for b in ids[:i])


@pytest.mark.every(3)
@pytest.mark.parametrize("name", ["<script>alert(1)</script>", "$\\frac{", '" onload="x', "a" * 300], ids=str)
def test_names_are_text(run, tmp_path, name):
    """Whatever a file calls a view, the run or a parameter, a page shows, and makes nothing else of it."""
    before = Page(run / "report.html")

    def rename(metrics):
        old = file_names([row["name"] for row in metrics["views"]])[0]
        metrics["views"][0]["name"] = metrics["variants"][name] = name
        new = file_names([row["name"] for row in metrics["views"]])[0]
        (run / f"renders/test/{old}.png").rename(run / f"renders/test/{new}.png")

    edited(run / "metrics.json", rename)
    edited(run / "env.json", lambda env: env.update({"cpu": name, name: name}))

    def tell(selection):
        selection["picks"][0]["name"], selection["picks"][0]["policy"] = name, name
        selection["picks"][0]["parts"][name] = 1.0

    edited(run / "selection.json", tell)
    page = page_of(run, tmp_path)
    assert len(page.all("script")) == len(before.all("script")) == 1
    assert not any("onload" in attributes for _, attributes in page.tags)
    assert name in page.texts["td"]


def test_what_is_not_there_is_left_out(run, tmp_path, caplog):
    """Without the data set, pictures, metrics or a checkpoint there is a page all the same, which says so."""
    (run.parent / "gone").mkdir()
    edited(run / "config.json", lambda config: config.update(data=str(run.parent / "gone")))
    shutil.rmtree(run / "renders")
    page = page_of(run, tmp_path)
    assert "the report goes without the data set's cameras" in caplog.text
    assert "no map of cameras" in page.texts["p"]
    assert page.sections == {"fit", "views", "renderers", "cameras", "time-spent", "repeat"}
    assert not page.all("img")
    for name in ("metrics.json", "state.safetensors", "point_cloud.ply", "log.jsonl", "env.json"):
        (run / name).unlink()
    page = page_of(run, tmp_path)
    assert "has not reached its first checkpoint" in page.texts["p"]
    assert page.sections == {"cameras", "time-spent", "repeat"}


def test_what_a_capture_found(run, tmp_path, capsys):
    """Findings of the last photographs stand on the page, as text; a damaged record of a capture is named."""
    found = {"kind": "direction", "text": "the left of <b>IMG_1</b>: expected error 0.12", "advice": "take one"}
    batches = [{"findings": [{"kind": "blur", "text": "all", "advice": "again"}]}, {"findings": [found]}]
    (run / "capture").mkdir()
    (run / "capture" / "capture.json").write_text(json.dumps({"batches": batches}))
    page = page_of(run, tmp_path)
    assert "findings" in page.sections
    assert "the left of <b>IMG_1</b>: expected error 0.12; take one" in page.texts["li"]
    assert "again" not in page.texts["li"]
    (run / "capture" / "capture.json").write_text(json.dumps({"batches": [{"findings": [{"text": 3}]}]}))
    assert cli.main(["report", str(run), "-o", str(tmp_path / "page.html")]) == 2
    assert re.search(r"capture\.json: .*text", capsys.readouterr().err)


def test_without_matplotlib(run, tmp_path, monkeypatch, caplog):
    """No chart; a line before the work and the page say how to get them."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    page = page_of(run, tmp_path)
    assert "no charts will be drawn: matplotlib is not installed; pip install 'drgs[report]'" in caplog.text
    assert not page.all("svg")
    assert "pip install 'drgs[report]'" in page.texts["p"]


@pytest.mark.parametrize(
    ("file", "change", "expected"),
    [
        ("metrics.json", lambda x: x["views"][0].update(psnr="best"), r"metrics\.json: psnr must be a finite number"),
        ("metrics.json", lambda x: x.pop("mean"), r"metrics\.json: it must have the key 'mean'"),
        ("selection.json", lambda x: x["picks"][0].update(score=[]), r"selection\.json: picks\[0\]\.score must be"),
        ("selection.json", lambda x: x["picks"][0]["parts"].update(means="?"), r"selection\.json: means must be"),
        ("config.json", lambda x: x["fit"]["selection"].update(every="soon"), r"config\.json: fit: every must be"),
    ],
)
def test_damaged_files_are_named(run, tmp_path, capsys, file, change, expected):
    """One line, and no page."""
    edited(run / file, change)
    assert cli.main(["report", str(run), "-o", str(tmp_path / "page.html")]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert re.search(expected, said)
    assert said.startswith("drgs report:")
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"{", r"log\.jsonl, line \d+: must be valid JSON"),
        (b'{"event": "train", "step": 3, "time": "2026-01-01T00:00:00", "loss": 1}', r"must have the key 'psnr'"),
        (b'{"event": "start", "step": 0, "time": "yesterday"}', r"time must be ISO 8601, got 'yesterday'"),
    ],
)
def test_a_damaged_log_is_named(run, tmp_path, capsys, line, expected):
    """With the number of the line."""
    (run / "log.jsonl").write_bytes((run / "log.jsonl").read_bytes() + line + b"\n")
    assert cli.main(["report", str(run), "-o", str(tmp_path / "page.html")]) == 2
    assert re.search(expected, capsys.readouterr().err)


def test_a_resumed_fit_tells_each_step_once(run):
    """Steps after the checkpoint that a fit went on from are those of the second time; the pause is no time spent."""
    times = [f"2026-01-01T00:00:{s:02d}.000+00:00" for s in (0, 10, 50, 55)]
    row = {"loss": 1.0, "psnr": 9.0, "gaussians": 5, "seconds": 3.0}
    events = [
        {"event": "start", "step": 0, "time": times[0]},
        {"event": "train", "step": 20, "time": times[0], **row},
        {"event": "train", "step": 40, "time": times[1], **row, "loss": 2.0},
        {"event": "resume", "step": 20, "time": times[2]},
        {"event": "train", "step": 40, "time": times[3], **row, "loss": 3.0},
    ]
    (run / "log.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events) + '{"event": "tr')
    account = account_of(Run(run))
    assert [(e["step"], e["loss"]) for e in account.of("train")] == [(20, 1.0), (40, 3.0)]
    assert account.wall == 15.0
    assert account.state == "at 40 of 16 steps"


def test_the_file_is_replaced_only_where_it_is_ours(run, tmp_path, capsys):
    """The run's own page, and one that says so, are; a stranger's stays, in the run as elsewhere."""
    for path, extra in ((run / "report.html", []), (tmp_path / "page.html", ["-o", str(tmp_path / "page.html")])):
        assert cli.main(["report", str(run), *extra, "--quiet"]) == 0
        assert cli.main(["report", str(run), *extra, "--quiet"]) == 0
        path.write_text("<h1>mine</h1>")
        assert cli.main(["report", str(run), *extra]) == 2
        assert "must not be replaced" in capsys.readouterr().err
        assert path.read_text() == "<h1>mine</h1>"
    assert cli.main(["report", str(run), "-o", str(tmp_path / "page.txt")]) == 2
    assert "must be named *.html" in capsys.readouterr().err


def test_the_runs_own_file_by_its_name(run, monkeypatch):
    """`-o RUN/report.html`, however it is spelled, is the page of the run, which goes on."""
    monkeypatch.chdir(run)
    before = (run / "report.html").read_bytes()
    assert cli.main(["report", str(run), "-o", "../run/report.html", "--quiet"]) == 0
    assert (run / "report.html").read_bytes() != before, "by now it has maps of other directions"
    lock_run(Run(run), "fit").release()


def test_whose_photograph_is_used(run, tmp_path):
    """The expected error of held-out views is without their photographs; that of fitted ones is not."""
    words = "this view's photograph is not used"
    assert words in page_of(run, tmp_path).texts["p"]
    assert cli.main(["eval", str(run), "--split", "train", "--quiet"]) == 0
    page = page_of(run, tmp_path)
    assert "Expected error: how far from a photograph" in page.texts["p"]
    assert words not in page.texts["p"]


def test_no_report_is_wanted(tmp_path):
    """--no-report saves the time."""
    write_still(tmp_path / "data")
    line = f"fit {tmp_path / 'data'} -o {tmp_path / 'run'} --max-steps 2 --max-gaussians 20 --no-report --quiet"
    assert cli.main(line.split()) == 0
    assert not (tmp_path / "run/report.html").exists()


def test_a_fit_with_a_teacher(taught, tmp_path):  # noqa: F811
    """Its labels are compared, and each view has a picture of its features and labels."""
    result = fit(taught, tmp_path / "run", short_config(**SHORT, max_steps=20), progress=False)
    report_of(result.run, tmp_path / "page.html", taught)
    page = Page(tmp_path / "page.html")
    assert "labels" in page.sections
    assert f"{result.metrics['segmentation']['run']['miou']:.3f}" in page.texts["td"]
    shown = [x for x in page.all("img") if x["alt"].startswith("labels and features of")]
    assert len(shown) == min(4, result.metrics["count"])


def test_a_fit_of_what_moves(tmp_path):
    """Stills of a held-out camera at the times of the sequence."""
    moving = made(tmp_path / "data")
    result = fit(moving, tmp_path / "run", moving_config(), progress=False)
    report_of(result.run, tmp_path / "page.html", moving)
    page = Page(tmp_path / "page.html")
    assert {"time"} <= page.sections
    stills = [x for x in page.all("img") if x["alt"].startswith("still: time")]
    assert [x["alt"] for x in stills] == ["still: time 0", "still: time 0.5", "still: time 1"]


class Crossing:
    """Blobs of which three go from left to right, as far as they are wide in each half of the time."""

    def at(self, time):
        g = blobs()
        means = g.means.clone()
        means[9:, 0] += 0.7 * time
        return g.replace(means=means)

    def parameters(self):
        return {}


def test_stills_take_the_tolerance_of_pictures(monkeypatch):
    """Of preset `exact`, half a step of 8 bits; other settings stay as they are."""
    taken, draw = [], pictures.render
    monkeypatch.setattr(pictures, "render", lambda *a, **kw: taken.append(a[2]) or draw(*a, **kw))
    camera, exact = orbit((0, 0, 0), 3.0, 1, width=32, height=24)[0], RenderSettings.preset("exact")
    for settings in (exact, FAST):
        pictures.stills(Crossing(), camera, (0.5,), settings)
    assert taken == [exact.replace(tolerance=1 / 512), FAST]


def test_stills_show_their_times():
    """Each is the scene at its time: what a fit of few steps has learned to move can be less than a level of gray."""
    camera = orbit((0, 0, 0), 3.0, 1, width=20, height=16)[0]
    shown = [picture.data for picture in pictures.stills(Crossing(), camera, (0.0, 0.5, 1.0), FAST)]
    alone = [picture.data for time in (0.0, 0.5, 1.0) for picture in pictures.stills(Crossing(), camera, (time,), FAST)]
    assert shown == alone
    assert len(set(shown)) == 3


FAST = RenderSettings.preset("fast")
CONFIGS = [
    FitConfig(),
    FitConfig().replace(
        max_steps=12, sh_degree=1, deterministic=True, seed=7, mask="ignore", selection=SelectionConfig()
    ),
    FitConfig().replace(
        settings=FAST.replace(extent=4.5, background=(1.0, 0.5, 0.25)), grid_rate=(0.1, 1e-5), dc_rate=0.5
    ),
    FitConfig().replace(settings=RenderSettings.preset("gsplat", max_hits=5), test_cameras=("cam00", "cam 07")),
    FitConfig().replace(
        settings=RenderSettings.preset("exact"),
        test_cameras=(),
        couple_features=True,
        policy="random",
        add=3,
        every=5,
        blocks=("geometry", "backdrop"),
        measure=(3, 4),
        prior=Prior(1e-3),
    ),
]


@pytest.mark.parametrize("config", CONFIGS)
def test_the_command_repeats_the_fit(config):
    """The program reads from the line the same fit."""
    line, beyond = fit_command(config, Path("my data"), Path("runs/a b"))
    args = cli._parse_arguments(shlex.split(line)[1:])
    assert args.fit == config
    assert (args.data, args.output) == (Path("my data"), Path("runs/a b"))
    assert not beyond


def test_what_no_option_sets_is_said(run):
    """A fit from Python or a file may have fields that the command line has not."""
    assert fit_command(FitConfig().replace(weights={"sh": 0.5}), run, run)[1] == ['weights={"sh": 0.5}']


# The number of words in tables, and those of them that do not stand on one line.
BROKEN_WORDS = """() => {
  const broken = []; let words = 0;
  for (const cell of document.querySelectorAll("td, th")) {
    const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
      for (const found of walker.currentNode.data.matchAll(/[\\p{L}\\p{N}]+/gu)) {
        const range = document.createRange();
        range.setStart(walker.currentNode, found.index);
        range.setEnd(walker.currentNode, found.index + found[0].length);
        words += 1;
        if (new Set([...range.getClientRects()].map(x => Math.round(x.top))).size > 1) broken.push(found[0]);
      }
    }
  }
  return [words, broken];
}"""


def test_in_a_browser(active, tmp_path):
    """It loads without a word on the console and asks for nothing; a phone does not scroll sideways; it prints."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page, said = browser.new_page(viewport={"width": 360, "height": 740}), []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: said.append(request.url))
        url = (active / "report.html").as_uri()
        page.goto(url)
        assert [text for text in said if not text.startswith("data:")] == [url]
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        sizes = page.evaluate("[...document.images].map(x => [x.complete, x.naturalWidth])")
        assert sizes
        assert all(complete and width > 0 for complete, width in sizes)
        shown = lambda: page.locator(".slider").first.locator("figure.now figcaption").inner_text()  # noqa: E731
        assert shown() == "step 16"
        page.locator(".slider input").first.evaluate("x => { x.value = 0; x.dispatchEvent(new Event('input')) }")
        assert shown() != "step 16"
        assert len(page.pdf(format="A4")) > 10_000
        page.set_viewport_size({"width": 400, "height": 800})
        page.evaluate("document.querySelectorAll('details').forEach(x => { x.open = true })")
        words, broken = page.evaluate(BROKEN_WORDS)
        assert words > 50
        assert broken == []
        assert page.evaluate("document.documentElement.scrollWidth") <= 400  # wide tables scroll in a box of their own
        browser.close()
