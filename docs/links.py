"""Checks links without a network: ``python docs/links.py BUILT_HTML``.

In the built site every file and anchor must exist; in Markdown, as it is read in a repository, every file and heading.
Links to elsewhere must be well formed and use https; nobody is asked whether they answer.
"""

from __future__ import annotations

import re
import sys
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[1]


class _Page(HTMLParser):
    """Links of a page, and the anchors that it has."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what a tag links to, and what it is called."""
        named = dict(attrs)
        self.anchors |= {value for key in ("id", "name") if (value := named.get(key))}
        if tag in ("a", "img", "link", "script", "source"):
            self.links += [value for key in ("href", "src") if (value := named.get(key))]


@cache
def _page(path: Path) -> _Page:
    text = path.read_text()
    if path.suffix == ".html":
        return _Page(text)
    page = _Page(MarkdownIt().render(re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL)))
    headings = re.findall(r"<h\d>(.*?)</h\d>", MarkdownIt().render(text))
    slugs = [
        re.sub(r"[^\w\- ]", "", re.sub(r"<[^>]*>|&\w+;", "", title).lower()).replace(" ", "-") for title in headings
    ]
    page.anchors |= {f"{slug}-{n}" if (n := slugs[:i].count(slug)) else slug for i, slug in enumerate(slugs)}
    return page


def _fault(path: Path, link: str) -> str | None:
    """What is wrong with a link of a page."""
    try:
        parts = urlsplit(link)
    except ValueError:
        return "is no link"
    if parts.scheme in ("data", "mailto"):
        return None
    if parts.scheme or parts.netloc:
        good = parts.scheme == "https" and re.fullmatch(r"[a-z0-9-]+(\.[a-z0-9-]+)+", parts.netloc)
        return None if good else "must be https and name a host"
    target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    if not target.exists() or not (target.is_relative_to(ROOT) or path.suffix == ".html"):
        return "leads to no file"
    if not parts.fragment or target.suffix not in (".html", ".md"):
        return None
    return None if unquote(parts.fragment) in _page(target).anchors else "leads to no such place"


def faults(pages: list[Path]) -> list[str]:
    """A line for every link that is wrong."""
    links = [(page, link) for page in pages for link in sorted(set(_page(page).links))]
    return [f"{page}: {link} {fault}" for page, link in links if (fault := _fault(page, link))]


if __name__ == "__main__":
    site = sorted(Path(sys.argv[1]).resolve().rglob("*.html"))
    written = [*ROOT.glob("*.md"), *(ROOT / "scenes").rglob("*.md")]
    written += [page for page in (ROOT / "docs").rglob("*.md") if "_build" not in page.parts]
    found = faults(site + written)
    print(*found, f"{len(site)} pages, {len(written)} files of Markdown: {len(found)} broken links", sep="\n")
    sys.exit(bool(found))
