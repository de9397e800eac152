"""What mkdocs does besides copying docs/: pages made from the program itself, and links that hold on the site, too.

cli.md          from the parser of `gsseg`
ros.md          from the comments in msg_defs/
api.md          the public names of the library, for mkdocstrings
benchmark.md, contributing.md, changelog.md, examples.md    from files outside docs/
"""

from __future__ import annotations

import logging
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

sys.path.insert(0, str(Path(__file__).parent))

import pages

LOG = logging.getLogger("mkdocs.hooks.gsseg")
REPOSITORY = Path(__file__).parents[2]
OUTSIDE = {
    "BENCHMARK.md": "benchmark.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "examples/README.md": "examples.md",
    "msg_defs/README.md": "ros.md",
    "README.md": "index.md",
}
"""Pages that files outside docs/ become."""

MADE = {*OUTSIDE.values(), "api.md", "cli.md"} - {"index.md"}
"""Pages that are not in docs/."""

_LINK = re.compile(r"(?P<text>!?\[[^\]]*\])\((?P<target>[^)\s#]*)(?P<anchor>#[^)\s]*)?\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Leave out of the nav what is not there."""
    there = {path.relative_to(config.docs_dir).as_posix() for path in Path(config.docs_dir).rglob("*.md")}
    config.nav = _without_missing(config.nav, MADE | there)
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made."""
    texts = {"cli.md": pages.command_line(), "api.md": pages.python()}
    texts["ros.md"] = relink(pages.ros_interfaces(), "msg_defs/README.md")
    for source, name in OUTSIDE.items():
        if name not in texts and name != "index.md":
            texts[name] = relink((REPOSITORY / source).read_text(encoding="utf-8"), source)
    for name, text in texts.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links from docs/ to files outside it into links to pages."""
    return markdown if page.file.generated_by else relink(markdown, f"docs/{page.file.src_uri}")


def relink(markdown: str, source: str) -> str:
    """Make links hold on the site that hold in the repository.

    Parameters
    ----------
    markdown : str
        Text of a page.
    source : str
        The file that it is from, relative to the repository. A link to a file that is no page becomes its name.

    A link to what is not there is a warning, which --strict makes an error.
    """

    def replaced(link: re.Match[str]) -> str:
        target, anchor = link["target"], link["anchor"] or ""
        if not target or "://" in target or target.startswith("mailto:"):
            return link[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if path.removeprefix("docs/") in MADE:
            return link[0]
        if not (REPOSITORY / path).exists():
            LOG.warning(f"{source}: links to {target}, which is not there")
            return link[0]
        if path in OUTSIDE:
            return f"{link['text']}({OUTSIDE[path]}{anchor})"
        if path.startswith("docs/"):
            here = posixpath.dirname(source) if source.startswith("docs/") else "docs"
            return f"{link['text']}({posixpath.relpath(path, here)}{anchor})"
        return f"`{path}`"

    return _outside_code(markdown, lambda text: _LINK.sub(replaced, text))


def _outside_code(markdown: str, change: Any) -> str:
    parts = re.split(r"(^```.*?^```$)", markdown, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if part.startswith("```") else change(part) for part in parts)


def _without_missing(entries: Any, there: set[str]) -> Any:
    kept = []
    for entry in entries:
        ((title, target),) = entry.items()
        if isinstance(target, list):
            target = _without_missing(target, there)
        if target and (isinstance(target, list) or target in there):
            kept.append({title: target})
    return kept
