"""A hook of mkdocs: links out of docs/ lead to the repository, whose files are no pages of the site."""

import re
from pathlib import Path

_DOCS = Path(__file__).resolve().parent
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(((?:\.\./)+[^)#\s]+)(#[^)\s]+)?\)")


def on_page_markdown(markdown, page, config, files):
    """`[text](../../examples/x.py)` becomes a link to that file where the site says where its repository is.

    Without `repo_url` it becomes the file's name in the repository, which is what a reader of a checkout has.
    """

    def elsewhere(match):
        text, target = match[1], match[2]
        path = (_DOCS / Path(page.file.src_uri).parent / target).resolve()
        if path.is_relative_to(_DOCS):
            return match[0]
        name = path.relative_to(_DOCS.parent).as_posix()
        if config.repo_url:
            return f"[{text}]({config.repo_url.rstrip('/')}/blob/main/{name})"
        return f"{text} (`{name}`)" if name not in text else f"`{name}`"

    return _LINK.sub(elsewhere, markdown)
