"""The documentation is run: every block of every page, its figures' commands, its links."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import types

import pytest
from doc_pages import PAGES, ROOT, blocks, elsewhere, figures, inline_commands, lines_of, make_folder, smaller

from drgs import cli
from drgs.codecs import CODECS
from drgs.data import LOADERS
from drgs.information.choices import BLOCKS, POLICIES
from drgs.information.criteria import CRITERIA
from drgs.settings import RESPONSES

# What has tests of its own, which run the very blocks.
_README = ROOT / "README.md"
_ELSEWHERE = (_README, ROOT / "docs/commands.md")
_LANGUAGES = {"bash", "toml", "python", "bibtex", "text", "json"}


def _name(page) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What pages speak of, see `doc_pages.make_folder`."""
    return make_folder(tmp_path_factory.mktemp("docs"))


@pytest.mark.every(3)
@pytest.mark.parametrize(
    "page", [pytest.param(page, id=_name(page)) for page in PAGES if page not in _ELSEWHERE and blocks(page)]
)
def test_blocks_run(page, made, tmp_path, monkeypatch, capsys):
    """Blocks of a page run in its order, in one folder: Python in one namespace, commands on little data.

    A function `test_...` that a block defines is called, as pytest would.
    """
    folder = tmp_path / "page"
    shutil.copytree(made, folder)
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    for registry in (POLICIES, CRITERIA, BLOCKS, RESPONSES, LOADERS, CODECS):  # which pages add to
        monkeypatch.setattr(registry, "_rows", dict(registry._rows))
    module = types.ModuleType("docs")  # in which classes of a page find their annotations, as in a script
    monkeypatch.setitem(sys.modules, "docs", module)
    names = vars(module)
    for block in blocks(page):
        where = f"{_name(page)}:{block.line}"
        if block.language == "python":
            before = set(names)
            # A file name that tracebacks can show, and inspect can read.
            source = folder / f"block_{block.line}.py"
            source.write_text(block.text)
            exec(compile(block.text, str(source), "exec"), names)
            for name in sorted(set(names) - before):
                if name.startswith("test_"):
                    names[name]()
        elif block.language == "toml":  # its first line names the file
            (folder / block.text.splitlines()[0].removeprefix("# ")).write_text(block.text)
        elif block.language == "bash":
            for line in lines_of(block):
                _run(line, where)
    capsys.readouterr()


def _run(line: str, where: str) -> None:
    """One line of a bash block: `drgs` is run or, where that takes other things, parsed; the rest must exist."""
    words = shlex.split(line, comments=True)
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words = words[1:]
    if words[0].rpartition("/")[2] != "drgs":
        _check_line(words, where)
    elif elsewhere(words[1:]):
        cli._parse_arguments(words[1:])
    else:
        # 1: a wrong gradient was found, which is what a page may show.
        assert cli.main(smaller(words[1:])) in ((0, 1) if words[1] == "crossval" else (0,)), f"{where}: {line}"


def _check_line(words: list[str], where: str) -> None:
    """Scripts, targets and extras that a line names are there, and a script knows the line's options."""
    said = f"{where}: {' '.join(words)}"
    program = words[0].rpartition("/")[2]
    if program == "make":
        targets = [word for word in words[1:] if "=" not in word and not word.startswith("-")]
        makefile = (ROOT / "Makefile").read_text()
        assert all(re.search(rf"^{name}:", makefile, flags=re.M) for name in targets), said
    elif program in ("pip", "pip3"):
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        for names in re.findall(r"\[([\w,]+)\]", " ".join(words)):
            assert set(names.split(",")) <= set(extras), said
    elif program in ("python", "python3"):
        if words[1].startswith("-"):
            assert words[1:3] == ["-m", "venv"], said
            return
        places = [ROOT / words[1], *sorted((ROOT / "examples").rglob(words[1]))]
        script = next((path for path in places if path.is_file()), None)
        assert script is not None, said
        text = script.read_text(encoding="utf-8")
        if "studies.command(" in text:  # whose parser is that of all studies
            text += (ROOT / "benchmarks/studies.py").read_text(encoding="utf-8")
        for word in words[2:]:
            assert not word.startswith("--") or f'"{word}"' in text, f"{said}: no option {word}"
    elif program == "git":
        assert words[1] == "clone", said
    else:
        raise AssertionError(f"{said}: a command that no test knows")


def test_every_block_says_what_it_is():
    """A block of commands or Python is labelled, so that it runs; what has no label is a drawing."""
    for page in PAGES:
        for block in blocks(page):
            where = f"{_name(page)}:{block.line}"
            assert not block.language or block.language in _LANGUAGES, where
            if not block.language:
                assert not re.search(r"^\s*(drgs|make|python3?|pip|import|from) ", block.text, flags=re.M), where
        text = page.read_text(encoding="utf-8")
        assert not re.search(r"^ {4,}(drgs|make|python3?|pip) ", text, flags=re.M), f"{_name(page)}: unfenced commands"


def test_commands_in_the_text_exist():
    """Options, scripts and targets that running text names are there."""
    from drgs.checks.records import options_in

    for page in PAGES:
        for command in inline_commands(page):
            where = _name(page)
            try:
                words = shlex.split(command)
            except ValueError:
                raise AssertionError(f"{where}: {command}") from None
            if words[0].rpartition("/")[2] != "drgs":
                _check_line(words, where)
                continue
            if words[1] in ("--help", "--version"):
                continue
            assert words[1] in cli.COMMANDS, f"{where}: {command}"
            fields = {option.flag[2:] for option in options_in(cli.COMMANDS[words[1]]).values()}
            fields |= {"help", "help-all"} | {f"no-{name}" for name in fields}
            for word in words[2:]:
                if re.fullmatch(r"--[a-z-]+(=.*)?", word):
                    assert word[2:].partition("=")[0] in fields, f"{where}: {command}: no option {word}"


def test_figures_name_their_commands():
    """The paragraph before or behind a picture names the command that made it."""
    for page in PAGES:
        for path, around in figures(page):
            where = f"{_name(page)}: {path}"
            picture = page.parent / path
            assert picture.is_file(), where
            assert picture.stat().st_size < 400_000, where
            assert re.search(r"`(drgs|python|make) [^`]+`", around), f"{where}: by which command?"


def test_links_lead_somewhere():
    """Files, and headings of pages, that the README and the documentation link to are there."""
    for page in PAGES:
        text = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        for target, heading in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]+))?\)", text):
            if "://" in target:
                continue
            path = page.parent / target if target else page
            assert path.exists(), f"{_name(page)}: {target}"
            if heading and path.suffix == ".md":
                titles = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), flags=re.M)
                slugs = {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}
                assert heading in slugs, f"{_name(page)}: {target}#{heading}"


def test_every_page_is_on_the_site():
    """The navigation of mkdocs.yml names every page below docs/, and pages that are there."""
    named = set(re.findall(r"[\w/-]+\.md", _navigation()))
    pages = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    assert named == pages


def _navigation() -> str:
    text = (ROOT / "mkdocs.yml").read_text()
    text = text[text.index("\nnav:") :]
    return re.sub(r"^\s*#.*$", "", text, flags=re.M)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The documentation, built strictly: no broken link, no docstring that cannot be read."""
    pytest.importorskip("mkdocs", reason="the site needs pip install 'drgs[docs]'")
    folder = tmp_path_factory.mktemp("docs") / "site"
    environ = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(folder)]
    done = subprocess.run(command, cwd=ROOT, env=environ, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def test_the_site_fetches_nothing(site):
    """Nothing of it is from elsewhere when it is looked at."""
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not re.search(r'<(script|img|iframe)[^>]+src="(https?:)?//', text), page
        for link in re.findall(r"<link[^>]+>", text):
            assert "canonical" in link or not re.search(r'href="(https?:)?//', link), (page, link)


def test_the_site_is_searched_from_files(site):
    """Opened as a file, without a server, its search finds pages."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1300, "height": 900})
        page.goto((site / "index.html").as_uri())
        page.evaluate("document.querySelector('[data-md-toggle=search]').click()")
        page.locator(".md-search__input").press_sequentially("crossval")  # once it has slid in
        page.wait_for_selector(".md-search-result__item a", state="attached")
        links = page.locator(".md-search-result__item a").evaluate_all("found => found.map(x => x.href)")
        browser.close()
    assert any(link.startswith("file://") and "crossval.html" in link for link in links)
